"""A small dataset in BOP's layout, made in code."""

import json
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from pycocotools import mask as coco_mask

from foundpose.rendering import Mesh
from foundpose.synthetic import cluttered_scene, procedural_mesh


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write vertices, colours (8 bit) and faces."""
    colors = (mesh.vertex_colors * 255).round().to(torch.uint8).numpy()
    trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), vertex_colors=colors, process=False).export(
        path
    )


def make_bop_dataset(root: Path, images: int = 3, subdivisions: int = 5) -> Path:
    """Write a dataset of two procedural objects; picture i shows object 1 + i % 2, an eighth of it hidden."""
    (root / "models").mkdir(parents=True)
    scene = root / "test" / "000001"
    for folder in ("rgb", "mask_visib"):
        (scene / folder).mkdir(parents=True)
    meshes = {obj_id: procedural_mesh(obj_id, subdivisions=subdivisions) for obj_id in (1, 2)}
    for obj_id, mesh in meshes.items():
        write_ply(root / "models" / f"obj_{obj_id:06d}.ply", mesh)
    info = {str(obj_id): {"diameter": mesh.diameter} for obj_id, mesh in meshes.items()}
    (root / "models" / "models_info.json").write_text(json.dumps(info))
    cameras, truth, truth_info, targets, detections = {}, {}, {}, [], []
    for im_id in range(images):
        obj_id = 1 + im_id % 2
        picture = cluttered_scene(meshes[obj_id], seed=im_id)
        pixels = (picture.image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(scene / "rgb" / f"{im_id:06d}.png")
        mask = picture.mask.numpy()
        Image.fromarray(mask.astype(np.uint8) * 255).save(scene / "mask_visib" / f"{im_id:06d}_000000.png")
        T = picture.T_camera_from_model.double()
        cameras[str(im_id)] = {"cam_K": picture.K.flatten().tolist(), "depth_scale": 1.0}
        truth[str(im_id)] = [
            {"cam_R_m2c": T[:3, :3].flatten().tolist(), "cam_t_m2c": T[:3, 3].tolist(), "obj_id": obj_id}
        ]
        truth_info[str(im_id)] = [{"visib_fract": 0.88}]
        targets.append({"scene_id": 1, "im_id": im_id, "obj_id": obj_id, "inst_count": 1})
        rle = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
        counts = rle["counts"].decode()
        for score, segmentation in ((0.4, {"size": [480, 640], "counts": [480 * 640]}), (0.9, None)):
            detections.append(
                {
                    "scene_id": 1,
                    "image_id": im_id,
                    "category_id": obj_id,
                    "bbox": [0, 0, 1, 1],
                    "score": score,
                    "time": 0.25,
                    "segmentation": segmentation or {"size": [480, 640], "counts": counts},
                }
            )
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    (scene / "scene_gt.json").write_text(json.dumps(truth))
    (scene / "scene_gt_info.json").write_text(json.dumps(truth_info))
    (root / "test_targets_bop19.json").write_text(json.dumps(targets))
    (root / "detections" / "cnos-fastsam").mkdir(parents=True)
    (root / "detections" / "cnos-fastsam" / "detections.json").write_text(json.dumps(detections))
    return root
