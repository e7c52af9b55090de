"""Laws: what is written is read back; whatever else a file holds is refused in words."""

import csv
import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image
from pycocotools import mask as coco_mask

from foundpose.bop import BopError, PoseResult, decode_segmentation, read_mask, read_results, write_results
from foundpose.geometry import se3_exp
from foundpose.representation import ObjectRepresentation
from tests.onboarding.jobs import small_onboarder

MASKS = arrays.arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12)))
FINITE = st.floats(-1e6, 1e6)
IDS = st.integers(0, 10**6)


@given(
    mask=MASKS,
    ending=st.sampled_from(["png", "tif", "bmp", "webp"]),
    way=st.sampled_from(["L", "1", "alpha"]),
)
def test_masks_as_pictures(tmp_path_factory, mask, ending, way):
    path = tmp_path_factory.getbasetemp() / f"mask.{ending}"
    image = Image.fromarray(mask.astype(np.uint8) * 255)
    if way == "alpha" and ending in ("png", "webp") and 0 < mask.sum() < mask.size:
        picture = Image.new("RGBA", image.size, (200, 255, 30, 0))
        picture.putalpha(image)
        image = picture
    elif way == "1" and ending != "webp":
        image = image.convert("1")
    image.save(path, **({"lossless": True} if ending == "webp" else {}))
    assert torch.equal(read_mask(path, mask.shape, checked=False), torch.from_numpy(mask))


@given(mask=MASKS, way=st.sampled_from(["bytes", "string", "list", "numbers"]))
def test_masks_as_run_lengths(mask, way):
    flat = mask.flatten(order="F")
    counts = np.diff([0, *np.flatnonzero(np.diff(flat)) + 1, flat.size]).tolist()
    counts = [0, *counts] if flat[0] else counts
    packed = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"]
    written = {
        "bytes": packed,
        "string": packed.decode(),
        "list": counts,
        "numbers": " ".join(map(str, counts)) if len(counts) > 1 else counts,
    }[way]
    assert torch.equal(
        decode_segmentation({"size": list(mask.shape), "counts": written}, mask.shape), torch.from_numpy(mask)
    )


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["size", "counts", "x"]), inner)
    ),
    max_leaves=12,
)


@given(
    segmentation=JSON
    | st.fixed_dictionaries(
        {"size": st.lists(st.integers(-2, 40), max_size=3), "counts": st.text() | st.binary()}
    )
    | st.fixed_dictionaries({"size": st.just([3, 4]), "counts": st.text("012345MNOPQo")})
)
def test_any_segmentation_is_decoded_or_refused(segmentation):
    try:
        mask = decode_segmentation(segmentation, (3, 4))
    except BopError:
        return
    assert (mask.dtype, mask.shape) == (torch.bool, (3, 4))


@st.composite
def results(draw):
    twist = torch.tensor([0.0, 0.0, 0.0, *draw(st.tuples(*[st.floats(-4, 4)] * 3))], dtype=torch.float64)
    T = se3_exp(twist) * draw(st.sampled_from([1.0, 1.005, 0.99]))
    T[3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    T[:3, 3] = torch.tensor(draw(st.tuples(FINITE, FINITE, FINITE)), dtype=torch.float64)
    time = draw(st.just(-1.0) | st.floats(0, 1e6))
    return PoseResult(draw(IDS), draw(IDS), draw(IDS), draw(FINITE), T, time)


@given(written=st.lists(results(), max_size=5, unique_by=lambda r: (r.scene_id, r.im_id)))
def test_results(tmp_path_factory, written):
    path = tmp_path_factory.getbasetemp() / "results.csv"
    write_results(path, written)
    read = read_results(path)
    assert len(read) == len(written)
    for a, b in zip(written, read, strict=True):
        assert torch.equal(a.T_camera_from_model, b.T_camera_from_model)
        assert (a.scene_id, a.im_id, a.obj_id, a.score, a.time) == (
            b.scene_id,
            b.im_id,
            b.obj_id,
            b.score,
            b.time,
        )


@given(
    rows=st.lists(
        st.lists(
            st.text(max_size=12) | st.sampled_from(["1", "0.5", "1 0 0 0 1 0 0 0 1", "1 2 3"]), max_size=8
        )
    )
)
def test_any_file_of_results_is_read_or_refused(tmp_path_factory, rows):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    with path.open("w", newline="", encoding="utf-8", errors="replace") as file:
        csv.writer(file).writerows(rows)
    try:
        read = read_results(path)
    except BopError as error:
        assert str(path) in str(error)  # noqa: PT017 - either outcome is right
        return
    assert all(math.isfinite(result.score) for result in read)


@given(content=st.binary(max_size=60))
def test_any_bytes_are_read_as_results_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "bytes.csv"
    path.write_bytes(content)
    try:
        assert read_results(path) == []
    except BopError as error:
        assert str(path) in str(error)  # noqa: PT017 - either outcome is right


@pytest.fixture(scope="module")
def representation(blob):
    return small_onboarder()(blob, "blob")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
@given(data=st.data(), mmap=st.booleans())
def test_representations(representation, tmp_path_factory, data, mmap):
    """Any numbers in the buffers come back bit for bit; a file that was damaged is refused or read as it is."""
    seed = data.draw(st.integers(0, 2**31))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        representation.descriptors.copy_(
            torch.randn(representation.descriptors.shape, generator=generator).to(
                representation.descriptors.dtype
            )
        )
    path = tmp_path_factory.getbasetemp() / f"{seed}.safetensors"
    representation.save(path)
    again = ObjectRepresentation.load(path, mmap=mmap)
    before, after = representation.state_dict(), again.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    content = path.read_bytes()
    path.with_suffix(".cut").write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(ValueError, match=r"\.cut"):
        ObjectRepresentation.load(path.with_suffix(".cut"), mmap=mmap)
    path.unlink()
