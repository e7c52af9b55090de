"""What many onboarded objects cost in disk, memory and time, for every way of storing descriptors.

Objects of the benchmark's workload are written to files of their own and opened together; then poses of crops of
random ones are estimated, without the extractor.

python experiments/scaling.py
python experiments/scaling.py counts=[10,100] storages=[int8,pq64]
"""

import copy
import gc
import os
import shutil
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import hydra
import pandas as pd
import psutil
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator
from omegaconf import DictConfig, OmegaConf

from ablation.plots import decorate, save_figure
from benchmarking import ScriptedExtractor, Workload, WorkloadSizes, make_workload
from benchmarking.hardware import describe_hardware, describe_versions
from benchmarking.measure import return_free_memory
from foundpose import FoundPose
from foundpose.config import clear_errors
from foundpose.representation import ObjectRepresentation
from foundpose.representation.quantization import Storage
from foundpose.utils.files import write_json, write_text
from foundpose.utils.progress import track

_MIB = 2**20
_GIB = 2**30
_CROPS_PREPARED = 8


@dataclass(frozen=True)
class Row:
    """What ``objects`` objects cost.

    Attributes:
        storage: how descriptors are kept.
        objects: how many.
        measured: False where it is extrapolated from the largest number that was measured.
        disk: bytes of all files; also what is resident once every page has been used.
        open_seconds: to open all of them, files not in memory.
        resident_open: bytes of the files that are in memory when all are open.
        resident_used: the same after the crops.
        first: seconds per crop of an object that was not used before, median.
        again: seconds per crop when the same crops come again, median.
    """

    storage: str
    objects: int
    measured: bool
    disk: float
    open_seconds: float
    resident_open: float
    resident_used: float
    first: float
    again: float

    def at(self, objects: int, crops: int) -> "Row":
        """For another number of objects, in proportion; the crops are as many, and each takes as long."""
        ratio = objects / self.objects
        used = expected_distinct(objects, crops) / expected_distinct(self.objects, crops)
        return replace(
            self,
            objects=objects,
            measured=False,
            disk=ratio * self.disk,
            open_seconds=ratio * self.open_seconds,
            resident_open=ratio * self.resident_open,
            resident_used=ratio * self.resident_open + used * (self.resident_used - self.resident_open),
        )


def expected_distinct(objects: int, crops: int) -> float:
    """How many objects random crops hit on average, each at least once."""
    return objects * (1.0 - (1.0 - 1.0 / objects) ** crops)


class PreparedCrops:
    """Estimates the poses of prepared crops, one at a time."""

    def __init__(self, cfg: DictConfig, workload: Workload) -> None:
        self.workload = workload
        self.extractor = ScriptedExtractor(workload.sizes, workload.features)
        self.pipeline: FoundPose = instantiate(cfg.pipeline, extractor=self.extractor, refiner=None).eval()

    def seconds(self, number: int, representation: ObjectRepresentation) -> float:
        """Time that a crop takes, if it shows this object.

        Raises:
            RuntimeError: there was no pose, so the time means nothing.
        """
        w, i = self.workload, number % len(self.workload.masks)
        self.extractor.features = w.features[i : i + 1]
        image = w.image_index[i : i + 1]
        start = time.perf_counter()
        with torch.no_grad():
            estimates = self.pipeline(w.images[image], w.K[image], representation, masks=w.masks[i : i + 1])
        seconds = time.perf_counter() - start
        if not bool(estimates.valid.all()):
            raise RuntimeError(f"no pose was found for crop {i}")
        return seconds


