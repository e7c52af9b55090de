import json
import math
import re
import runpy
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from foundpose.bop import BopDataset, read_results
from foundpose.geometry import rotation_angle
from foundpose.synthetic import cluttered_scene, procedural_mesh
from tests.bop_dataset import write_ply
from tests.processes import finish, kill_when, start_app

ROOT = Path(__file__).resolve().parents[2]
# Small, but everything is in it.
SMALL = ["viewpoints.count=60", "words.num_words=128", "projection.num_components=64"]


def run_app(monkeypatch, name, *overrides):
    """Run an app in this process as the command line would, with the rounding of one that has a single thread."""
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *overrides])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        runpy.run_path(str(ROOT / "experiments" / f"{name}.py"), run_name="__main__")
    finally:
        torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def own_picture(tmp_path_factory):
    """A photograph, a mask and a mesh as files, and the truth.

    The picture is taken from near one of the few templates, which SIFT retrieves with the mask and with the box
    alike: what is tested here is the app, not the descriptor.
    """
    folder = tmp_path_factory.mktemp("own")
    mesh = procedural_mesh(1, subdivisions=5)
    scene = cluttered_scene(mesh, seed=1076)
    write_ply(folder / "cup.ply", mesh)
    pixels = (scene.image * 255).round().byte().permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(folder / "photo.png")
    Image.fromarray(scene.mask.numpy()).save(folder / "mask.png")
    K = scene.K
    arguments = [
        f"image={folder / 'photo.png'}",
        f"mesh={folder / 'cup.ply'}",
        f"intrinsics=[{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}]",
        "extractor=dense_sift",
        "crop.size=280",
        "viewpoints.count=60",
        "words.num_words=512",
        f"representations={folder / 'representations'}",
    ]
    return folder, scene, mesh, arguments


def pose_error(output, scene, mesh):
    facts = json.loads((output / "estimate.json").read_text())
    T = scene.T_camera_from_model.double()
    angle = torch.rad2deg(rotation_angle(torch.tensor(facts["R"]).double(), T[:3, :3]))
    return float(angle), float((torch.tensor(facts["t"]) - T[:3, 3]).norm() / mesh.diameter)


