import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from foundpose.bop import BopDataset, BopError, read_image, read_mask


def test_reads_what_was_written(tiny_bop):
    dataset = BopDataset(tiny_bop)
    assert dataset.object_ids == [1, 2]
    assert [tuple(t) for t in dataset.targets()] == [(1, 0, 1, 1), (1, 1, 2, 1), (1, 2, 1, 1)]
    truth = json.loads((tiny_bop / "test/000001/scene_gt.json").read_text())["1"][0]
    (annotation,) = dataset.annotations(1, 1)
    assert annotation.obj_id == 2
    assert annotation.T_camera_from_model[:3, :3].flatten().tolist() == truth["cam_R_m2c"]
    assert annotation.T_camera_from_model[:3, 3].tolist() == truth["cam_t_m2c"]
    assert annotation.visible_fraction == 0.88
    assert dataset.intrinsics(1, 0)[2].tolist() == [0, 0, 1]
    image = dataset.image(1, 0)
    assert image.shape == (3, 480, 640)
    assert dataset.image_size(1, 0) == (480, 640)
    reference = np.asarray(Image.open(tiny_bop / "test/000001/rgb/000000.png"))
    assert torch.equal((image * 255).round().byte().permute(1, 2, 0), torch.from_numpy(reference.copy()))
    mask = dataset.visible_mask(1, 0, 0)
    assert mask.dtype == torch.bool
    assert 1000 < mask.sum() < 480 * 640 / 3


def test_works_without_ground_truth(tiny_bop, tmp_path):
    root = shutil.copytree(tiny_bop, tmp_path / "blind")
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (root / "test/000001" / name).unlink()
    shutil.rmtree(root / "test/000001/mask_visib")
    dataset = BopDataset(root)
    assert len(dataset.targets()) == 3
    assert dataset.image(1, 2).shape == (3, 480, 640)
    with pytest.raises(FileNotFoundError, match=r"scene_gt\.json is missing"):
        dataset.annotations(1, 0)


def test_errors_say_what_was_looked_for_and_what_is_there(tiny_bop, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"BOP_PATH"):
        BopDataset(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"models/ is missing; .* holds 000001/"):
        BopDataset(tiny_bop / "test")
    with pytest.raises(FileNotFoundError, match="scene 7 is missing"):
        BopDataset(tiny_bop).image(7, 0)
    with pytest.raises(FileNotFoundError, match="no image 99"):
        BopDataset(tiny_bop).image(1, 99)
    with pytest.raises(BopError, match="no entry for image 99"):
        BopDataset(tiny_bop).intrinsics(1, 99)
    with pytest.raises(FileNotFoundError, match=r"object 9 has no mesh .* has \[1, 2\]"):
        BopDataset(tiny_bop).mesh_path(9)
    root = shutil.copytree(tiny_bop, tmp_path / "broken")
    (root / "test_targets_bop19.json").write_text('[{"scene_id": 1}]')
    with pytest.raises(BopError, match="lacks scene_id"):
        BopDataset(root).targets()
    (root / "models" / "models_info.json").write_text("{")
    with pytest.raises(BopError, match=r"models_info\.json is not valid JSON"):
        BopDataset(root)


def test_pictures_of_all_kinds(tmp_path, rng):
    pixels = rng.integers(0, 256, (5, 7, 4), dtype=np.uint8)
    for name, array in {
        "rgb.png": pixels[..., :3],
        "rgba.png": pixels,
        "grey.png": pixels[..., 0],
        "deep.png": pixels[..., 0].astype(np.uint16) * 257,
    }.items():
        Image.fromarray(array).save(tmp_path / name)
        expected = pixels[..., :3] if name.startswith("rgb") else np.repeat(pixels[..., :1], 3, -1)
        got = read_image(tmp_path / name)
        assert torch.allclose(got, torch.from_numpy(expected / 255.0).permute(2, 0, 1).float(), atol=1e-6), (
            name
        )
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(BopError, match="not a readable image"):
        read_image(tmp_path / "text.png")
    with pytest.raises(FileNotFoundError, match=r"no image at .* holds deep\.png"):
        read_image(tmp_path / "missing.png")
    with pytest.raises(BopError, match=r"is 7x5 px, its image 8x5 px"):
        read_mask(tmp_path / "grey.png", (5, 8))
