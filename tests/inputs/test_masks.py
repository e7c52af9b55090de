"""Masks as people have them: cut-outs, inverted ones, pieces, and every way in which COCO writes them."""

import json
import warnings

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from pycocotools import mask as coco_mask

from foundpose.bop import (
    BopDataset,
    BopError,
    PictureError,
    decode_segmentation,
    detected_instances,
    largest_component,
    plausible_mask,
    read_mask,
)

SIZE = (30, 40)


def disc(size=SIZE, center=(15, 20), radius=8):
    v, u = np.mgrid[: size[0], : size[1]]
    return (v - center[0]) ** 2 + (u - center[1]) ** 2 < radius**2


def cut_out(mask, colour):
    pixels = np.full((*mask.shape, 4), colour, np.uint8)
    pixels[..., 3] = mask * 255
    return Image.fromarray(pixels)


def labels(mask):
    image = Image.fromarray(mask.astype(np.uint8)).convert("P")
    image.putpalette([0, 0, 0, 192, 0, 0])
    return image


READ = {
    "bright.png": Image.fromarray(disc().astype(np.uint8) * 255),
    "one_bit.png": Image.fromarray(disc()),
    "deep.png": Image.fromarray(disc().astype(np.uint16) * 65535),
    "float.tif": Image.fromarray(disc().astype(np.float32)),
    "colour.png": Image.fromarray(disc()[..., None] * np.array([0, 200, 0], np.uint8)),
    "labels.png": labels(disc()),
    "white_cut_out.png": cut_out(disc(), 255),
    "black_cut_out.png": cut_out(disc(), 0),
    "grey_cut_out.png": cut_out(disc(), 255).convert("LA"),
    "cut_out.webp": cut_out(disc(), 255),
}
OPAQUE = cut_out(np.ones(SIZE, bool), 0)
OPAQUE.paste((255, 255, 255, 255), (0, 0), Image.fromarray(disc().astype(np.uint8) * 255))
READ["opaque.png"] = OPAQUE


@pytest.mark.parametrize("name", READ)
def test_masks_of_all_kinds(tmp_path, name):
    READ[name].save(tmp_path / name, **({"lossless": True} if name.endswith("webp") else {}))
    assert torch.equal(read_mask(tmp_path / name, SIZE), torch.from_numpy(disc()))


def test_masks_that_are_refused(tmp_path):
    Image.fromarray(disc().astype(np.uint8)).save(tmp_path / "ones.png")
    with pytest.raises(
        PictureError, match=r"brightest is 1 of 255; .* zeros and ones must be multiplied by 255"
    ):
        read_mask(tmp_path / "ones.png")
    READ["bright.png"].save(tmp_path / "turned.png")
    with pytest.raises(
        PictureError, match=r"is 40x30 px, its image 30x40 px: width and height are swapped.*EXIF"
    ):
        read_mask(tmp_path / "turned.png", SIZE[::-1])
    with pytest.raises(PictureError, match=r"is 40x30 px, its image 80x60 px$"):
        read_mask(tmp_path / "turned.png", (60, 80))


def stray():
    mask = disc(radius=5)
    mask[0, 0] = mask[29, 39] = True
    return mask


def two_pieces(down, right):
    return disc(center=(6, 6), radius=5) | disc(center=(6 + down, 6 + right), radius=4)


def crumb():
    mask = disc(radius=5)
    mask[15, 36] = True
    return mask


def test_reading_warns_and_keeps_the_largest_piece(tmp_path):
    Image.fromarray(stray()).save(tmp_path / "stray.png")
    for largest in (True, False):
        with pytest.warns(UserWarning, match=r"the mask .*stray\.png has pieces far apart"):
            mask = read_mask(tmp_path / "stray.png", SIZE, largest)
        assert mask.sum() == (69 if largest else 71)
    assert read_mask(tmp_path / "stray.png", checked=False).sum() == 71
    Image.fromarray(~disc(radius=4)).save(tmp_path / "inverse.png")
    with pytest.warns(UserWarning, match=r"the mask .*inverse\.png covers 9\d\.\d% of the picture"):
        read_mask(tmp_path / "inverse.png")


# name, mask, the warning if any, and whether the largest piece alone is left
PLAUSIBLE = [
    ("disc", disc(), None, False),
    (
        "full",
        np.ones(SIZE, bool),
        r"covers 100\.0% of the picture, 100% of its border: is it inverted\?",
        False,
    ),
    ("nearly full", ~disc(radius=4), r"covers 9\d\.\d% .* is it inverted", False),
    ("inverse", ~disc(radius=12), r"covers 6\d\.\d% .* is it inverted", False),
    ("large", disc(center=(15, 20), radius=16), None, False),
    ("stray pixels", stray(), r"far apart: the largest has 69 of 71 pixels, .* 14\.\d times", True),
    ("far pieces", two_pieces(18, 28), r"far apart: .*largest_component=false", True),
    ("near pieces", two_pieces(0, 12), None, False),
    ("hidden in part", two_pieces(0, 25), None, False),
    ("crumb", crumb(), r"far apart: the largest has 69 of 70 pixels, .* 2\.3 times", True),
    ("corners", np.eye(30, 40, dtype=bool), None, False),
    ("empty", np.zeros(SIZE, bool), None, False),
]


