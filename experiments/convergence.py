"""How far off a pose may be for the refiner to find it: a table and a plot of the convergence basin.

python experiments/convergence.py data=lmo experiment=oracle viewpoints.count=400 words.num_words=1024
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from foundpose.bop import BopDataset, Instance, ground_truth_instances
from foundpose.config import build_method, clear_errors, wanted_objects
from foundpose.geometry import (
    PoseDeviation,
    make_transform,
    perturbed_poses,
    pose_deviation,
    project_to_rotation,
)
from foundpose.refinement import Observation, PoseProposals
from foundpose.rendering import load_mesh
from foundpose.representation import ObjectGroups
from foundpose.utils.files import write_atomically, write_json
from foundpose.utils.progress import ProgressBars, track


@hydra.main(version_base="1.3", config_path="../conf", config_name="convergence")
def main(cfg: DictConfig) -> None:
    """Perturb true poses and refine them; refine coarse poses."""
    with clear_errors():
        run(cfg, Path(HydraConfig.get().runtime.output_dir))


def run(cfg: DictConfig, output: Path) -> None:
    """What :func:`main` does, in a folder."""
    dataset: BopDataset = instantiate(cfg.data)
    method = build_method(cfg)
    if method.pipeline.refiner is None:
        raise ValueError("there is no refiner to look at; set refiner=featuremetric")
    pictures = instantiate(cfg.pictures)
    objects = {}
    for obj_id in wanted_objects(cfg, dataset):
        mesh = load_mesh(dataset.mesh_path(obj_id))
        name = dataset.object_name(obj_id)
        objects[obj_id] = (mesh, method.store.get(mesh, name, ProgressBars(name)).to(cfg.device))
    degrees = torch.linspace(0, cfg.max_degrees, cfg.perturbations + 1)[1:]
    generator = torch.Generator().manual_seed(cfg.seed)
    parts: dict[str, list[PoseDeviation]] = {
        name: [] for name in ("coarse", "coarse, refined", "perturbed", "perturbed, refined")
    }
    instances = list(visible_instances(cfg, dataset, set(objects)))
    for instance, T_true in track(instances, "instances"):
        mesh, representation = objects[instance.obj_id]
        diameter = float(mesh.diameter)
        image = pictures(dataset, instance.scene_id, instance.im_id)[None].to(cfg.device)
        K = dataset.intrinsics(instance.scene_id, instance.im_id).float()[None].to(cfg.device)
        with torch.no_grad():
            estimates = method.pipeline(
                image, K, representation, masks=instance.mask(dataset)[None].to(cfg.device), meshes=mesh
            )
            features = method.pipeline.extractor(estimates.crops.images)
        # Deviations are the same in the camera's frame and in the crop's.
        T_crop = estimates.crops.T_crop_from_camera[0].cpu() @ T_true
        starts = perturbed_poses(
            T_crop.expand(len(degrees), 4, 4),
            degrees,
            degrees * cfg.translation_per_degree * diameter,
            generator,
        )
        template = representation.nearest_views(T_crop[None].to(K))
        proposals = PoseProposals(
            T_crop_from_model=starts[None].to(K),
            score=torch.zeros(1, len(degrees)).to(K),
            valid=torch.ones(1, len(degrees), dtype=torch.bool, device=K.device),
            template_index=template.expand(1, len(degrees)),
        )
        observation = Observation(
            crops=estimates.crops,
            features=features,
            grid=method.pipeline.extractor.patch_grid(method.pipeline.crop.size),
            query=estimates.query,
            groups=ObjectGroups([representation], None, 1, K.device),
            images=image,
            K=K,
            image_index=torch.zeros(1, dtype=torch.int64),
            meshes=[mesh],
        )
        with torch.no_grad():
            refined: PoseProposals = method.pipeline.refiner(proposals, observation)
        poses = {
            "coarse": (estimates.T_coarse, T_true),
            "coarse, refined": (estimates.T_camera_from_model, T_true),
            "perturbed": (starts, T_crop),
            "perturbed, refined": (refined.T_crop_from_model[0], T_crop),
        }
        for name, (T, truth) in poses.items():
            parts[name].append(pose_deviation(T.cpu(), truth, diameter))
    deviations = {
        name: PoseDeviation(*(torch.stack(field) for field in zip(*found, strict=True)))
        for name, found in parts.items()
    }
    table = {name: summarize(deviation) for name, deviation in deviations.items()}
    for start in ("coarse", "perturbed"):
        better = deviations[f"{start}, refined"].rotation < deviations[start].rotation
        table[f"{start}, refined"]["rotation_better"] = float(better.float().mean())
    basin = deviations["perturbed, refined"].converged().float().mean(dim=0)
    facts = {
        "instances": len(instances),
        "table": table,
        "degrees": degrees.tolist(),
        "basin": basin.tolist(),
    }
    write_json(output / "results.json", facts)
    plot_basin(output / "basin.png", degrees, basin, cfg.translation_per_degree)
    print_table(table)
    print(f"{len(instances)} instances; written to {output}")


def visible_instances(
    cfg: DictConfig, dataset: BopDataset, wanted: set[int]
) -> Iterator[tuple[Instance, Tensor]]:
    """Ground-truth masks of visible enough instances, and their true poses with exact rotations."""
    images: set[tuple[int, int]] = set()
    for instance in ground_truth_instances(dataset):
        images.add((instance.scene_id, instance.im_id))
        if cfg.max_images is not None and len(images) > cfg.max_images:
            return
        if instance.obj_id not in wanted or instance.annotation_index is None:
            continue
        annotation = dataset.annotations(instance.scene_id, instance.im_id)[instance.annotation_index]
        if annotation.visible_fraction is None or annotation.visible_fraction >= cfg.min_visible:
            T = annotation.T_camera_from_model
            yield instance, make_transform(project_to_rotation(T[:3, :3]), T[:3, 3]).float()


def summarize(deviation: PoseDeviation) -> dict[str, Any]:
    """Medians and the share of converged poses."""
    return {
        "converged": float(deviation.converged().float().mean()),
        "median_rotation_degrees": float(deviation.rotation.median()),
        "median_lateral_diameters": float(deviation.lateral.median()),
        "median_depth_diameters": float(deviation.depth.median()),
    }


def print_table(table: dict[str, dict[str, Any]]) -> None:
    """The summary on the terminal."""
    print(f"{'poses':<20}{'converged':>10}{'rotation':>10}{'lateral':>9}{'depth':>8}{'rotation better':>17}")
    for name, row in table.items():
        better = f"{row['rotation_better']:>16.1%}" if "rotation_better" in row else ""
        print(
            f"{name:<20}{row['converged']:>10.1%}{row['median_rotation_degrees']:>9.2f}°"
            f"{row['median_lateral_diameters']:>9.2%}{row['median_depth_diameters']:>8.2%} {better}"
        )


def plot_basin(path: Path, degrees: Tensor, basin: Tensor, translation: float) -> None:
    """Share of poses that are found again against how far off they were."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(degrees.numpy(), basin.numpy(), marker="o")
    axes.set_xlabel(
        f"perturbation: rotation in degrees, and {translation:.0%} of the diameter for each degree"
    )
    axes.set_ylabel("share refined to < 1°, < 1 % lateral, < 5 % depth")
    axes.set_ylim(0, 1.02)
    axes.grid(alpha=0.3)
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=110))


if __name__ == "__main__":
    main()
