"""Intrinsics of all kinds: read, or refused by name."""

import json
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.geometry.calibration import undistort_image

from foundpose.bop import BopError
from foundpose.bop.scenes import parse_intrinsics
from foundpose.geometry import CameraError, check_camera, intrinsics_matrix, read_camera

K = [[600.0, 0.0, 321.5], [0.0, 602.0, 238.5], [0.0, 0.0, 1.0]]
SKEWED = [[600.0, 2.5, 321.5], [0.0, 602.0, 238.5], [0.0, 0.0, 1.0]]
FLAT = [600, 0, 321.5, 0, 602, 238.5, 0, 0, 1]
SIZE = (480, 640)

CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: head_camera
camera_matrix:
  rows: 3
  cols: 3
  data: [600.0, 0.0, 321.5, 0.0, 602.0, 238.5, 0.0, 0.0, 1.0]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: {data}
"""
MESSAGE = """\
header: {frame_id: camera}
height: 480
width: 640
distortion_model: plumb_bob
D: [0.0, 0.0, 0.0, 0.0, 0.0]
K: [600.0, 0.0, 321.5, 0.0, 602.0, 238.5, 0.0, 0.0, 1.0]
"""
BOP = {"fx": 600.0, "fy": 602.0, "cx": 321.5, "cy": 238.5, "depth_scale": 0.1, "width": 640, "height": 480}


def info(model: str, data: list[float]) -> str:
    return CAMERA_INFO.format(model=model, count=len(data), data=data)


@pytest.mark.parametrize(
    ("kind", "given", "expected"),
    [
        ("four numbers", [600, 602, 321.5, 238.5], K),
        ("a matrix", K, K),
        ("nine numbers", FLAT, K),
        ("skew", SKEWED, SKEWED),
    ],
)
def test_lists(kind: str, given: list, expected: list) -> None:
    camera = read_camera(given)
    assert torch.equal(camera.K, torch.tensor(expected))
    assert camera.distortion == []
    assert camera.size is None


@pytest.mark.parametrize(
    ("name", "content", "distortion", "size"),
    [
        ("camera.json", json.dumps(BOP), [], SIZE),
        ("camera.json", json.dumps({"cam_K": FLAT, "depth_scale": 1.0}), [], None),
        (
            "head.yaml",
            info("plumb_bob", [0.1, -0.2, 0.001, 0.002, 0.05]),
            [0.1, -0.2, 0.001, 0.002, 0.05],
            SIZE,
        ),
        ("head.yaml", info("rational_polynomial", [0.1] * 8), [0.1] * 8, SIZE),
        ("head.yaml", info("plumb_bob", [0.0] * 5), [], SIZE),
        ("message.yml", MESSAGE, [], SIZE),
    ],
)
def test_files(tmp_path: Path, name: str, content: str, distortion: list, size: tuple | None) -> None:
    (tmp_path / name).write_text(content)
    camera = read_camera(str(tmp_path / name))
    assert torch.equal(camera.K, torch.tensor(K))
    assert camera.distortion == distortion
    assert camera.size == size
    check_camera(camera.K, SIZE, camera.size)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([600], r"intrinsics must be \[fx,fy,cx,cy\] in pixels, .* got \[600\]"),
        (5, "intrinsics must be .* got 5"),
        (None, "intrinsics must be .* got None"),
        ([600, 600, "a", 240], "intrinsics must be .* got"),
        ([600, 600, float("nan"), 240], "intrinsics must be .* got"),
        ([[600, 0, 320], [0, 600]], "intrinsics must be .* got"),
        ([-600, 602, 321.5, 238.5], "focal lengths must be positive, got fx=-600, fy=602 .*y down"),
        ([600, -602, 321.5, 238.5], "focal lengths must be positive, got fx=600, fy=-602"),
        ([0, 0, 0, 0], "focal lengths must be positive, got fx=0, fy=0"),
        ([list(row) for row in zip(*K, strict=True)], "row by row.* transposed"),
        ([[600, 0, 321.5], [1, 602, 238.5], [0, 0, 1]], "row by row"),
    ],
)
def test_lists_that_are_no_camera(given: object, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        read_camera(given)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", r"a\.json is not readable as JSON or YAML"),
        ("a.json", "[1, 2]", "must hold a camera.*it holds list"),
        ("a.json", '{"focal": 3}', r"a\.json holds no camera that is known.*'focal'"),
        (
            "scene_camera.json",
            json.dumps({"3": {"cam_K": FLAT}, "8": {"cam_K": FLAT}}),
            "the cameras of 2 pictures",
        ),
        ("a.yaml", info("equidistant", [0.1] * 4), "fisheye cameras are not supported.*equidistant"),
        ("a.yaml", "%YAML:1.0\n---\nK: !!opencv-matrix\n", "not readable as JSON or YAML"),
        ("a.yaml", "camera_matrix: 3", "camera_matrix must be"),
        ("a.yaml", "K: [1, 2, 3]", "K must be"),
        ("a.yaml", MESSAGE.replace("D: [0.0,", "D: [x,"), "D must be a list of numbers"),
        ("a.yaml", MESSAGE.replace("K: [600.0", "K: [-600.0"), "focal lengths must be positive"),
    ],
)
def test_files_that_hold_no_camera(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(CameraError, match=message):
        read_camera(tmp_path / name)


def test_a_file_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(
        FileNotFoundError,
        match=r"no file of intrinsics .*lost\.json \(No such file.*\); intrinsics must be \[fx",
    ):
        read_camera(str(tmp_path / "lost.json"))


@pytest.mark.parametrize(
    ("kind", "values", "size", "of_size", "message"),
    [
        (
            "made for another size",
            (1200, 1204, 643.5, 477.5),
            SIZE,
            (960, 1280),
            r"for pictures of 1280x960 px, the picture is 640x480 px.*factor 0\.5 they are \[600,602,321\.5,238\.5\]",
        ),
        ("made for another shape", (600, 602, 321, 238), SIZE, (512, 512), "for pictures of 512x512 px"),
        (
            "fx, cx, fy, cy",
            (600, 321.5, 602, 238.5),
            SIZE,
            None,
            r"in the order \[fx,cx,fy,cy\]: give intrinsics=\[600,602,321\.5,238\.5\]",
        ),
        (
            "cx, cy, fx, fy",
            (321.5, 238.5, 600, 602),
            SIZE,
            None,
            r"in the order \[cx,cy,fx,fy\]: give intrinsics=\[600,602,321\.5,238\.5\]",
        ),
        (
            "cx, fx, cy, fy",
            (321.5, 600, 238.5, 602),
            SIZE,
            None,
            r"in the order \[cx,fx,cy,fy\]: give intrinsics=\[600,602,321\.5,238\.5\]",
        ),
        (
            "millimetres",
            (4.2, 4.2, 319.5, 239.5),
            SIZE,
            None,
            "of view of 178°; a focal length in mill",
        ),
        ("nanometres", (1e6, 1e6, 319.5, 239.5), SIZE, None, r"field of view of 0\.0367°"),
    ],
)
def test_cameras_of_other_pictures(
    kind: str, values: tuple, size: tuple, of_size: tuple | None, message: str
) -> None:
    with pytest.raises(CameraError, match=message):
        check_camera(intrinsics_matrix(*values), size, of_size)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (
            "of the full picture, with one of half its size",
            (1200, 1204, 643.5, 477.5),
            r"\(643\.5, 477\.5\) is far from the centre .* 2 times as large\? With the factor 0\.5 they are",
        ),
        (
            "of half the picture",
            (300, 301, 159.5, 119.5),
            r"0\.5 times as large\? With the factor 2 they are \[600",
        ),
        (
            "cut out",
            (600, 602, 90.0, 238.5),
            r"far from the centre of the picture of 640x480 px; for a part cut out",
        ),
        ("pixels that are not square", (600, 400, 321.5, 238.5), "far from square"),
    ],
)
def test_cameras_that_are_hardly_meant(kind: str, values: tuple, message: str) -> None:
    with pytest.warns(UserWarning, match=message):
        check_camera(intrinsics_matrix(*values), SIZE)


@pytest.mark.parametrize(
    "values",
    [
        (600, 602, 321.5, 238.5),
        (572.4, 573.6, 325.3, 242.0),
        (300, 300, 319.5, 239.5),
        (9000, 9000, 330, 230),
    ],
)
def test_ordinary_cameras_pass_in_silence(values: tuple) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_camera(intrinsics_matrix(*values), SIZE)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=10,
)
NUMBERS = st.lists(st.floats() | st.integers(-3, 2000), min_size=4, max_size=4)


@given(given_=ANYTHING | NUMBERS | st.lists(NUMBERS, min_size=3, max_size=3))
@settings(deadline=None)
def test_whatever_is_given_is_a_camera_or_refused_in_words(given_: object) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            camera = read_camera(given_)
            check_camera(camera.K, SIZE)
        except (CameraError, FileNotFoundError):
            pass  # anything else is a mistake
        else:
            assert camera.K.diagonal().min() > 0


@given(content=ANYTHING, ending=st.sampled_from(["json", "yaml"]))
@settings(deadline=None)
def test_whatever_a_file_holds_is_a_camera_or_refused_in_words(tmp_path_factory, content, ending) -> None:
    path = tmp_path_factory.getbasetemp() / f"camera.{ending}"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CameraError, match=r"camera\.(json|yaml)( |:)"):
        read_camera(path)


@pytest.mark.parametrize("model", [{"projection_model_type": "CameraModelType.FISHEYE624"}, "fisheye"])
def test_scenes_of_a_fisheye_camera(model: object) -> None:
    with pytest.raises(
        BopError, match=r"image 3: fisheye cameras are not supported \(cam_model .*(?i:fisheye)"
    ):
        parse_intrinsics({"cam_model": model, "depth_scale": 1.0}, "image 3")


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_undistortion_is_opencvs(rng, count: int) -> None:
    all_14 = [0.3, -0.25, 0.002, -0.001, 0.05, 0.03, -0.02, 0.01, 0.002, -0.003, 0.001, 0.002, 0.02, -0.03]
    coefficients = np.array(all_14[:count])
    image = cv2.GaussianBlur(rng.random((120, 160, 3)).astype(np.float32), (0, 0), 3)
    camera = np.array([[150.0, 0, 80.5], [0, 152.0, 58.5], [0, 0, 1]])
    expected = cv2.undistort(image, camera, coefficients)
    ours = undistort_image(
        torch.from_numpy(image).permute(2, 0, 1)[None].double(),
        torch.from_numpy(camera)[None],
        torch.from_numpy(coefficients)[None],
    )[0].permute(1, 2, 0)
    inside = np.s_[8:-8, 8:-8]  # cv2 interpolates with 1/32 px, and blends with black at the border
    assert np.abs(ours.numpy() - expected)[inside].max() < 2e-3
    assert np.abs(image - expected)[inside].max() > 0.05
