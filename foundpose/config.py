"""From Hydra configs to modules, and what the apps share."""

import difflib
import json
import os
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from foundpose.bop import BopDataset
from foundpose.detection import Detector
from foundpose.features import PatchExtractor
from foundpose.onboarding import ArtefactStore, Onboarder, RepresentationStore
from foundpose.pipeline import FoundPose
from foundpose.rendering import RendererNotAvailableError
from foundpose.utils.files import write_text
from foundpose.utils.progress import say

# Settings that may change when a run is resumed: they change no pose, or say where things lie and are called.
MAY_CHANGE = (
    "device",
    "trainer",
    "errors",
    "memory_limit",
    "representations",
    "artefacts",
    "method",
    "row",
    "folder",
    "report_only",
    "overlays",
    "progress",
    "report",
    "data_module.num_workers",
    "data_module.prepare_data_per_node",
)


class Method(NamedTuple):
    """What ``conf/config.yaml`` describes.

    Attributes:
        onboarder: builds object representations.
        pipeline: estimates poses.
        store: keeps representations on disk.
    """

    onboarder: Onboarder
    pipeline: FoundPose
    store: RepresentationStore


def apps_folder() -> Path:
    """Where ``conf/`` and ``experiments/`` lie: ``foundpose/apps`` of an installed wheel, or the checkout."""
    packaged = Path(__file__).resolve().parent / "apps"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[1]


def load_config(name: str = "config", overrides: Sequence[str] = ()) -> DictConfig:
    """A configuration of ``conf/`` without Hydra's command line.

    Args:
        name: a file of ``conf/``; ``"config"`` is the method with its default settings.
        overrides: as on the command line, e.g. ``["extractor=dense_sift", "refiner=featuremetric"]``.
    """
    with initialize_config_dir(str(apps_folder() / "conf"), version_base="1.3"):
        return compose(name, list(overrides))


def load(name: str = "config", overrides: Sequence[str] = ()) -> Method:
    """Onboarder, pipeline and store of a configuration; arguments as in :func:`load_config`."""
    return build_method(load_config(name, overrides))


def build_method(cfg: DictConfig) -> Method:
    """Instantiate onboarder and pipeline on ``cfg.device``; they share the extractor.

    Raises:
        ValueError: the device does not exist.
    """
    try:
        device = torch.device(cfg.device)
    except RuntimeError as error:
        raise ValueError(f"device must be cpu, cuda, cuda:1 or mps, got {cfg.device!r}") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device is 'cuda' but this PyTorch sees no GPU; use device=cpu")
    extractor: PatchExtractor = instantiate(cfg.extractor).to(device).eval()
    query_extractor = extractor if cfg.get("corruption") is None else instantiate(cfg.corruption)(extractor)
    onboarder: Onboarder = instantiate(cfg.onboarder, extractor=extractor)
    refiner = None if cfg.get("refiner") is None else instantiate(cfg.refiner)
    confidence = None if cfg.get("confidence") is None else instantiate(cfg.confidence)
    pipeline: FoundPose = instantiate(
        cfg.pipeline, extractor=query_extractor, refiner=refiner, confidence=confidence
    )
    return Method(
        onboarder.to(device).eval(),
        pipeline.to(device).eval(),
        RepresentationStore(
            cfg.representations,
            onboarder,
            None if cfg.get("artefacts") is None else ArtefactStore(cfg.artefacts),
        ),
    )


def build_detector(cfg: DictConfig, extractor: PatchExtractor) -> Detector:
    """The detector of a configuration, on the device of the extractor that it shares with the pipeline."""
    detector: Detector = instantiate(cfg.detector, extractor=extractor)
    return detector.to(cfg.device).eval()


def wanted_objects(cfg: DictConfig, dataset: BopDataset) -> list[int]:
    """The ids in ``cfg.objects``, or all objects of the dataset.

    Raises:
        ValueError: not a list of the dataset's ids.
    """
    if cfg.objects is None:
        return dataset.object_ids
    ids = OmegaConf.to_container(cfg.objects) if OmegaConf.is_list(cfg.objects) else cfg.objects
    if not isinstance(ids, list) or not ids or not set(ids) <= set(dataset.object_ids):
        raise ValueError(
            f"objects must be a list of ids from {dataset.object_ids}, as in objects=[1,5]; got {ids}"
        )
    return ids


def claim_run_folder(folder: Path, cfg: DictConfig, may_change: tuple[str, ...] = ()) -> None:
    """Record the settings of a run in its folder, or make sure that a run being resumed has the same ones.

    Args:
        folder: the run's folder.
        cfg: the settings.
        may_change: keys that may change between the parts of a run besides :data:`MAY_CHANGE`.

    Raises:
        ValueError: the folder belongs to a run with other settings; the message shows the difference.
    """
    settings = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(settings, dict)
    for key in (*MAY_CHANGE, *may_change):
        *parents, last = key.split(".")
        node: Any = settings
        for parent in parents:
            node = node.get(parent, {})
        node.pop(last, None)
    text = json.dumps(settings, indent=1, sort_keys=True)
    path = folder / "settings.json"
    if path.is_file():
        before = path.read_text()
        if before != text:
            changes = [
                line
                for line in difflib.ndiff(before.splitlines(), text.splitlines())
                if line.startswith(("-", "+"))
            ]
            raise ValueError(
                f"{folder} holds a run with other settings; give another hydra.run.dir or the old settings. "
                "Difference:\n" + "\n".join(changes)
            )
        return
    write_text(path, text)


class SetProgress(Callback):
    """Lets an app's key ``progress`` hold for all bars, in the processes that it starts too."""

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Before the app's own code."""
        os.environ["FOUNDPOSE_PROGRESS"] = str(config.progress).lower()


@contextmanager
def clear_errors() -> Iterator[None]:
    """Turn bad input into a line on standard error and exit status 2, and warnings into a line each.

    HYDRA_FULL_ERROR=1 shows where an error arose.

    Bad input is what this library or an app refuses, and files that the system does not let be read or written. A
    ``ValueError`` from elsewhere is a mistake in a program, and goes on with its traceback.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: say(f"warning: {message}")
            yield
    except (ValueError, OSError, RendererNotAvailableError, InstantiationException) as error:
        # Hydra wraps what a constructor raises.
        wrapped = isinstance(error, InstantiationException) and error.__cause__ is not None
        cause = error.__cause__ if wrapped else error
        assert cause is not None
        if os.environ.get("HYDRA_FULL_ERROR") == "1" or not _is_refusal(cause):
            raise
        say(f"error: {cause} (HYDRA_FULL_ERROR=1 shows where)")
        sys.exit(2)


def _is_refusal(error: BaseException) -> bool:
    """Whether an error says that the input is bad."""
    if not isinstance(error, ValueError) or isinstance(error, json.JSONDecodeError):
        return True
    if error.__traceback__ is None:
        return True
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    file = Path(frame.f_code.co_filename).resolve()
    if file.is_relative_to(Path(__file__).resolve().parent):
        return True
    others = (sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib"))
    return not any(file.is_relative_to(Path(folder).resolve()) for folder in others)
