import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from foundpose.geometry import rotation_angle
from foundpose.visualization.templates import TemplateViewer, spread_templates

APP = Path(__file__).resolve().parents[2] / "experiments" / "view.py"


def lit(picture):
    return (np.asarray(picture).max(-1) > 0).mean()


def test_words_lie_where_the_object_is_seen(oracle_blob, blob):
    viewer = TemplateViewer(oracle_blob, blob)
    words, picture = np.asarray(viewer.words(3)), np.asarray(viewer.picture(3))
    a, b = words.max(-1) > 0, picture.max(-1) > 0
    assert (a & b).sum() / (a | b).sum() > 0.7
    assert len(np.unique(words.reshape(-1, 3), axis=0)) > 10
    assert TemplateViewer(oracle_blob).picture(3) is None


def test_the_grid_has_all_templates_with_and_without_a_mesh(oracle_blob, blob):
    bare, rendered = (TemplateViewer(oracle_blob, mesh).grid(range(10), columns=5) for mesh in (None, blob))
    assert bare.width == pytest.approx(rendered.width, abs=1)
    assert rendered.height > 1.5 * bare.height
    assert lit(rendered) > 0.1


def test_spread_templates_are_far_apart(oracle_blob):
    chosen = spread_templates(oracle_blob, 12)
    assert len(set(chosen)) == 12
    R = oracle_blob.T_template_from_model[chosen, :3, :3].float()
    apart = rotation_angle(R[:, None].expand(-1, 12, -1, -1), R[None].expand(12, -1, -1, -1))
    assert torch.rad2deg(apart + 9 * torch.eye(12)).min() > 50
    assert len(spread_templates(oracle_blob, 1000)) == oracle_blob.num_templates


def test_the_turntable_shows_the_object_from_all_around(oracle_blob, blob):
    still = TemplateViewer(oracle_blob).turntable(4, side=80)
    assert [frame.size for frame in still] == [(80, 80)] * 4
    assert all(0.1 < lit(frame) < 0.9 for frame in still)
    # Where a mesh is rendered beside the points, both cover the same pixels.
    frame = np.asarray(TemplateViewer(oracle_blob, blob).turntable(1, side=80)[0]).max(-1) > 0
    left, right = frame[:, :80], frame[:, -80:]
    assert (left & right).sum() / (left | right).sum() > 0.8


def test_the_command_names_a_file_and_writes_pictures(oracle_blob, tmp_path, monkeypatch, capsys):
    oracle_blob.save(tmp_path / "blob.safetensors")
    arguments = [f"{tmp_path}/blob.safetensors", "templates=4", "neighbours=1", "frames=3"]
    monkeypatch.setattr(sys, "argv", ["view.py", *arguments, f"hydra.run.dir={tmp_path / 'out'}"])
    runpy.run_path(str(APP), run_name="__main__")
    assert "blob: 100 templates" in capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "out").iterdir() if path.suffix in (".png", ".webp"))
    assert names == ["neighbours_0.png", "templates.png", "turntable.webp"]
    assert Image.open(tmp_path / "out" / "turntable.webp").n_frames == 3
    monkeypatch.setattr(sys, "argv", ["view.py", f"hydra.run.dir={tmp_path / 'none'}"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(APP), run_name="__main__")
    assert ended.value.code == 2
    assert "give the file of a representation" in capsys.readouterr().err
