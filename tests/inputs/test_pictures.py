"""Pictures as people have them: what is read, or the words in which a file is refused."""

import io
import struct
import zlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from foundpose.bop import PictureError, read_image
from foundpose.utils.pictures import read_depth, read_image_size, read_picture

RED, GREY = (1.0, 0.0, 0.0), (0.4, 0.4, 0.4)


def png(width, height, depth, colour, rows, extra=b""):
    """A PNG file of raw rows, for what Pillow does not write."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    signature = b"\x89PNG\r\n\x1a\n"
    return signature + chunk(b"IHDR", head) + extra + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def save(image, **options):
    """Makes a file of an image."""
    return lambda path: image.save(path, **options)


def palette(alpha):
    image = Image.new("P", (4, 3), 1)
    image.putpalette([0, 0, 0, 255, 0, 0])
    return save(image, transparency=1) if alpha else save(image)


def raw(content):
    return lambda path: path.write_bytes(content)


deep = [struct.pack(">3H", 65535, 0, 0) * 4] * 3
DEEP_ALPHA = [struct.pack(">4H", 65535, 0, 0, 32896) * 4] * 3
GREY_ALPHA = [struct.pack(">2H", 26214, 65535) * 4] * 3

# name, how it is made, and the colour of every pixel
READ = [
    ("rgb.png", save(Image.new("RGB", (4, 3), (255, 0, 0))), RED),
    ("rgb.bmp", save(Image.new("RGB", (4, 3), (255, 0, 0))), RED),
    ("rgb.webp", save(Image.new("RGB", (4, 3), (255, 0, 0)), lossless=True), RED),
    ("rgb.ppm", save(Image.new("RGB", (4, 3), (255, 0, 0))), RED),
    ("one_bit.png", save(Image.new("1", (4, 3), 1)), (1.0, 1.0, 1.0)),
    ("grey.png", save(Image.new("L", (4, 3), 102)), GREY),
    ("grey.jpg", save(Image.new("L", (4, 3), 102)), GREY),
    ("grey.gif", save(Image.new("L", (4, 3), 102)), GREY),
    ("grey_tRNS.png", save(Image.new("L", (4, 3), 102), transparency=102), (0.0, 0.0, 0.0)),
    ("grey_alpha.png", save(Image.new("LA", (4, 3), (102, 255))), GREY),
    ("grey_half.png", save(Image.new("LA", (4, 3), (204, 128))), (0.8 * 128 / 255,) * 3),
    ("palette.png", palette(False), RED),
    ("palette_clear.png", palette(True), (0.0, 0.0, 0.0)),
    ("palette.gif", palette(False), RED),
    ("rgb_tRNS.png", save(Image.new("RGB", (4, 3), (255, 0, 0)), transparency=(255, 0, 0)), (0.0, 0.0, 0.0)),
    ("rgba.png", save(Image.new("RGBA", (4, 3), (255, 0, 0, 51))), (0.2, 0.0, 0.0)),
    ("clear.png", save(Image.new("RGBA", (4, 3), (255, 255, 255, 0))), (0.0, 0.0, 0.0)),
    ("cmyk.tif", save(Image.new("CMYK", (4, 3), (0, 255, 255, 0))), RED),
    ("cmyk.jpg", save(Image.new("CMYK", (4, 3), (0, 255, 255, 0)), quality=100), RED),
    ("ycbcr.tif", save(Image.new("YCbCr", (4, 3), (102, 128, 128))), GREY),
    ("deep_grey.png", save(Image.fromarray(np.full((3, 4), 26214, np.uint16))), GREY),
    ("deep_grey.tif", save(Image.fromarray(np.full((3, 4), 26214, np.uint16))), GREY),
    ("deep_grey.pgm", raw(b"P5 4 3 65535\n" + struct.pack(">H", 26214) * 12), GREY),
    ("deep_rgb.png", raw(png(4, 3, 16, 2, deep)), RED),
    ("deep_rgba.png", raw(png(4, 3, 16, 6, DEEP_ALPHA)), (128 / 255, 0.0, 0.0)),
    ("deep_grey_alpha.png", raw(png(4, 3, 16, 4, GREY_ALPHA)), GREY),
    ("float.tif", save(Image.fromarray(np.full((3, 4), 0.4, np.float32))), GREY),
    ("one_channel.tif", save(Image.fromarray(np.full((3, 4), 102, np.uint8))), GREY),
    ("mislabelled.jpg", save(Image.new("RGB", (4, 3), (255, 0, 0)), format="PNG"), RED),
    ("no_ending", save(Image.new("RGB", (4, 3), (255, 0, 0)), format="PNG"), RED),
]


@pytest.mark.parametrize(("name", "make", "colour"), READ, ids=[case[0] for case in READ])
def test_modes_and_depths(tmp_path, name, make, colour):
    make(tmp_path / name)
    picture = read_image(tmp_path / name)
    assert (picture.dtype, picture.shape) == (torch.float32, (3, 3, 4))
    expected = torch.tensor(colour)[:, None, None].expand(3, 3, 4)
    assert torch.allclose(picture, expected, atol=1.5 / 255), picture[:, 0, 0]
    assert read_image_size(tmp_path / name) == (3, 4)


def bytes_of(image, **options):
    file = io.BytesIO()
    image.save(file, **options)
    return file.getvalue()


FRAMES = [Image.new("RGB", (4, 3), (value, 0, 0)) for value in (0, 100, 200)]
PHOTO = bytes_of(
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 50, 3), np.uint8)), format="JPEG"
)
PICTURE = bytes_of(
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 50, 3), np.uint8)), format="PNG"
)

REFUSED = [
    ("lab.tif", save(Image.new("LAB", (4, 3))), "colours of mode 'LAB'"),
    ("integers.tif", save(Image.fromarray(np.full((3, 4), 7, np.int32))), "colours of mode 'I', whose range"),
    ("bright.tif", save(Image.fromarray(np.full((3, 4), 7.5, np.float32))), "floats from 7.5 to 7.5; scale"),
    ("negative.tif", save(Image.fromarray(np.full((3, 4), -1, np.float32))), "floats from -1 to -1"),
    ("nan.tif", save(Image.fromarray(np.full((3, 4), np.nan, np.float32))), "floats from nan"),
    ("animated.gif", save(FRAMES[0], save_all=True, append_images=FRAMES[1:]), r"holds 3 pictures \(GIF\)"),
    ("animated.png", save(FRAMES[0], save_all=True, append_images=FRAMES[1:]), r"holds 3 pictures \(PNG\)"),
    ("animated.webp", save(FRAMES[0], save_all=True, append_images=FRAMES[1:]), r"holds 3 pictures \(WEBP"),
    ("pages.tif", save(FRAMES[0], save_all=True, append_images=FRAMES[1:]), r"holds 3 pictures \(TIFF\)"),
    ("cut.jpg", raw(PHOTO[: len(PHOTO) // 2]), "not a readable image: .*truncated"),
    ("cut.png", raw(PICTURE[: len(PICTURE) // 2]), "not a readable image"),
    ("head.png", raw(PICTURE[:20]), "not a readable image"),
    ("damaged.png", raw(PICTURE[:60] + b"????" + PICTURE[64:]), "not a readable image"),
    ("empty.jpg", raw(b""), r"the file is empty \(0 bytes\)"),
    ("text.png", raw(b"no picture"), "does not know its format"),
    ("page.jpg", raw(b"<!DOCTYPE html><html></html>"), "does not know its format"),
    ("IMG_1.heic", raw(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"), r"does not know its format \(save HEIC"),
]


@pytest.mark.parametrize(("name", "make", "message"), REFUSED, ids=[case[0] for case in REFUSED])
def test_refused_by_name(tmp_path, name, make, message):
    make(tmp_path / name)
    with pytest.raises(PictureError, match=f"(?s){name}.*{message}"):
        read_image(tmp_path / name)


def test_places_that_are_no_file(tmp_path):
    (tmp_path / "shots").mkdir()
    (tmp_path / "shots" / "a.jpg").write_bytes(PHOTO)
    with pytest.raises(PictureError, match=r"shots is a folder, not a picture; .* holds a\.jpg"):
        read_image(tmp_path / "shots")
    with pytest.raises(FileNotFoundError, match=r"no image at .*b\.jpg; .* holds a\.jpg"):
        read_image(tmp_path / "shots" / "b.jpg")
    with pytest.raises(PictureError, match="is an address; download the picture"):
        read_image("https://example.org/cup.jpg")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "webp"])
def test_exif_orientation(tmp_path, orientation, ending):
    upright = np.zeros((16, 24), np.uint8)
    upright[:8, :8], upright[:8, 8:16] = 255, 128  # a corner, and what is right of it
    # What a camera stores so that the orientation's rule gives the upright picture.
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.T,
        6: np.rot90(upright, 1),
        7: upright[::-1, ::-1].T,
        8: np.rot90(upright, -1),
    }[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"photo.{ending}"
    options = {"lossless": True} if ending == "webp" else {"quality": 100} if ending == "jpg" else {}
    Image.fromarray(np.ascontiguousarray(stored)).convert("RGB").save(path, exif=exif, **options)
    assert torch.allclose(read_image(path)[0], torch.from_numpy(upright / 255.0).float(), atol=0.02)
    assert read_image_size(path) == (16, 24)


def test_alpha_shows_the_background_that_is_asked_for(tmp_path):
    path = tmp_path / "cut_out.png"
    Image.new("RGBA", (4, 3), (255, 0, 0, 102)).save(path)
    for background, expected in (
        ("black", (0.4, 0, 0)),
        ("white", (1, 0.6, 0.6)),
        ("#0000ff", (0.4, 0, 0.6)),
    ):
        assert torch.allclose(read_image(path, background)[:, 1, 1], torch.tensor(expected), atol=1e-6)
    with pytest.raises(ValueError, match=r"background must be a colour such as black .* got 'plaid'"):
        read_image(path, "plaid")
    picture = read_picture(path)
    assert picture.rgb[0].eq(1).all()
    assert torch.allclose(picture.alpha, torch.full((3, 4), 0.4))


def test_two_pictures_of_a_telephone_are_one(tmp_path):
    FRAMES[1].save(
        tmp_path / "phone.jpg", format="MPO", save_all=True, append_images=[FRAMES[2]], quality=100
    )
    assert torch.allclose(read_image(tmp_path / "phone.jpg")[0], torch.full((3, 4), 100 / 255), atol=0.02)


@given(data=st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, data):
    content = bytearray(data.draw(st.sampled_from([PHOTO, PICTURE])))
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "picture"
    path.write_bytes(bytes(content[: data.draw(st.integers(1, len(content)))]))
    for read in (read_image, read_image_size, lambda p: read_depth(p, 1.0)):
        try:
            read(path)
        except PictureError as error:
            assert str(path) in str(error)  # noqa: PT017 - either outcome is right