@pytest.mark.parametrize(("name", "mask", "message", "cut"), PLAUSIBLE, ids=[case[0] for case in PLAUSIBLE])
def test_masks_that_are_hardly_an_object(name, mask, message, cut):
    mask = torch.from_numpy(mask)
    for keep_largest in (True, False):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            got = plausible_mask(mask, "the mask", keep_largest)
        assert len(caught) == (message is not None)
        if message is not None:
            text = message if keep_largest else message.replace("largest_component=false", "all are kept")
            with pytest.warns(UserWarning, match=f"the mask {text}" if "covers" in text else text):
                plausible_mask(mask, "the mask", keep_largest)
            assert caught[0].filename == __file__
        assert torch.equal(got, largest_component(mask) if cut and keep_largest else mask)


def test_largest_component_joins_corners():
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[0, 0] = mask[1, 1] = mask[2, 2] = True
    mask[0, 4:] = True
    expected = mask.clone()
    expected[0, 4:] = False
    assert torch.equal(largest_component(mask), expected)
    assert torch.equal(largest_component(torch.zeros(5, 6)), torch.zeros(5, 6))


PACKED = coco_mask.encode(np.asfortranarray(disc().astype(np.uint8)))["counts"]
FLAT = disc().flatten(order="F")
COUNTS = np.diff([0, *np.flatnonzero(np.diff(FLAT)) + 1, FLAT.size]).tolist()
RECTANGLE = [[4.0, 3.0, 14.0, 3.0, 14.0, 12.0, 4.0, 12.0]]


@pytest.mark.parametrize(
    "counts",
    [PACKED, PACKED.decode(), COUNTS, " ".join(map(str, COUNTS)), f" {'  '.join(map(str, COUNTS))} "],
)
def test_run_lengths(counts):
    assert torch.equal(
        decode_segmentation({"size": list(SIZE), "counts": counts}, SIZE), torch.from_numpy(disc())
    )


def test_polygons():
    expected = torch.zeros(SIZE, dtype=torch.bool)
    expected[3:12, 4:14] = True
    assert torch.equal(decode_segmentation(RECTANGLE, SIZE), expected)
    expected[20:25, 30:36] = True
    pieces = [*RECTANGLE, [30, 20, 36, 20, 36, 25, 30, 25]]
    assert torch.equal(decode_segmentation(pieces, SIZE), expected)
    image = Image.new("1", SIZE[::-1])
    hexagon = [10, 3, 30, 3, 37, 15, 30, 27, 10, 27, 3, 15]
    ImageDraw.Draw(image).polygon(hexagon, fill=1)
    drawn = torch.from_numpy(np.asarray(image).copy())
    got = decode_segmentation([hexagon], SIZE)
    assert (got & drawn).sum() > 0.9 * (got | drawn).sum()


def segmentation(size, counts):
    return {"size": list(size), "counts": counts}


# detections in a picture of 480 x 640, and what is said of them
WRONG = [
    (segmentation((480, 640), [7]), "run lengths cover 7 pixels, the size says 480x640"),
    (segmentation((480, 640), PACKED.decode()), "do not cover the 480x640 pixels"),
    (segmentation((640, 480), [0, 480 * 640]), r"640x480? px|\[height, width\], not \[width, height\]"),
    (segmentation((30, 40), PACKED.decode()), "a mask of 40x30 px, the image has 640x480 px"),
    (segmentation((480, 640), "p"), "counts is cut off"),
    (segmentation((480,), [0]), r"size must be \[height, width\], got \[480\]"),
    ({"counts": [1, 2]}, "not a COCO segmentation"),
    (None, "not a COCO segmentation"),
    ("mask.png", "not a COCO segmentation"),
    ([], "list of polygons is empty"),
    ([1.0, 2.0, 3.0, 4.0], "a polygon must be .* got 1.0 of float"),
    ([[1.0, 2.0, 3.0]], "a polygon must be"),
    ([[1, 2, 3, 4, 5, "6"]], "a polygon must be"),
    ([[1, 2, 3, 4, 5, float("nan")]], "a polygon must be"),
]


@pytest.mark.parametrize(("segmentation", "message"), WRONG)
def test_a_wrong_annotation_is_named(tiny_bop, tmp_path, segmentation, message):
    ids = {"scene_id": 1, "image_id": 0, "category_id": 1}
    (tmp_path / "d.json").write_text(json.dumps([ids | {"score": 0.5, "segmentation": segmentation}]))
    dataset = BopDataset(tiny_bop)
    with pytest.raises(BopError, match=rf"(d\.json: entry 0|object 1 in image 0 of scene 1): .*({message})"):
        detected_instances(dataset, tmp_path)[0].mask(dataset)


def test_detections_take_the_largest_piece_unless_told_not_to(tiny_bop, tmp_path):
    mask = np.zeros((480, 640), bool)
    mask[200:240, 300:350], mask[0, 0] = True, True
    counts = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"].decode()
    ids = {"scene_id": 1, "image_id": 0, "category_id": 1}
    entries = [
        ids | {"score": 0.5, "segmentation": segmentation((480, 640), counts)},
        ids | {"score": 0.4, "segmentation": [[10, 20, 60, 20, 60, 90, 10, 90]]},
    ]
    (tmp_path / "d.json").write_text(json.dumps(entries))
    dataset = BopDataset(tiny_bop)
    for largest, pixels in ((True, 2000), (False, 2001)):
        first, second = detected_instances(
            dataset, tmp_path, masks_per_instance=2, largest_component=largest
        )[:2]
        with pytest.warns(UserWarning, match="object 1 in image 0 of scene 1 has pieces far apart"):
            assert first.mask(dataset).sum() == pixels
        assert second.mask(dataset).sum() == 50 * 70
