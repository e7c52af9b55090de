"""Train an adapter on frozen descriptors by the error of the poses they lead to; measure an unseen object's poses.

python experiments/train_adapter.py
python experiments/train_adapter.py meshes=[a.ply,b.ply,c.ply] held_out=d.ply
python experiments/demo.py --config-dir outputs/train_adapter extractor=adapted
"""

import json
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
import pytorch_lightning as pl
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from pytorch_lightning.callbacks import ModelCheckpoint
from pytorch_lightning.loggers import CSVLogger
from safetensors.torch import load_file, save_file

from foundpose.bop.files import parse_models_info, read_json
from foundpose.config import build_method, claim_run_folder, clear_errors
from foundpose.features import ResidualAdapter
from foundpose.geometry import Symmetries, stack_symmetries, symmetries_from_models_info
from foundpose.rendering import Mesh, load_mesh
from foundpose.synthetic import cluttered_scene
from foundpose.training import (
    AdapterTraining,
    PairDataModule,
    PoseErrors,
    compare,
    evaluate_scenes,
    summarize,
)
from foundpose.training.meshes import meshes_to_train_on, small_mesh
from foundpose.utils.files import write_atomically, write_json, write_text
from foundpose.utils.lightning import LightningProgress
from foundpose.utils.progress import ProgressBars, track

# Procedural objects are numbered from here; scenes of the held-out object are like no scene trained on.
TRAINING_OBJECTS, VALIDATION_OBJECTS, HELD_OUT_SCENES = 1000, 2000, 10_000
MODES = ("retrieved", "nearest")
# What an option of the config group extractor sets.
EXTRACTOR_SETTINGS = ("extractor", "descriptors")


@hydra.main(version_base="1.3", config_path="../conf", config_name="train_adapter")
def main(cfg: DictConfig) -> None:
    """Measure, train, measure again; writes the adapter, the results and Lightning's checkpoints and logs."""
    with clear_errors():
        run(cfg, Path(HydraConfig.get().runtime.output_dir))


def run(cfg: DictConfig, output: Path) -> None:
    """What :func:`main` does, in a folder.

    What is there already is not done again: the pairs, the measurement before, the epochs trained, and the
    measurement after of the adapter that came out. Times are those of all parts of the run together.
    """
    held_out = load_mesh(cfg.held_out) if cfg.held_out is not None else small_mesh(cfg.held_out_seed)
    meshes = meshes_to_train_on(cfg.meshes, TRAINING_OBJECTS, "meshes")
    validation = meshes_to_train_on(cfg.validation, VALIDATION_OBJECTS, "validation")
    if held_out.checksum in {mesh.checksum for mesh in (*meshes, *validation)}:
        raise ValueError(
            "the held-out object is among those trained on; give another held_out or held_out_seed"
        )
    symmetries = {name: wanted_symmetries(cfg, name) for name in ("held_out", "meshes", "validation")}
    claim_run_folder(output, cfg)
    pl.seed_everything(cfg.seed, verbose=False)
    clock = Clock(output / "seconds.json")
    with clock("before"):
        before = measure(cfg, held_out, symmetries["held_out"], output / "before.safetensors", "before")
    with clock("training"):
        module = train(cfg, meshes, validation, symmetries, output)
    module.adapter.save(output / "adapter.safetensors")
    trained = with_adapter(cfg, module, output / "adapter.safetensors")
    write_extractor(trained, output / "extractor" / "adapted.yaml")
    with clock("after"):
        kept = output / f"after-{module.adapter.checksum()}.safetensors"
        after = measure(trained, held_out, symmetries["held_out"], kept, "after")

    results = {
        mode: {
            "before": summarize(before[mode]),
            "after": summarize(after[mode]),
            "change": compare(before[mode], after[mode]),
        }
        for mode in MODES
    }
    facts = {
        "results": results,
        "seconds": clock.seconds,
        "settings": OmegaConf.to_container(cfg, resolve=True),
    }
    write_json(output / "results.json", facts)
    print_table(results)
    print("seconds: " + ", ".join(f"{name} {value:.0f}" for name, value in clock.seconds.items()))
    print(f"adapter: {output / 'adapter.safetensors'}; in every app: --config-dir {output} extractor=adapted")


def wanted_symmetries(cfg: DictConfig, name: str) -> Symmetries | None:
    """Symmetries of meshes, from BOP's ``models_info.json``; None without one, and for procedural objects."""
    files = [cfg[name]] if isinstance(cfg[name], str) else cfg[name]
    if cfg.models_info is None or files is None or isinstance(files, int):
        return None
    path = Path(cfg.models_info)
    entries = parse_models_info(read_json(path), path)
    found = []
    for file in files:
        number = re.fullmatch(r"obj_(\d+)", Path(file).stem)
        if number is None or int(number[1]) not in entries:
            raise ValueError(
                f"{cfg.models_info} tells of the objects {sorted(entries)}; which of them is {file}? "
                "Name it obj_000001.ply as BOP does, or leave models_info out"
            )
        found.append(symmetries_from_models_info(entries[int(number[1])]))
    return stack_symmetries(found) if found else None


