"""Onboard a procedural object, find its pose in a cluttered picture, and show the result.

python experiments/demo.py            # another object and picture: seed=1
"""

import sys
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from foundpose.config import build_method, clear_errors
from foundpose.geometry import rotation_angle
from foundpose.progress import ProgressBars
from foundpose.synthetic import cluttered_scene, procedural_mesh
from foundpose.visualization import save_estimate_figure

# A right pose lies within these of the truth: about half a template's distance from its neighbours, coarse as it is.
MAX_ROTATION_DEGREES = 10.0
MAX_TRANSLATION_DIAMETERS = 0.1


@hydra.main(version_base="1.3", config_path="../conf", config_name="demo")
def main(cfg: DictConfig) -> None:
    """Run the demo; the exit status is 1 when the pose is wrong."""
    with clear_errors():
        right = run(cfg, Path(HydraConfig.get().runtime.output_dir))
    if not right:
        sys.exit(1)


def run(cfg: DictConfig, output: Path) -> bool:
    """Run the demo and say whether the pose is right."""
    method = build_method(cfg)
    mesh = procedural_mesh(cfg.seed)
    scene = cluttered_scene(mesh, cfg.seed)
    representation = method.store.get(mesh, f"demo-{cfg.seed}", ProgressBars("onboarding"))
    with torch.no_grad():
        estimates = method.pipeline(
            scene.image[None].to(cfg.device),
            scene.K[None].to(cfg.device),
            representation.to(cfg.device),
            masks=scene.mask[None].to(cfg.device),
            meshes=mesh,
        )
    save_estimate_figure(
        output / "overlay.png",
        scene.image,
        scene.K,
        estimates,
        0,
        representation,
        mesh,
        method.onboarder.renderer,
        scene.T_camera_from_model,
    )
    T = estimates.T_camera_from_model[0].cpu()
    rotation = float(torch.rad2deg(rotation_angle(T[:3, :3], scene.T_camera_from_model[:3, :3])))
    translation = float((T[:3, 3] - scene.T_camera_from_model[:3, 3]).norm())
    right = (
        bool(estimates.valid[0])
        and rotation < MAX_ROTATION_DEGREES
        and translation < MAX_TRANSLATION_DIAMETERS * mesh.diameter
    )
    print(f"inliers: {int(estimates.num_inliers[0])} of {int(estimates.query.valid[0].sum())} patches")
    print(f"rotation error: {rotation:.2f} degrees")
    print(f"translation error: {translation:.2f} mm of {float(mesh.diameter):.0f} mm diameter")
    print(f"overlay: {output / 'overlay.png'}")
    print("pose: right" if right else "pose: WRONG")
    return right


if __name__ == "__main__":
    main()