def test_own_picture_with_mask_box_and_distortion(own_picture, monkeypatch, tmp_path, capsys):
    folder, scene, mesh, arguments = own_picture
    run_app(
        monkeypatch, "estimate", *arguments, f"mask={folder / 'mask.png'}", f"hydra.run.dir={tmp_path / 'a'}"
    )
    angle, distance = pose_error(tmp_path / "a", scene, mesh)
    assert angle < 4
    assert distance < 0.1
    assert (tmp_path / "a" / "overlay.png").stat().st_size > 10_000
    (line,) = read_results(tmp_path / "a" / "results.csv")
    assert line.score > 0

    # Another picture's result in the same folder would replace this one.
    with pytest.raises(SystemExit):
        run_app(monkeypatch, "estimate", *arguments, "box=[1,2,30,40]", f"hydra.run.dir={tmp_path / 'a'}")
    assert "holds a run with other settings" in capsys.readouterr().err

    rows, columns = torch.nonzero(scene.mask, as_tuple=True)
    box = [
        int(v)
        for v in (columns.min(), rows.min(), columns.max() - columns.min() + 1, rows.max() - rows.min() + 1)
    ]
    run_app(monkeypatch, "estimate", *arguments, f"box={box}", f"hydra.run.dir={tmp_path / 'b'}")
    angle, distance = pose_error(tmp_path / "b", scene, mesh)
    assert angle < 6
    assert distance < 0.15

    # The same photograph through a lens: distort it with OpenCV's model, then let the app undo it.
    K = scene.K.numpy().astype(np.float64)
    coefficients = np.array([-0.28, 0.09, 0.001, -0.0015, 0.0])
    height, width = scene.mask.shape
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 1, 2).astype(np.float64)
    source = cv2.undistortPoints(grid, K, coefficients, P=K).reshape(height, width, 2).astype(np.float32)
    for name in ("photo", "mask"):
        picture = np.asarray(Image.open(folder / f"{name}.png").convert("RGB"))
        bent = cv2.remap(picture, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
        Image.fromarray(bent).save(tmp_path / f"{name}.png")
    run_app(
        monkeypatch,
        "estimate",
        *arguments,
        f"image={tmp_path / 'photo.png'}",
        f"mask={tmp_path / 'mask.png'}",
        f"distortion={coefficients.tolist()}",
        f"hydra.run.dir={tmp_path / 'c'}",
    )
    angle, distance = pose_error(tmp_path / "c", scene, mesh)
    assert angle < 5
    assert distance < 0.12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["mask=a.png", "box=[1,2,3,4]"], "give either mask=… (a picture) or box=[x,y,width,height]"),
        (["meshes=[cup.ply]"], "give either mesh=cup.ply or meshes=[cup.ply,box.ply], not both"),
        (["instances=0"], "instances must be a number of at least 1"),
        (["instances=[1,2]"], "one for each of the 1 meshes"),
        (["step=0"], "step must be a whole number of at least 1, got 0"),
        (["mask=none.png"], "no image at none.png"),
        (["box=[1,2,3]"], "box must be [x,y,width,height], got [1, 2, 3]"),
        (["intrinsics=null", "box=[1,2,3,4]"], "give intrinsics=… too"),
        (
            ["intrinsics=[600]", "box=[1,2,3,4]"],
            "intrinsics must be [fx,fy,cx,cy] in pixels, a 3x3 matrix, or a file",
        ),
        (
            ["intrinsics=600", "box=[1,2,3,4]"],
            "or a file (BOP's camera.json, a camera_info YAML of ROS), got 600",
        ),
        (["intrinsics=[0,0,0,0]", "box=[1,2,3,4]"], "focal lengths must be positive, got fx=0, fy=0"),
        (["box=5"], "box must be [x,y,width,height], got 5"),
        (["box=[900,2,3,4]"], "holds no pixel of the image, which is 640x480 px"),
        (["box=[1,2,30,40]", "device=gpu"], "device must be cpu, cuda, cuda:1 or mps, got 'gpu'"),
        (["box=[1,2,30,40]", "extractor=dinov2_vits14", "extractor.layer=50"], "layer must be in 0..11"),
        (["box=[1,2,30,40]", "projection.num_components=999"], "descriptors have 256 channels"),
        (["mesh=none.ply", "box=[1,2,30,40]"], "none.ply"),
        (
            ["distortion=[0.1]", "box=[1,2,30,40]"],
            "distortion must have 4, 5, 8, 12 or 14 coefficients, got 1",
        ),
        (["device=cuda", "box=[1,2,30,40]"], "use device=cpu"),
    ],
)
def test_bad_input_is_one_clear_line(own_picture, monkeypatch, tmp_path, capsys, change, message):
    _, _, _, arguments = own_picture
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(SystemExit) as stop:
        run_app(monkeypatch, "estimate", *arguments, *change, f"hydra.run.dir={tmp_path}")
    assert stop.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: ")
    assert message in lines[-1]
    assert not (tmp_path / "estimate.json").exists()


def test_missing_weights_say_how_to_get_them(own_picture, monkeypatch, tmp_path, capsys):
    _, _, _, arguments = own_picture
    with pytest.raises(SystemExit) as stop:
        run_app(
            monkeypatch,
            "estimate",
            *arguments,
            "box=[1,2,30,40]",
            "extractor=dinov2",
            "extractor.variant=vits14_reg",
            f"extractor.weights={tmp_path / 'dinov2_vits14_reg4_pretrain.pth'}",
            f"hydra.run.dir={tmp_path}",
        )
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert "error: " in message
    assert "dinov2_vits14_reg4_pretrain.pth" in message
    assert "hf download" in message
    assert "\\n" not in message


