"""Train a render-and-compare refiner on rendered meshes; measure perturbed poses of an unseen object.

python experiments/train_refiner.py
python experiments/train_refiner.py meshes=[a.ply,b.ply,c.ply] held_out=d.ply
python experiments/train_refiner.py refiner=megapose
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import hydra
import pytorch_lightning as pl
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.loggers import CSVLogger
from safetensors.torch import save_file
from torch import nn

from foundpose.config import claim_run_folder, clear_errors
from foundpose.refinement import MegaPoseNetwork, RenderAndCompareRefiner, UpdateNetwork
from foundpose.rendering import Mesh, load_mesh
from foundpose.training import (
    RefinerDataModule,
    RefinerPictures,
    RefinerTraining,
    compare,
    evaluate_refiner,
    summarize,
)
from foundpose.training.meshes import meshes_to_train_on, small_mesh
from foundpose.utils.files import write_atomically, write_json
from foundpose.utils.lightning import LightningProgress
from foundpose.utils.progress import ProgressBars

# Procedural objects are numbered from here; pictures of the held-out object are like none trained on.
TRAINING_OBJECTS, VALIDATION_OBJECTS, HELD_OUT_SEED = 1000, 2000, 10_000

_T = TypeVar("_T")


@hydra.main(version_base="1.3", config_path="../conf", config_name="train_refiner")
def main(cfg: DictConfig) -> None:
    """Train, measure before and after; writes the network, the results and Lightning's checkpoints and logs."""
    with clear_errors():
        run(cfg, Path(HydraConfig.get().runtime.output_dir))


def run(cfg: DictConfig, output: Path) -> None:
    """What :func:`main` does, in a folder; what is there already is not done again."""
    held_out = load_mesh(cfg.held_out) if cfg.held_out is not None else small_mesh(cfg.held_out_seed)
    meshes = meshes_to_train_on(cfg.meshes, TRAINING_OBJECTS, "meshes")
    validation = meshes_to_train_on(cfg.validation, VALIDATION_OBJECTS, "validation")
    if held_out.checksum in {mesh.checksum for mesh in (*meshes, *validation)}:
        raise ValueError(
            "the held-out object is among those trained on; give another held_out or held_out_seed"
        )
    claim_run_folder(output, cfg)
    pl.seed_everything(cfg.seed, verbose=False)
    seconds: dict[str, float] = {}

    refiner: RenderAndCompareRefiner = instantiate(cfg.refiner)
    timed(seconds, "training", lambda: train(cfg, refiner, meshes, validation, output))
    weights = output / "refiner.safetensors"
    save_network(refiner.network, weights)
    before, after = timed(seconds, "measuring", lambda: measure(cfg, refiner.eval(), held_out))

    results = {
        "before": summarize(before),
        "after": summarize(after),
        "change": compare(before, after),
    }
    facts = {"results": results, "seconds": seconds, "settings": OmegaConf.to_container(cfg, resolve=True)}
    write_json(output / "results.json", facts)
    print_table(results)
    print("seconds: " + ", ".join(f"{name} {value:.0f}" for name, value in seconds.items()))
    print(f"network: {weights}")
    print(
        f"use it with: refiner={HydraConfig.get().runtime.choices['refiner']} refiner.network.weights={weights}"
    )


def timed(seconds: dict[str, float], name: str, step: Callable[[], _T]) -> _T:
    """Run a step and note how long it took."""
    start = time.perf_counter()
    result = step()
    seconds[name] = time.perf_counter() - start
    return result


def train(
    cfg: DictConfig,
    refiner: RenderAndCompareRefiner,
    meshes: list[Mesh],
    validation: list[Mesh],
    output: Path,
) -> None:
    """Train the refiner's network in place; goes on from the last checkpoint in the folder."""
    data: RefinerDataModule = instantiate(
        cfg.data_module,
        meshes=meshes,
        validation_meshes=validation,
        renderer=instantiate(cfg.refiner.renderer),
        progress=ProgressBars("train"),
    )
    module: RefinerTraining = instantiate(cfg.training, refiner=refiner)
    checkpoint = ModelCheckpoint(dirpath=output / "checkpoints", save_last=True)
    trainer: pl.Trainer = instantiate(
        cfg.trainer,
        default_root_dir=output,
        logger=CSVLogger(output, name="log"),
        callbacks=[checkpoint, LightningProgress()],
    )
    last = output / "checkpoints" / "last.ckpt"
    trainer.fit(module, datamodule=data, ckpt_path=str(last) if last.is_file() else None)
    refiner.cpu()


def save_network(network: nn.Module, path: Path) -> None:
    """Write the network; one that cannot write itself as its plain tensors."""
    if isinstance(network, UpdateNetwork | MegaPoseNetwork):
        network.save(path)
    else:
        tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
        write_atomically(path, lambda temporary: save_file(tensors, str(temporary)))


def measure(cfg: DictConfig, refiner: RenderAndCompareRefiner, mesh: Mesh) -> Any:
    """Errors of the unseen object's perturbed poses, before and after."""
    settings = instantiate(cfg.data_module.pictures, pictures_per_mesh=cfg.poses)
    pictures = RefinerPictures(
        [mesh],
        settings,
        instantiate(cfg.data_module.perturbation),
        instantiate(cfg.refiner.renderer),
        HELD_OUT_SEED,
        progress=ProgressBars("measure"),
    )
    return evaluate_refiner(refiner, pictures, progress=ProgressBars("measure"))


def print_table(results: dict[str, dict[str, Any]]) -> None:
    """Before and after with standard errors, and the shares of poses that improved."""
    print(f"{'median':<10}{'rotation':>16}{'lateral / d':>16}{'depth / d':>16}{'points / d':>16}")
    for stage in ("before", "after"):
        row = results[stage]
        cells = [f"{row['median_rotation']:.1f} ± {row['median_rotation_standard_error']:.1f}°"] + [
            f"{row[f'median_{name}']:.1%} ± {row[f'median_{name}_standard_error']:.1%}"
            for name in ("lateral", "depth", "matching")
        ]
        print(f"{stage:<10}" + "".join(f"{cell:>16}" for cell in cells))
    change = results["change"]
    cells = [
        f"{change[f'{name}_improved']:.0%} ± {change[f'{name}_improved_standard_error']:.0%}"
        for name in ("rotation", "lateral", "depth", "matching")
    ]
    print(f"{'improved':<10}" + "".join(f"{cell:>16}" for cell in cells))
    print(
        f"mean distance of the points: {results['before']['mean_matching']:.3f} before, "
        f"{results['after']['mean_matching']:.3f} after, change {change['mean_matching']:+.3f} ± "
        f"{change['mean_matching_standard_error']:.3f} diameters; {results['after']['poses']} poses"
    )


if __name__ == "__main__":
    main()