@hydra.main(version_base="1.3", config_path="../conf", config_name="scaling")
def main(cfg: DictConfig) -> None:
    """Measure, write ``scaling.json``, ``scaling.md`` and ``scaling.png``, and print the table."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    with clear_errors():
        rows = measure(cfg, folder / "objects" if cfg.files is None else Path(cfg.files))
        content = {
            "settings": OmegaConf.to_container(prepared(cfg), resolve=True),
            "hardware": describe_hardware(torch.device("cpu")),
            "versions": describe_versions(),
            "rows": [asdict(row) for row in rows],
        }
        write_json(folder / "scaling.json", content)
        text = table(rows)
        write_text(folder / "scaling.md", text)
        save_figure(plot(rows), folder / "scaling")
        print(f"{text}\n{folder}")


def prepared(cfg: DictConfig) -> DictConfig:
    """A copy of the settings in which the crops are those that the workload's descriptors belong to."""
    cfg = copy.deepcopy(cfg)
    cfg.crop.fill = _sizes(cfg).fill
    return cfg


def _sizes(cfg: DictConfig) -> WorkloadSizes:
    return WorkloadSizes(**cfg.sizes, batch_size=_CROPS_PREPARED, images=_CROPS_PREPARED)


def measure(cfg: DictConfig, files: Path) -> list[Row]:
    """Rows of all storages and numbers of objects."""
    counts = sorted(cfg.counts)
    if not counts or counts[0] < 1 or cfg.crops < 1:
        raise ValueError(f"counts and crops must be at least 1, got {list(cfg.counts)} and {cfg.crops}")
    if not psutil.LINUX:
        raise ValueError("the memory of mapped files is told by Linux only")
    cfg = prepared(cfg)
    workload = make_workload(_sizes(cfg))
    crops = PreparedCrops(cfg, workload)
    crops.seconds(0, workload.representation)  # whatever is done once
    rows = []
    for name in cfg.storages:
        storage, subspaces = parse_storage(name, cfg.onboarder.pq_subspaces)
        stored = workload.representation.with_storage(storage, subspaces)
        with distinct_files(stored, files, counts, cfg.disk_limit, name) as paths:
            fitting = [count for count in counts if count <= len(paths)]
            measured = [
                measure_objects(name, paths[:count], crops, cfg.crops)
                for count in track(fitting, f"{name}: numbers of objects")
            ]
        rows += measured + [measured[-1].at(count, cfg.crops) for count in counts if count not in fitting]
    return rows


def parse_storage(name: str, subspaces: int) -> tuple[Storage, int]:
    """Storage and number of subspaces of a name such as ``int8`` or ``pq32``; of ``pq`` alone as many as given."""
    if name.startswith("pq") and name[2:].isdecimal():
        return "pq", int(name[2:])
    return cast(Storage, name), subspaces


