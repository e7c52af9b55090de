import runpy
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from PIL import Image

from foundpose.bop import BopDataset
from foundpose.rendering import RaycastRenderer
from foundpose.synthetic import cluttered_scene, procedural_mesh

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "experiments" / "assets"
# The default extractor would be downloaded.
OFFLINE = ["extractor=dense_sift"]
SMALL = ["viewpoints.count=12", "words.num_words=32", "projection.num_components=32"]


def load(*overrides):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("demo", overrides=[*OFFLINE, *overrides])


def run_demo(monkeypatch, *overrides):
    """Run the demo in this process as the command line would; its exit status."""
    monkeypatch.setattr(sys, "argv", ["demo.py", *overrides])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    try:
        runpy.run_path(str(ROOT / "experiments" / "demo.py"), run_name="__main__")
    except SystemExit as stop:
        return stop.code
    return 0


@pytest.fixture(scope="module")
def can():
    return instantiate(load().scene)


def test_assets_are_small_and_credited():
    assert {path.name for path in ASSETS.iterdir()} == {"README.md", "can.png", "can_mask.png", "can.ply"}
    assert sum(path.stat().st_size for path in ASSETS.iterdir()) <= 2_000_000
    text = (ASSETS / "README.md").read_text()
    for credit in (
        "CC BY-SA 4.0",
        "https://creativecommons.org/licenses/by-sa/4.0/",
        "Hinterstoisser",
        "Brachmann",
        "LM-O",
    ):
        assert credit in text


def test_the_true_pose_covers_the_mask(can):
    height, width = can.mask.shape
    assert tuple(can.image.shape) == (3, height, width) == (3, 480, 640)
    assert can.mesh.diameter == pytest.approx(201.404, rel=1e-4)  # as published
    assert can.mesh.vertex_colors.std() > 0.01
    R = can.T_camera_from_model[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3), atol=1e-5, rtol=0)
    render = RaycastRenderer()(can.mesh, can.T_camera_from_model[None], can.K[None], (height, width))
    silhouette = render.mask[0]
    overlap = (silhouette & can.mask).sum() / (silhouette | can.mask).sum()
    assert overlap > 0.97
    # The picture shows the can there: it is much brighter than what lies around it.
    assert can.image[:, can.mask].mean() > 1.5 * can.image[:, ~can.mask].mean()