class Clock:
    """Adds up the time spent on each step, over all parts of a run.

    Args:
        path: file that keeps the sums.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.seconds: dict[str, float] = json.loads(path.read_text()) if path.is_file() else {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add the time spent inside."""
        start = time.perf_counter()
        try:
            yield
        finally:  # the part before an interruption counts too
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
            write_json(self.path, self.seconds)


def with_adapter(cfg: DictConfig, module: AdapterTraining, weights: Path) -> DictConfig:
    """The same settings with the adapter around the extractor, and the temperature that it was trained with."""
    trained = cfg.copy()
    trained.extractor = {
        "_target_": "foundpose.features.AdaptedExtractor",
        "extractor": cfg.extractor,
        "adapter": None,
        "weights": str(weights.resolve()),
    }
    trained.descriptors.temperature = float(module.matcher.temperature.detach())
    return trained


def write_extractor(cfg: DictConfig, path: Path) -> None:
    """Write an option of the config group ``extractor``, for the apps that are told of its folder."""
    option = {name: cfg[name] for name in EXTRACTOR_SETTINGS}
    text = "# @package _global_\n" + OmegaConf.to_yaml(OmegaConf.create(option), resolve=True)
    write_text(path, text)


def measure(
    cfg: DictConfig, mesh: Mesh, symmetries: Symmetries | None, kept: Path, title: str
) -> dict[str, PoseErrors]:
    """Onboard the held-out object and estimate its pose in all scenes, or read the errors that were kept."""
    if kept.is_file():
        tensors = load_file(kept)
        return {
            mode: PoseErrors(*(tensors[f"{mode}.{field}"] for field in PoseErrors._fields)) for mode in MODES
        }
    method = build_method(cfg)
    representation = method.store.get(mesh, "held-out", ProgressBars(title)).to(cfg.device)
    light, renderer = instantiate(cfg.light), method.onboarder.renderer
    scenes = (
        cluttered_scene(mesh, seed, occlusion=cfg.pairs.occlusion, renderer=renderer, light=light)
        for seed in range(HELD_OUT_SCENES, HELD_OUT_SCENES + cfg.scenes)
    )
    errors = evaluate_scenes(
        method.pipeline,
        representation,
        mesh,
        track(scenes, f"{title} scenes", cfg.scenes),
        symmetries=symmetries,
    )
    flat = {f"{mode}.{field}": value for mode in MODES for field, value in errors[mode]._asdict().items()}
    write_atomically(kept, lambda temporary: save_file(flat, str(temporary)))
    return errors


def train(
    cfg: DictConfig,
    meshes: list[Mesh],
    validation: list[Mesh],
    symmetries: dict[str, Symmetries | None],
    output: Path,
) -> AdapterTraining:
    """Train; goes on from the last checkpoint in the folder."""
    method = build_method(cfg)
    method.onboarder.extractor.requires_grad_(False)
    data = PairDataModule(
        meshes,
        validation,
        method.onboarder,
        method.pipeline.crop,
        instantiate(cfg.pairs),
        cfg.batch_size,
        cfg.seed,
        output / "artefacts",
        ProgressBars("train"),
        symmetries["meshes"],
        symmetries["validation"],
    )
    adapter: ResidualAdapter = instantiate(cfg.adapter, channels=method.onboarder.extractor.channels)
    module: AdapterTraining = instantiate(cfg.training, adapter=adapter)
    checkpoint = ModelCheckpoint(dirpath=output / "checkpoints", save_last=True)
    trainer: pl.Trainer = instantiate(
        cfg.trainer,
        default_root_dir=output,
        logger=CSVLogger(output, name="log"),
        callbacks=[checkpoint, LightningProgress()],
    )
    last = output / "checkpoints" / "last.ckpt"
    trainer.fit(module, datamodule=data, ckpt_path=str(last) if last.is_file() else None)
    return module.cpu()


def print_table(results: dict[str, dict[str, Any]]) -> None:
    """Before and after, with the change and its standard error."""
    print(f"{'templates':<11}{'':<8}{'right':>7}{'median rotation':>17}{'matching error / diameter':>27}")
    for mode, rows in results.items():
        for stage in ("before", "after"):
            row = rows[stage]
            print(
                f"{mode:<11}{stage:<8}{row['right']:>7.1%}{row['median_rotation']:>16.2f}°"
                f"{row['mean_matching']:>27.3f}"
            )
        change = rows["change"]
        print(
            f"{mode:<11}{'change':<8}{change['right']:>+7.1%} ± {change['right_standard_error']:.1%}, "
            f"{change['gained']} poses gained, {change['lost']} lost; matching error "
            f"{change['mean_matching']:+.3f} ± {change['mean_matching_standard_error']:.3f}"
        )


if __name__ == "__main__":
    main()