@contextmanager
def distinct_files(
    representation: ObjectRepresentation, folder: Path, counts: Sequence[int], limit: float, name: str
) -> Iterator[list[Path]]:
    """As many files of a representation as are wanted and fit on the disk; they are gone afterwards.

    Raises:
        ValueError: not even the smallest number fits.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths: list[Path] = []
    try:
        first = folder / "object_000000.safetensors"
        paths.append(first)
        representation.save(first)
        size = first.stat().st_size
        room = min(limit * _GIB, shutil.disk_usage(folder).free / 2)
        fitting = [count for count in counts if count * size <= room]
        if not fitting:
            raise ValueError(
                f"{counts[0]} objects of {size / _MIB:.0f} MiB do not fit in {room / _GIB:.1f} GiB (disk_limit, or "
                f"half of what is free in {folder})"
            )
        for i in track(range(1, fitting[-1]), f"{name}: files"):
            paths.append(folder / f"object_{i:06d}.safetensors")
            shutil.copyfile(first, paths[-1])
        yield paths
    finally:
        for path in paths:
            path.unlink(missing_ok=True)


def measure_objects(name: str, paths: Sequence[Path], crops: PreparedCrops, count: int) -> Row:
    """Open files and estimate poses of crops of random objects among them, twice."""
    forget(paths)
    gc.collect()
    return_free_memory()
    before = resident()
    start = time.perf_counter()
    objects = [ObjectRepresentation.load(path) for path in paths]
    open_seconds = time.perf_counter() - start
    opened = resident()
    chosen = torch.randint(len(objects), (count,), generator=torch.Generator().manual_seed(0)).tolist()
    passes = [[crops.seconds(i, objects[k]) for i, k in enumerate(chosen)] for _ in range(2)]
    first = [seconds for i, seconds in enumerate(passes[0]) if chosen[i] not in chosen[:i]]
    return Row(
        storage=name,
        objects=len(paths),
        measured=True,
        disk=float(sum(path.stat().st_size for path in paths)),
        open_seconds=open_seconds,
        resident_open=opened - before,
        resident_used=resident() - before,
        first=statistics.median(first),
        again=statistics.median(passes[1]),
    )


def forget(paths: Sequence[Path]) -> None:
    """Have the system drop files from its page cache, so that they are read from the disk."""
    for path in paths:
        with path.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def resident() -> float:
    """Bytes of mapped files that this process has in memory.

    Objects are nothing else; the rest of the memory comes and goes with what was computed before.
    """
    return float(psutil.Process().memory_info().shared)


def table(rows: Sequence[Row]) -> str:
    """Markdown; extrapolated rows are marked with ≈."""
    cells = [
        {
            "storage": row.storage,
            "objects": f"{'' if row.measured else '≈ '}{row.objects}",
            "disk, GiB": f"{row.disk / _GIB:.3g}",
            "open, s": f"{row.open_seconds:.2g}",
            "resident, MiB: open": f"{row.resident_open / _MIB:.3g}",
            "after crops": f"{row.resident_used / _MIB:.3g}",
            "ms/crop: first": f"{1e3 * row.first:.3g}",
            "again": f"{1e3 * row.again:.3g}",
        }
        for row in rows
    ]
    return pd.DataFrame(cells).to_markdown(index=False, disable_numparse=True) + "\n"


def plot(rows: Sequence[Row]) -> Figure:
    """Disk, resident memory and time against the number of objects; hollow markers are extrapolated."""
    figure = Figure(figsize=(11.4, 3.4), layout="constrained")
    panels = figure.subplots(1, 3)
    for i, storage in enumerate(dict.fromkeys(row.storage for row in rows)):
        chosen = [row for row in rows if row.storage == storage]
        kept = [row for row in chosen if row.measured]
        x = [row.objects for row in chosen]
        _line(panels[0], x, [row.disk / _GIB for row in chosen], len(kept), i, storage)
        _line(panels[1], x, [row.resident_used / _MIB for row in chosen], len(kept), i, storage)
        x = x[: len(kept)]
        _line(panels[2], x, [1e3 * row.first for row in kept], len(kept), i, storage)
        _line(panels[2], x, [1e3 * row.again for row in kept], len(kept), i, storage, ":")
    panels[0].set_ylabel("disk = most memory (GiB)")
    panels[1].set_ylabel("resident after the crops (MiB)")
    panels[2].set_ylabel("ms per crop: first (–), again (··)")
    panels[2].set_ylim(0, 1.1 * 1e3 * max(max(row.first, row.again) for row in rows))
    for panel in panels:
        panel.set_xscale("log")
        panel.set_xticks(sorted({row.objects for row in rows}))
        panel.xaxis.set_minor_locator(NullLocator())
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.set_xlabel("objects")
        decorate(panel)
    for panel in panels[:2]:
        panel.set_yscale("log")
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.yaxis.set_minor_formatter(NullFormatter())
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return figure


def _line(
    panel: Axes,
    x: Sequence[float],
    y: Sequence[float],
    measured: int,
    index: int,
    label: str,
    style: str = "-",
) -> None:
    """A series, its markers filled as far as it was measured."""
    color, marker = f"C{index}", "osD^v"[index % 5]
    panel.plot(x, y, style, color=color, linewidth=1.2)
    panel.plot(x[measured:], y[measured:], marker, color=color, markerfacecolor="white", markersize=5)
    panel.plot(x[:measured], y[:measured], marker, color=color, markersize=5, label=label)


if __name__ == "__main__":
    main()
