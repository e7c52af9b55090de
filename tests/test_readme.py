import re
from pathlib import Path

import torch
from PIL import Image

from foundpose.geometry import rotation_angle
from foundpose.synthetic import cluttered_scene, procedural_mesh
from tests.bop_dataset import write_ply

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def test_the_python_example_runs(tmp_path, monkeypatch, capsys):
    code, training = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    statements = [line for line in code.splitlines() if line and not line.startswith(("import", "from"))]
    assert len(statements) <= 10
    mesh = procedural_mesh(1, subdivisions=5)
    scene = cluttered_scene(mesh, seed=1076)  # taken from near a template
    write_ply(tmp_path / "cup.ply", mesh)
    Image.fromarray((scene.image * 255).round().byte().permute(1, 2, 0).numpy()).save(tmp_path / "photo.png")
    Image.fromarray(scene.mask.numpy()).save(tmp_path / "mask.png")
    # Fewer and smaller templates, fewer words, and this picture's camera; all else as it stands there.
    K = scene.K
    for old, new in {
        "SuperFibonacci(800)": "SuperFibonacci(60)",
        "VisualWords(2048), bow": "VisualWords(512), bow, image_size=280",
        "PerspectiveCrop()": "PerspectiveCrop(280)",
        "(600, 600, 319.5, 239.5)": f"({K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]})",
    }.items():
        assert old in code
        code = code.replace(old, new)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    poses = names["poses"]
    assert poses.valid[0]
    R = scene.T_camera_from_model[:3, :3]
    assert torch.rad2deg(rotation_angle(poses.T_camera_from_model[0, :3, :3], R)) < 10
    assert "tensor" in capsys.readouterr().out
    names |= {"T_true": scene.T_camera_from_model, "diameter": torch.tensor([mesh.diameter])}
    exec(compile(training, "README.md", "exec"), names)
    assert 0 < names["loss"].item() < 0.2
    assert names["image"].grad.isfinite().all()
    assert names["image"].grad.abs().max() > 0