def test_an_improbable_pose_is_not_found(own_picture, monkeypatch, tmp_path, capsys):
    """A calibration that believes nothing; without a least probability the pose is shown all the same."""
    folder, _, _, arguments = own_picture
    unbelieving = ["+confidence._target_=foundpose.pipeline.PoseConfidence", "+confidence.weights={}"]
    arguments = [*arguments, f"mask={folder / 'mask.png'}", *unbelieving, "+confidence.bias=-3"]
    with pytest.raises(SystemExit) as stop:
        run_app(monkeypatch, "estimate", *arguments, f"hydra.run.dir={tmp_path / 'held'}")
    assert stop.value.code == 1
    message = "not found: UNLIKELY, the pose is right with a probability of 0.05 only (min_confidence=0.3)"
    assert message in capsys.readouterr().err
    facts = json.loads((tmp_path / "held" / "estimate.json").read_text())
    assert (facts["valid"], facts["status"]) == (False, "UNLIKELY")
    assert facts["probability"] == pytest.approx(1 / (1 + math.exp(3)))
    assert read_results(tmp_path / "held" / "results.csv") == []
    run_app(monkeypatch, "estimate", *arguments, "min_confidence=0", f"hydra.run.dir={tmp_path / 'shown'}")
    assert len(read_results(tmp_path / "shown" / "results.csv")) == 1


def test_a_picture_without_a_pose_is_a_failure(own_picture, monkeypatch, tmp_path, capsys):
    _, _, _, arguments = own_picture
    # A single pixel is no region to look at.
    with pytest.raises(SystemExit) as stop:
        run_app(monkeypatch, "estimate", *arguments, "box=[5,5,1,1]", f"hydra.run.dir={tmp_path}")
    assert stop.value.code == 1
    assert "not found: UNUSABLE_MASK" in capsys.readouterr().err
    assert json.loads((tmp_path / "estimate.json").read_text())["valid"] is False
    assert read_results(tmp_path / "results.csv") == []


def bop_arguments(root, representations):
    return [
        "experiment=oracle",
        f"data.root={root}",
        *SMALL,
        f"representations={representations}",
        "overlays=3",
        "masks=cnos",
    ]


@pytest.fixture(scope="module")
def left_alone(tiny_bop, representations, tmp_path_factory):
    """Folder of a run that nobody interrupted."""
    folder = tmp_path_factory.mktemp("alone")
    arguments = [*bop_arguments(tiny_bop, representations), f"hydra.run.dir={folder}"]
    with pytest.MonkeyPatch.context() as monkeypatch:
        run_app(monkeypatch, "estimate", *arguments)
    return folder


def test_bop_dataset_with_both_kinds_of_masks(tiny_bop, left_alone, representations, monkeypatch, tmp_path):
    arguments = bop_arguments(tiny_bop, representations)
    run_app(monkeypatch, "estimate", *arguments, "masks=gt", f"hydra.run.dir={tmp_path}")
    for masks, output in (("gt", tmp_path), ("cnos", left_alone)):
        results = read_results(output / "oracle_tiny-test.csv")
        assert [(r.scene_id, r.im_id, r.obj_id) for r in results] == [(1, 0, 1), (1, 1, 2), (1, 2, 1)]
        dataset = BopDataset(tiny_bop)
        for result in results:
            (truth,) = dataset.annotations(result.scene_id, result.im_id)
            R = truth.T_camera_from_model[:3, :3]
            assert torch.rad2deg(rotation_angle(result.T_camera_from_model[:3, :3], R)) < 3
            assert result.time >= (0.25 if masks == "cnos" else 0)
        assert [p.name for p in (output / "overlays").iterdir()] == ["000001_000000_000001_0.png"]


def test_a_run_is_resumed_and_guarded(tiny_bop, representations, monkeypatch, tmp_path, capsys):
    output = tmp_path / "run"
    arguments = [*bop_arguments(tiny_bop, representations), f"hydra.run.dir={output}"]
    run_app(monkeypatch, "estimate", *arguments, "max_images=2")
    shards = sorted((output / "images").iterdir())
    assert len(shards) == 2
    before = [shard.stat().st_mtime_ns for shard in shards]
    run_app(monkeypatch, "estimate", *arguments)
    assert [shard.stat().st_mtime_ns for shard in shards] == before
    assert len(read_results(output / "oracle_tiny-test.csv")) == 3
    with pytest.raises(SystemExit):
        run_app(monkeypatch, "estimate", *arguments, "pnp.iterations=50")
    assert "holds a run with other settings" in capsys.readouterr().err