def test_files_are_found_from_everywhere_and_the_working_directory_comes_first(can, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert torch.equal(instantiate(load().scene).image, can.image)
    mine = tmp_path / "experiments" / "assets" / "can_mask.png"
    mine.parent.mkdir(parents=True)
    Image.new("L", (640, 480), 255).save(mine)
    assert bool(instantiate(load().scene).mask.all())


def test_procedural_is_what_it_was():
    cfg = load("scene=procedural", "seed=4")
    scene = instantiate(cfg.scene)
    mesh = procedural_mesh(4)
    expected = cluttered_scene(mesh, 4)
    assert scene.mesh.checksum == mesh.checksum
    assert torch.equal(scene.image, expected.image)
    assert torch.equal(scene.mask, expected.mask)
    assert torch.equal(scene.T_camera_from_model, expected.T_camera_from_model)
    assert (cfg.crop.background, cfg.viewpoints.count, cfg.words.num_words) == ("keep", 300, 1024)
    assert (cfg.max_rotation, cfg.max_translation) == (10.0, 0.1)
    assert cfg.refiner._target_.endswith("FeaturemetricRefiner")
    photograph = load("extractor=dinov2_vits14_wheel")
    assert (photograph.crop.background, photograph.max_rotation, photograph.max_translation) == (
        "black",
        15.0,
        0.1,
    )


def test_a_picture_of_a_dataset(tiny_bop):
    overrides = ["scene=bop", "data=bop", f"data.root={tiny_bop}", "scene.scene_id=1", "scene.im_id=1"]
    scene = instantiate(load(*overrides, "scene.obj_id=2").scene)
    dataset = BopDataset(tiny_bop)
    (truth,) = dataset.annotations(1, 1)
    torch.testing.assert_close(scene.T_camera_from_model, truth.T_camera_from_model.float())
    assert torch.equal(scene.image, dataset.image(1, 1))
    assert torch.equal(scene.mask, dataset.visible_mask(1, 1, truth.index))
    assert scene.name == f"{dataset.name}-000002"
    with pytest.raises(Exception, match="object 1 is not in image 1 of scene 1"):
        instantiate(load(*overrides, "scene.obj_id=1").scene)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["scene.image=none.png"], "no image at none.png"),
        (["scene.mesh=none.ply"], "mesh file none.ply does not exist"),
        (["scene.mask=small.png"], "the mask small.png is 64x48 px, its image 640x480 px"),
        (["scene.mask=black.png"], "the mask black.png is empty"),
        (["scene.intrinsics=[600]"], "intrinsics must be 4 numbers, got [600]"),
        (["scene.intrinsics=600"], "intrinsics must be 4 numbers, got 600"),
        (["scene.intrinsics=[0,1,2,3]"], "focal lengths must be positive, got fx=0.0, fy=1.0"),
        (["scene.translation=[a,b,c]"], "translation must be 3 numbers, got ['a', 'b', 'c']"),
        (["scene.rotation=[1,0,0,0,1,0,0,0,2]"], "rotation must be that of a rotation matrix, row by row"),
        (["scene.rotation=[1,0,0,0,1,0,0,0,-1]"], "rotation must be that of a rotation matrix, row by row"),
        (["scene=bop", "data=lmo", "data.root=nowhere"], "no BOP dataset at"),
    ],
)
def test_bad_input_is_one_clear_line(monkeypatch, tmp_path, capsys, change, message):
    monkeypatch.chdir(tmp_path)
    Image.new("L", (64, 48), 255).save("small.png")
    Image.new("L", (640, 480), 0).save("black.png")
    assert run_demo(monkeypatch, *OFFLINE, *change, f"hydra.run.dir={tmp_path / 'out'}") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line


def test_the_photograph_runs_from_end_to_end(monkeypatch, tmp_path, capsys):
    # A random network of one layer: all stages run, and the pose means nothing.
    arguments = [
        "extractor=dinov2",
        "extractor.weights=random",
        "extractor.seed=0",
        "extractor.config={hidden_size: 48, num_attention_heads: 2, num_hidden_layers: 1}",
        *SMALL,
        f"representations={tmp_path / 'representations'}",
        f"hydra.run.dir={tmp_path / 'out'}",
    ]
    assert run_demo(monkeypatch, *arguments) in (0, 1)
    captured = capsys.readouterr()
    steps = [line for line in captured.err.splitlines() if line[1:2] == "/"]
    assert [step[:3] for step in steps] == ["1/4", "2/4", "3/4", "4/4"]
    assert "loading the extractor dinov2" in steps[0]
    assert "download" not in steps[0]
    assert "onboarding can" in steps[1]
    assert captured.out.splitlines()[-1] in ("pose: right", "pose: WRONG")
    width, height = Image.open(tmp_path / "out" / "overlay.png").size
    assert min(width, height) > 600

    assert run_demo(monkeypatch, *arguments) in (0, 1)
    assert "2/4 can was onboarded before" in capsys.readouterr().err


def test_the_procedural_demo_fails_when_the_pose_is_wrong(monkeypatch, tmp_path, capsys):
    # Three templates do not show the side that the picture shows.
    arguments = ["scene=procedural", *OFFLINE, "viewpoints.count=3", "words.num_words=32"]
    status = run_demo(
        monkeypatch, *arguments, f"representations={tmp_path}", f"hydra.run.dir={tmp_path / 'out'}"
    )
    assert status == 1
    out = capsys.readouterr().out
    assert "pose: WRONG" in out
    assert "rotation error: " in out
    assert (tmp_path / "out" / "overlay.png").stat().st_size > 10_000
