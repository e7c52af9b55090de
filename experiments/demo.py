"""Onboard an object, find its pose in a picture, say whether it is right, and show the result.

python experiments/demo.py                                         # a watering can in a photograph
python experiments/demo.py scene=procedural extractor=dense_sift   # offline; another object and picture: seed=1
"""

import sys
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from foundpose.config import Method, build_method, clear_errors
from foundpose.geometry import pose_deviation
from foundpose.pipeline.results import PoseEstimates
from foundpose.representation import ObjectRepresentation
from foundpose.utils.files import write_atomically
from foundpose.utils.progress import ProgressBars, say
from scenes import KnownScene


@hydra.main(version_base="1.3", config_path="../conf", config_name="demo")
def main(cfg: DictConfig) -> None:
    """Run the demo; the exit status is 1 when the pose is wrong."""
    settings = HydraConfig.get()
    with clear_errors():
        right = run(cfg, Path(settings.runtime.output_dir), settings.runtime.choices["extractor"])
    if not right:
        sys.exit(1)


def run(cfg: DictConfig, output: Path, extractor: str) -> bool:
    """Run the demo and say whether the pose is right."""
    scene: KnownScene = instantiate(cfg.scene)
    fetches = cfg.extractor.get("weights", "random") != "random"
    say(
        f"1/4 loading the extractor {extractor}"
        + (" (weights that are not here yet are downloaded)" if fetches else "")
    )
    method = build_method(cfg)
    representation = onboard(method, scene)
    say("3/4 estimating the pose in the picture: crop, retrieval, matching, PnP, refinement")
    with torch.no_grad():
        estimates = method.pipeline(
            scene.image[None].to(cfg.device),
            scene.K[None].to(cfg.device),
            representation.to(cfg.device),
            masks=scene.mask[None].to(cfg.device),
            meshes=scene.mesh,
        )
    say("4/4 drawing the figure")
    write_atomically(output / "overlay.png", estimates.draw(0, scene.T_camera_from_model).save)
    return judge(cfg, scene, estimates, output / "overlay.png")


def onboard(method: Method, scene: KnownScene) -> ObjectRepresentation:
    """The object's representation, from the store or made now."""
    if method.store.has(scene.mesh, scene.name):
        say(f"2/4 {scene.name} was onboarded before: {method.store.path(scene.mesh, scene.name)}")
    else:
        say(
            f"2/4 onboarding {scene.name}: rendering it from all sides and describing these templates, "
            f"once; kept in {method.store.folder}"
        )
    return method.store.get(scene.mesh, scene.name, ProgressBars("onboarding"))


def judge(cfg: DictConfig, scene: KnownScene, estimates: PoseEstimates, figure: Path) -> bool:
    """Print how far the pose is from the truth and whether that is right."""
    rotation, translation = errors(estimates.T_camera_from_model[0], scene)
    diameter = float(scene.mesh.diameter)
    right = (
        bool(estimates.valid[0])
        and rotation < cfg.max_rotation
        and translation < cfg.max_translation * diameter
    )
    print(f"inliers: {int(estimates.num_inliers[0])} of {int(estimates.query.valid[0].sum())} patches")
    if estimates.refined is not None:
        before = errors(estimates.T_coarse[0], scene)
        print(f"before refinement: {before[0]:.2f} degrees, {before[1]:.2f} mm")
    print(f"rotation error: {rotation:.2f} degrees")
    print(f"translation error: {translation:.2f} mm of {diameter:.0f} mm diameter")
    print(f"overlay: {figure} (contours: truth red, before refinement blue, result green)")
    print("pose: right" if right else "pose: WRONG")
    return right


def errors(T_camera_from_model: Tensor, scene: KnownScene) -> tuple[float, float]:
    """Rotation error in degrees and translation error in the mesh's unit."""
    deviation = pose_deviation(T_camera_from_model.cpu(), scene.T_camera_from_model)
    return float(deviation.rotation), float(deviation.translation)


if __name__ == "__main__":
    main()
