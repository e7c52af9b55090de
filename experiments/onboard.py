"""Onboard one mesh or all objects of a BOP dataset; what is there already is skipped.

python experiments/onboard.py mesh=cup.ply
python experiments/onboard.py data=lmo data.root=/path/to/lmo objects=[1,5]
"""

import time
from pathlib import Path

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig

from foundpose.bop import BopDataset
from foundpose.config import Method, build_method, clear_errors, wanted_objects
from foundpose.rendering import Mesh, load_mesh
from foundpose.utils.progress import ProgressBars
from foundpose.utils.timing import StageTimer


def meshes_to_onboard(cfg: DictConfig) -> dict[str, Path]:
    """Names and files of the meshes that the config asks for."""
    if cfg.mesh is not None:
        return {Path(cfg.mesh).stem: Path(cfg.mesh)}
    dataset: BopDataset = instantiate(cfg.data)
    return {dataset.object_name(obj_id): dataset.mesh_path(obj_id) for obj_id in wanted_objects(cfg, dataset)}


@hydra.main(version_base="1.3", config_path="../conf", config_name="onboard")
def main(cfg: DictConfig) -> None:
    """Onboard and print one line per object."""
    with clear_errors():
        files = meshes_to_onboard(cfg)
        method = build_method(cfg)
        for name, file in files.items():
            onboard(method, name, load_mesh(file, cfg.color))


def onboard(method: Method, name: str, mesh: Mesh) -> None:
    """Onboard one mesh unless that has been done."""
    onboarder = method.onboarder
    known = method.store.has(mesh, name)
    on_cpu = StageTimer({"rendering": onboarder.renderer}, synchronize=False)
    start = time.perf_counter()
    # Beside a GPU, rendering goes on while the extractor runs.
    with (
        on_cpu,
        StageTimer({"extractor": onboarder.extractor, "words": onboarder.words}) as timer,
    ):
        representation = method.store.get(mesh, name, ProgressBars(name))
    total = time.perf_counter() - start
    size = representation.memory_bytes()["total"] / 2**20
    seconds = on_cpu.seconds | timer.seconds
    spent = ", ".join(f"{part} {seconds[part]:.1f} s" for part in ("rendering", "extractor", "words"))
    print(
        f"{name}: {'already there' if known else f'onboarded in {total:.1f} s ({spent})'}, "
        f"{representation.num_templates} templates, {len(representation.descriptors)} patches, "
        f"{size:.0f} MiB, {method.store.path(mesh, name)}"
    )


if __name__ == "__main__":
    main()
