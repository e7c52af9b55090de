"""A small dataset in BOP's layout, made in code."""

import json
import shutil
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image
from pycocotools import mask as coco_mask

from foundpose.rendering import Mesh, RaycastRenderer
from foundpose.synthetic import SyntheticScene, cluttered_scene, procedural_mesh

DEPTH_SCALE = 0.1


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write vertices, colours (8 bit) and faces."""
    colors = (mesh.vertex_colors * 255).round().to(torch.uint8).numpy()
    trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), vertex_colors=colors, process=False).export(
        path
    )


def depth_image(mesh: Mesh, picture: SyntheticScene) -> tuple[np.ndarray, np.ndarray]:
    """Whole silhouette (H, W) bool and depth (H, W) uint16 in tenths of a millimetre of a picture.

    A wall stands behind the object, what hides it is a fifth nearer than its nearest point, and the left 20 columns
    were not measured.
    """
    T, K = picture.T_camera_from_model[None].double(), picture.K[None].double()
    render = RaycastRenderer(supersampling=1)(mesh, T, K, tuple(picture.mask.shape))
    silhouette, depth = render.mask[0], render.depth[0]
    depth = torch.where(silhouette, depth, 1.5 * depth.max())
    depth = torch.where(silhouette & ~picture.mask, 0.8 * depth.min(), depth)
    depth[:, :20] = 0
    return silhouette.numpy(), (depth / DEPTH_SCALE).round().to(torch.int32).numpy().astype(np.uint16)


def make_bop_dataset(root: Path, images: int = 3, subdivisions: int = 5) -> Path:
    """Write a dataset of two procedural objects; picture i shows object 1 + i % 2, an eighth of it hidden.

    The meshes for evaluation are those of onboarding.
    """
    (root / "models").mkdir(parents=True)
    scene = root / "test" / "000001"
    for folder in ("rgb", "depth", "mask", "mask_visib"):
        (scene / folder).mkdir(parents=True)
    meshes = {obj_id: procedural_mesh(obj_id, subdivisions=subdivisions) for obj_id in (1, 2)}
    for obj_id, mesh in meshes.items():
        write_ply(root / "models" / f"obj_{obj_id:06d}.ply", mesh)
    info = {str(obj_id): {"diameter": mesh.diameter} for obj_id, mesh in meshes.items()}
    (root / "models" / "models_info.json").write_text(json.dumps(info))
    shutil.copytree(root / "models", root / "models_eval")
    cameras, truth, truth_info, targets, detections = {}, {}, {}, [], []
    for im_id in range(images):
        obj_id = 1 + im_id % 2
        picture = cluttered_scene(meshes[obj_id], seed=im_id)
        pixels = (picture.image * 255).round().byte().permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(scene / "rgb" / f"{im_id:06d}.png")
        mask = picture.mask.numpy()
        Image.fromarray(mask.astype(np.uint8) * 255).save(scene / "mask_visib" / f"{im_id:06d}_000000.png")
        silhouette, depth = depth_image(meshes[obj_id], picture)
        Image.fromarray(silhouette.astype(np.uint8) * 255).save(scene / "mask" / f"{im_id:06d}_000000.png")
        Image.fromarray(depth).save(scene / "depth" / f"{im_id:06d}.png")
        T = picture.T_camera_from_model.double()
        cameras[str(im_id)] = {"cam_K": picture.K.flatten().tolist(), "depth_scale": DEPTH_SCALE}
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
