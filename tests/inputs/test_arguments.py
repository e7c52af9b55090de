"""Whatever stands behind a key of estimate.py: it is used, or refused with one line and exit status 2."""

import contextlib
import io

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from PIL import Image

import estimate
import finding
from foundpose.synthetic import procedural_mesh
from tests.bop_dataset import write_ply


class AcceptedError(Exception):
    """All arguments were accepted, and the work would begin."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arguments")
    Image.fromarray(np.full((48, 64, 3), 128, np.uint8)).save(folder / "picture.png")
    mask = np.zeros((48, 64), np.uint8)
    mask[10:30, 20:40] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    write_ply(folder / "mesh.ply", procedural_mesh(0, subdivisions=1))
    (folder / "text.txt").write_text("neither picture nor mesh")
    (folder / "empty.png").touch()
    return folder


NUMBERS = st.integers() | st.floats()
FILES = st.sampled_from(
    ["{}/picture.png", "{}/mask.png", "{}/mesh.ply", "{}/text.txt", "{}/empty.png", "{}", "{}/missing.png"]
)
WORDS = st.sampled_from(["", "black", "~", "http://a.b/c.png", "nul\0", "a" * 300, "#12", "é.ply", "True"])
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | FILES | WORDS,
    lambda inner: (
        st.lists(inner, max_size=6) | st.dictionaries(st.sampled_from(["fx", "K", "a"]), inner, max_size=2)
    ),
    max_leaves=9,
)
RIGHT = {
    "image": "{}/picture.png",
    "mask": "{}/mask.png",
    "box": None,
    "mesh": "{}/mesh.ply",
    "intrinsics": [60.0, 60.0, 31.5, 23.5],
    "distortion": None,
    "color": None,
    "background": "black",
    "largest_component": True,
}


@settings(max_examples=300)
@given(changed=st.dictionaries(st.sampled_from(sorted(RIGHT)), VALUES, max_size=3))
@example(changed={})
@example(changed={"color": False})
@example(changed={"mask": None, "box": [float("nan"), 0, 5, 5]})
@example(
    changed={"intrinsics": [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], "distortion": [0.1, 0, 0, float("inf")]}
)
def test_any_value_is_used_or_refused_in_one_line(folder, changed):
    values = {key: _with_folder(value, folder) for key, value in (RIGHT | changed).items()}
    picture = OmegaConf.create(values)
    told = io.StringIO()
    with contextlib.redirect_stderr(told), pytest.MonkeyPatch.context() as patch:
        patch.setattr(estimate, "build_method", _accepted)
        patch.setattr(estimate, "claim_run_folder", lambda *_: None)
        with pytest.raises((SystemExit, AcceptedError)) as ended, estimate.clear_errors():
            estimate.estimate_picture(picture, folder)
    if isinstance(ended.value, SystemExit):
        assert ended.value.code == 2
        (line,) = [line for line in told.getvalue().splitlines() if line.startswith("error: ")]
        assert len(line) > 20
    assert "Traceback" not in told.getvalue()


FINDING = {
    **{key: value for key, value in RIGHT.items() if key not in ("mask", "mesh")},
    "mask": None,
    "mesh": None,
    "meshes": ["{}/mesh.ply"],
    "instances": 1,
    "step": 1,
}


@settings(max_examples=150)
@given(changed=st.dictionaries(st.sampled_from(sorted({*FINDING} - {"mask", "box"})), VALUES, max_size=3))
@example(changed={"meshes": ["{}/mesh.ply", "{}/mesh.ply"]})
@example(changed={"instances": [1, 2]})
def test_any_value_is_used_or_refused_where_objects_are_found(folder, changed):
    values = {key: _with_folder(value, folder) for key, value in (FINDING | changed).items()}
    told = io.StringIO()
    with contextlib.redirect_stderr(told), pytest.MonkeyPatch.context() as patch:
        patch.setattr(finding, "build_method", _accepted)
        patch.setattr(finding, "claim_run_folder", lambda *_: None)
        with pytest.raises((SystemExit, AcceptedError)) as ended, estimate.clear_errors():
            finding.find_in_pictures(OmegaConf.create(values), folder)
    if isinstance(ended.value, SystemExit):
        assert ended.value.code == 2
        (line,) = [line for line in told.getvalue().splitlines() if line.startswith("error: ")]
        assert len(line) > 20
    assert "Traceback" not in told.getvalue()


def test_two_pictures_of_one_name_are_refused(tmp_path):
    for name in ("a.png", "a.jpg"):
        Image.new("RGB", (8, 8)).save(tmp_path / name)
    with pytest.raises(ValueError, match="have one name: rename some"):
        finding._names(tmp_path)


def _accepted(_cfg):
    raise AcceptedError


def _with_folder(value, folder):
    if isinstance(value, str):
        return value.replace("{}", str(folder))
    if isinstance(value, list):
        return [_with_folder(item, folder) for item in value]
    if isinstance(value, dict):
        return {key: _with_folder(item, folder) for key, item in value.items()}
    return value