def test_meshes_in_another_unit_and_unknown_objects_are_refused(tiny_bop, monkeypatch, tmp_path, capsys):
    root = shutil.copytree(tiny_bop, tmp_path / "data")
    info = {str(i): {"diameter": 0.12} for i in (1, 2)}
    (root / "models" / "models_info.json").write_text(json.dumps(info))
    arguments = [*bop_arguments(root, tmp_path / "representations"), f"hydra.run.dir={tmp_path / 'run'}"]
    for change, message in (
        ([], "are they in the same unit?"),
        (["objects=[7]"], "objects must be a list of ids from [1, 2]"),
        (["objects=5"], "objects must be a list of ids from [1, 2]"),
        ([f"data.root={tmp_path / 'nowhere'}"], "no BOP dataset at"),
    ):
        with pytest.raises(SystemExit) as stop:
            run_app(monkeypatch, "estimate", *arguments, *change)
        assert stop.value.code == 2
        assert message in capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.slow
def test_killed_onboarding_and_estimation_lose_nothing(tiny_bop, left_alone, tmp_path):
    """Kill the process at its first written file, start it again, and compare with a run left alone."""
    victim, log = tmp_path / "victim", tmp_path / "log"
    arguments = [
        *bop_arguments(tiny_bop, victim / "representations"),
        f"hydra.run.dir={victim / 'run'}",
    ]
    for pattern in ("representations/*.safetensors", "run/images/*.json"):
        kill_when(start_app("estimate", arguments, log), lambda pattern=pattern: any(victim.glob(pattern)))
        assert not (victim / "run" / "oracle_tiny-test.csv").exists()
    finish(start_app("estimate", arguments, log), log)
    rows = [
        [line.split(",")[:-1] for line in (folder / "oracle_tiny-test.csv").read_text().splitlines()]
        for folder in (victim / "run", left_alone)
    ]
    assert rows[0] == rows[1]
    assert len(rows[0]) == 4


def test_onboard_skips_what_is_there(tiny_bop, monkeypatch, tmp_path, capsys):
    arguments = [
        "experiment=oracle",
        *SMALL,
        "viewpoints.count=12",
        f"representations={tmp_path}",
        f"hydra.run.dir={tmp_path / 'log'}",
    ]
    run_app(monkeypatch, "onboard", *arguments, f"data.root={tiny_bop}", "objects=[2]")
    out = capsys.readouterr().out
    assert re.search(r"tiny-000002: onboarded in [\d.]+ s \(rendering [\d.]+ s, .*\), 12 templates", out)
    run_app(monkeypatch, "onboard", *arguments, f"data.root={tiny_bop}")
    out = capsys.readouterr().out
    assert "tiny-000001: onboarded" in out
    assert "tiny-000002: already there" in out
    mesh = tiny_bop / "models" / "obj_000001.ply"
    run_app(monkeypatch, "onboard", *arguments, f"mesh={mesh}")
    assert "obj_000001: onboarded" in capsys.readouterr().out
    assert len(list(tmp_path.glob("*.safetensors"))) == 3
    with pytest.raises(SystemExit):
        run_app(monkeypatch, "onboard", *arguments, "mesh=none.ply")
    assert "error: " in capsys.readouterr().err


