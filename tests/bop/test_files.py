import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from PIL import Image

from foundpose.bop import PictureError, Target, read_depth, read_image, read_mask
from foundpose.bop.files import JsonCache

CONF = Path(__file__).resolve().parents[2] / "conf"


def test_cache_is_bounded_and_keeps_what_is_used(tmp_path, monkeypatch):
    paths = [tmp_path / f"{i}.json" for i in range(4)]
    for i, path in enumerate(paths):
        path.write_text(json.dumps([i] * 100))
    reads = []
    monkeypatch.setattr(
        "foundpose.bop.files.read_json", lambda p: reads.append(p.stem) or json.loads(p.read_text())
    )
    cache = JsonCache(max_bytes=2 * os.path.getsize(paths[0]))
    for i in (0, 1, 0, 2, 0, 1):
        assert cache.read(paths[i])[0] == i
    # 2 put out 1, which was used longest ago, and 1 put out 2.
    assert reads == ["0", "1", "2", "1"]
    cache.max_bytes = 1
    assert [cache.read(paths[3]), cache.read(paths[3])] == [[3] * 100] * 2
    assert reads[4:] == ["3"]
    paths[3].unlink()
    with pytest.raises(FileNotFoundError):
        JsonCache().read(paths[3])


def test_pictures_of_all_kinds(tmp_path, rng):
    pixels = rng.integers(0, 256, (5, 7, 4), dtype=np.uint8)
    for name, array in {
        "rgb.png": pixels[..., :3],
        "rgba.png": pixels,
        "grey.png": pixels[..., 0],
        "grey.tif": pixels[..., 0],
        "deep.png": pixels[..., 0].astype(np.uint16) * 257,
    }.items():
        Image.fromarray(array).save(tmp_path / name)
        expected = pixels[..., :3] if name.startswith("rgb") else np.repeat(pixels[..., :1], 3, -1)
        if name == "rgba.png":
            expected = expected * (pixels[..., 3:] / 255.0)
        got = read_image(tmp_path / name)
        assert torch.allclose(got, torch.from_numpy(expected / 255.0).permute(2, 0, 1).float(), atol=1e-6), (
            name
        )
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(PictureError, match="not a readable image"):
        read_image(tmp_path / "text.png")
    with pytest.raises(FileNotFoundError, match=r"no image at .* holds deep\.png"):
        read_image(tmp_path / "missing.png")
    with pytest.raises(PictureError, match=r"is 7x5 px, its image 8x5 px"):
        read_mask(tmp_path / "grey.png", (5, 8))
    Image.fromarray(np.zeros((5, 7), np.uint8)).save(tmp_path / "black.png")
    with pytest.raises(PictureError, match=r"is empty: .* brightest is 0 of 255"):
        read_mask(tmp_path / "black.png")


def test_depth_images_of_all_kinds(tmp_path, rng):
    values = rng.integers(0, 65536, (5, 7)).astype(np.uint16)
    for name in ("depth.png", "depth.tif"):
        Image.fromarray(values).save(tmp_path / name)
        got = read_depth(tmp_path / name, 0.1, (5, 7))
        assert got.dtype == torch.float32
        assert np.array_equal(got.numpy(), values.astype(np.float32) * np.float32(0.1))
    with pytest.raises(PictureError, match=r"depth image .*depth.tif is 7x5 px, its image 7x6 px"):
        read_depth(tmp_path / "depth.tif", 1.0, (6, 7))
    Image.fromarray((values >> 8).astype(np.uint8)).save(tmp_path / "byte.png")
    with pytest.raises(PictureError, match=r"one channel of 16 bit \(its mode is 'L'"):
        read_depth(tmp_path / "byte.png", 1.0)
    Image.fromarray(np.full((5, 7), -1, np.int32)).save(tmp_path / "minus.tif")
    with pytest.raises(PictureError, match="negative or not finite"):
        read_depth(tmp_path / "minus.tif", 1.0)


# Folders and files of the core datasets as the benchmark distributes them.
LAYOUTS = {
    "lmo": ("models", "test", "rgb/000003.png", "depth/000003.png"),
    "tless": ("models_cad", "test_primesense", "rgb/000003.png", "depth/000003.png"),
    "tudl": ("models", "test", "rgb/000003.png", "depth/000003.png"),
    "icbin": ("models", "test", "rgb/000003.png", "depth/000003.png"),
    "itodd": ("models", "test", "gray/000003.tif", "depth/000003.tif"),
    "hb": ("models", "test_primesense", "rgb/000003.png", "depth/000003.png"),
    "ycbv": ("models", "test", "rgb/000003.png", "depth/000003.png"),
}


@pytest.mark.parametrize("name", sorted(LAYOUTS))
def test_layouts_of_the_core_datasets(name, tmp_path, monkeypatch, rng):
    models, split, picture, depth = LAYOUTS[name]
    root, scene = tmp_path / name, tmp_path / name / split / "000012"
    for folder in (root / models, root / "models_eval", (scene / picture).parent, (scene / depth).parent):
        folder.mkdir(parents=True)
    for folder in (models, "models_eval"):
        (root / folder / "models_info.json").write_text('{"5": {"diameter": 60.0}}')
        (root / folder / "obj_000005.ply").write_text("ply")
    grey = picture.startswith("gray")
    pixels = rng.integers(0, 256, (9, 16) if grey else (9, 16, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(scene / picture)
    Image.fromarray(rng.integers(0, 9999, (9, 16)).astype(np.uint16)).save(scene / depth)
    camera = {"cam_K": [20, 0, 8, 0, 20, 4, 0, 0, 1], "depth_scale": 0.1}
    (scene / "scene_camera.json").write_text(json.dumps({"3": camera}))
    (root / "test_targets_bop19.json").write_text(
        '[{"scene_id": 12, "im_id": 3, "obj_id": 5, "inst_count": 2}]'
    )
    monkeypatch.setenv("BOP_PATH", str(tmp_path))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        dataset = instantiate(compose("evaluate", [f"data={name}"]).data)
    assert dataset.targets() == [Target(12, 3, 5, 2)]
    image = dataset.image(12, 3)
    assert image.shape == (3, 9, 16)
    assert torch.equal((image[1] * 255).byte(), torch.from_numpy(pixels if grey else pixels[..., 1].copy()))
    assert dataset.image_size(12, 3) == (9, 16)
    assert dataset.depth(12, 3).shape == (9, 16)
    assert dataset.mesh_path(5) == root / models / "obj_000005.ply"
    assert dataset.evaluation_mesh_path(5) == root / "models_eval/obj_000005.ply"
