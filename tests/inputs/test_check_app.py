"""What experiments/check.py says of files, and its exit status."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foundpose.geometry import PerspectiveCrop, intrinsics_matrix
from foundpose.rendering import RaycastRenderer
from foundpose.rendering.silhouettes import fit_silhouette
from foundpose.synthetic import cluttered_scene, procedural_mesh
from tests.bop_dataset import write_ply

APP = Path(__file__).resolve().parents[2] / "experiments" / "check.py"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    mesh = procedural_mesh(1, subdivisions=4)
    scene = cluttered_scene(mesh, seed=51, occlusion=False)
    write_ply(folder / "cup.ply", mesh)
    Image.fromarray((scene.image * 255).round().byte().permute(1, 2, 0).numpy()).save(folder / "photo.png")
    Image.fromarray(scene.mask.numpy()).save(folder / "mask.png")
    Image.fromarray(~scene.mask.numpy()).save(folder / "inverse.png")
    K = scene.K
    arguments = {
        "image": folder / "photo.png",
        "mesh": folder / "cup.ply",
        "mask": folder / "mask.png",
        "intrinsics": f"[{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}]",
    }
    return folder, arguments, mesh, scene


def run(monkeypatch, capsys, output, **arguments) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of the app."""
    given = [f"{name}={value}" for name, value in arguments.items() if value is not None]
    monkeypatch.setattr(sys, "argv", ["check.py", *given, f"hydra.run.dir={output}"])
    monkeypatch.syspath_prepend(APP.parent)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    try:
        runpy.run_path(str(APP), run_name="__main__")
        status = 0
    except SystemExit as error:
        status = int(error.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_files_that_go_together(files, monkeypatch, capsys, tmp_path):
    _, arguments, _, scene = files
    status, out, err = run(monkeypatch, capsys, tmp_path, **arguments)
    assert (status, err) == (0, "")
    lines = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert "640x480 px (PNG, RGB), brightness" in lines["picture"]
    assert "colours of its surface" in lines["mesh"]
    assert "likely in millimetres" in lines["mesh"]
    assert "field of view 56° x 43°" in lines["camera"]
    assert f"{int(scene.mask.sum())} px" in lines["mask"]
    assert "the mask has the shape of the object" in lines["fit"]
    near, far = (float(word) for word in lines["fit"].split() if word.replace(".", "").isdigit())
    assert near < float(scene.T_camera_from_model[:3, 3].norm()) < far
    with Image.open(tmp_path / "check.png") as picture:
        assert picture.size == (640 + 240, 480)
        assert np.asarray(picture).std() > 20


def test_only_some_of_the_files(files, monkeypatch, capsys, tmp_path):
    _, arguments, *_ = files
    status, out, _ = run(monkeypatch, capsys, tmp_path, mesh=arguments["mesh"], color="[0.2,0.4,0.6]")
    assert status == 0
    assert out.startswith("mesh")
    assert not (tmp_path / "check.png").exists()
    status, out, _ = run(monkeypatch, capsys, tmp_path, image=arguments["image"], box="[100,50,40,30]")
    assert "box 40x30 px at (100, 50)" in out


def test_wrong_combinations_are_seen(files, monkeypatch, capsys, tmp_path):
    folder, arguments, *_ = files
    _, out, err = run(monkeypatch, capsys, tmp_path, **arguments | {"mask": folder / "inverse.png"})
    assert "the mask has the shape of the object" not in out
    assert "inverted" in err
    assert err.startswith("warning")
    _, out, err = run(monkeypatch, capsys, tmp_path, **arguments | {"intrinsics": "[1216,1216,639.5,479.5]"})
    assert "2 times as large? With the factor 0.5 they are [608,608,319.5,239.5]" in err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": None, "mesh": None, "mask": None, "intrinsics": None}, "give image=…"),
        ({"image": "lost.png"}, "no image at lost.png"),
        ({"mesh": "lost.ply"}, "mesh file lost.ply does not exist"),
        ({"mask": None, "box": "[1,2]"}, "box must be [x,y,width,height], got [1.0, 2.0]|box must be"),
        ({"box": "[1,2,3,4]"}, "give either mask=… (a picture) or box="),
        ({"intrinsics": "[1,2]"}, "intrinsics must be [fx,fy,cx,cy]"),
        ({"intrinsics": "lost.json"}, "no file of intrinsics lost.json"),
        ({"distortion": "[1,2]"}, "distortion must have 4, 5, 8, 12 or 14 coefficients, got 2"),
        ({"color": "[255,0,0]"}, "color must be [red,green,blue] in [0, 1]"),
        ({"color": "red"}, "color must be [red,green,blue] in [0, 1]"),
    ],
)
def test_unusable_input_is_one_line(files, monkeypatch, capsys, tmp_path, change, message):
    _, arguments, *_ = files
    status, _, err = run(monkeypatch, capsys, tmp_path, **arguments | change)
    assert status == 2
    assert any(part in err for part in message.split("|"))
    assert err.startswith("error: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize("seed", [3, 4])
def test_the_fit_finds_distance_and_shape(seed):
    mesh = procedural_mesh(seed, subdivisions=4)
    scene = cluttered_scene(mesh, seed=seed, occlusion=False)
    crops = PerspectiveCrop(size=96, fill=0.7)(scene.image[None], scene.K[None], scene.mask[None])
    fit = fit_silhouette(mesh, crops)
    distance = float(torch.linalg.vector_norm(scene.T_camera_from_model[:3, 3]))
    assert fit.nearest < distance < fit.farthest < 3 * fit.nearest
    assert fit.overlap > 0.85
    # Its pose shows that silhouette in the picture too.
    T, size = fit.T_camera_from_model[None], (480, 640)
    mask = RaycastRenderer(1)(mesh, T, scene.K[None], size).mask[0]
    overlap = float((mask & scene.mask).sum() / (mask | scene.mask).sum())
    assert overlap == pytest.approx(fit.overlap, abs=0.05)


def test_another_shape_does_not_fit():
    mesh = procedural_mesh(3, subdivisions=4)
    K = intrinsics_matrix(600.0, 600.0, 319.5, 239.5)[None]
    mask = torch.zeros(1, 480, 640, dtype=torch.bool)
    mask[:, 200:204, 100:400] = True
    crops = PerspectiveCrop(size=96, fill=0.7)(torch.zeros(1, 3, 480, 640), K, mask)
    assert fit_silhouette(mesh, crops).overlap < 0.5