def test_objects_are_found_in_a_folder_and_a_video(own_picture, monkeypatch, tmp_path, capsys):
    """Without a mask: in pictures of a folder, of which one shows nothing, and in every second frame of a video."""
    folder, scene, _, (image, _, *arguments) = own_picture
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    shutil.copy(image.removeprefix("image="), pictures / "a.png")
    Image.new("RGB", (640, 480), (90, 90, 90)).save(pictures / "b.png")
    few = ["detector.candidates=8", "detector.max_detections=2", "detector.dense.scales=[1]"]
    arguments = [*arguments, *few, f"meshes=[{folder / 'cup.ply'}]"]
    run = [*arguments, f"image={pictures}", f"hydra.run.dir={tmp_path / 'run'}"]
    run_app(monkeypatch, "estimate", *run)
    entries = json.loads((tmp_path / "run" / "estimates.json").read_text())
    (best,) = [entry for entry in entries if entry["picture"] == "a"]
    center = torch.tensor(best["t"]) / best["t"][2]
    u, v = (scene.K @ center.float())[:2].tolist()
    assert bool(scene.mask[round(v), round(u)])  # it is where the object is
    drawn = np.asarray(Image.open(tmp_path / "run" / "overlays" / "a.png")).astype(int)
    assert np.abs(drawn - np.asarray(Image.open(pictures / "a.png"))).sum() > 10_000
    assert len(read_results(tmp_path / "run" / "results.csv")) == len(entries)
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    shown = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert shown is not None
    cases = json.loads(shown[1])
    assert len(cases["rows"]) == len(cases["thumbnails"]) == len(cases["figures"]) == len(entries)
    assert [row["score"] for row in cases["rows"]] == sorted(entry["score"] for entry in entries)

    # What is done is not repeated.
    before = (tmp_path / "run" / "pictures" / "a.json").stat().st_mtime_ns
    run_app(monkeypatch, "estimate", *run)
    assert (tmp_path / "run" / "pictures" / "a.json").stat().st_mtime_ns == before

    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (160, 120))
    for _ in range(3):
        film.write(np.full((120, 160, 3), 90, np.uint8))
    film.release()
    with pytest.raises(SystemExit) as ended:  # nothing is in it
        run_app(
            monkeypatch,
            "estimate",
            *arguments,
            f"image={tmp_path / 'film.avi'}",
            "intrinsics=[150,150,80,60]",
            "step=2",
            "proposer.min_patches=10000",
            f"hydra.run.dir={tmp_path / 'film'}",
        )
    assert ended.value.code == 1
    assert sorted(p.name for p in (tmp_path / "film" / "pictures").iterdir()) == [
        "film_000000.json",
        "film_000002.json",
    ]
    assert "not found: " in capsys.readouterr().err


@pytest.mark.slow
def test_detect_and_evaluate_what_was_found(representations, tiny_bop, monkeypatch, tmp_path, capsys):
    """From pictures to scores, where the regions are those of a file that does not say what they show."""
    proposals = tiny_bop / "detections" / "cnos-fastsam" / "detections.json"
    arguments = [
        *(a for a in bop_arguments(tiny_bop, representations) if not a.startswith(("masks", "overlays"))),
        "proposer=file",
        f"proposer.path={proposals}",
    ]
    run_app(monkeypatch, "detect", *arguments, f"hydra.run.dir={tmp_path / 'detect'}")
    scores = json.loads((tmp_path / "detect" / "detection_scores.json").read_text())
    # The objects have the same codes of coordinates, so each is also found where only the other is.
    assert scores["segm"]["AP"] > 0.6
    assert len(list((tmp_path / "detect" / "overlays").iterdir())) == 3
    assert "AP_segm" in capsys.readouterr().out

    run_app(
        monkeypatch,
        "evaluate",
        *arguments,
        "masks=detect",
        "errors=[mspd]",
        f"hydra.run.dir={tmp_path / 'run'}",
    )
    records = json.loads((tmp_path / "run" / "estimates.json").read_text())
    assert {(r["im_id"], r["obj_id"]) for r in records if r["valid"]} >= {(0, 1), (1, 2), (2, 1)}
    found = json.loads((tmp_path / "run" / "detections.json").read_text())
    assert sorted(e["score"] for e in found) == pytest.approx(
        sorted(e["score"] for e in json.loads((tmp_path / "detect" / "detections.json").read_text()))
    )
    assert json.loads((tmp_path / "run" / "scores.json").read_text())["AR_MSPD"] > 0.6
