"""Pose estimates in the CSV format of the BOP benchmark."""

import csv
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from foundpose.bop.files import BopError
from foundpose.bop.matching import best
from foundpose.bop.scenes import check_rotation
from foundpose.bop.targets import Target, describe_target
from foundpose.utils.files import describe_folder, write_atomically

HEADER = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
# Seconds by which the times of an image's results may differ in the benchmark's own check.
TIME_TOLERANCE = 0.001


@dataclass(frozen=True)
class PoseResult:
    """One line of a results file.

    Attributes:
        scene_id: the scene.
        im_id: the image.
        obj_id: the object.
        score: confidence.
        T_camera_from_model: (4, 4) float64, translation in millimetres.
        time: seconds for the whole image, equal for all its results; −1 where it was not measured.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    T_camera_from_model: Tensor
    time: float

    def row(self) -> list[str]:
        """The line's fields, with as many digits as reading them back needs.

        Raises:
            BopError: a number is not finite.
        """
        T = self.T_camera_from_model.double()
        R, t = T[:3, :3].flatten().tolist(), T[:3, 3].tolist()
        if not all(math.isfinite(value) for value in [self.score, self.time, *R, *t]):
            raise BopError(
                f"the result of {describe_target(self.scene_id, self.im_id, self.obj_id)} has numbers that are not "
                f"finite: score {self.score}, R {R}, t {t}, time {self.time}"
            )
        ids = [str(self.scene_id), str(self.im_id), str(self.obj_id)]
        R_text, t_text = (" ".join(repr(value) for value in values) for values in (R, t))
        return [*ids, repr(float(self.score)), R_text, t_text, repr(float(self.time))]


def share_image_times(results: Iterable[PoseResult]) -> list[PoseResult]:
    """Give all results of an image the largest of their times, since the benchmark demands one time per image."""
    results = list(results)
    times: dict[tuple[int, int], float] = defaultdict(lambda: -1.0)
    for result in results:
        key = (result.scene_id, result.im_id)
        times[key] = max(times[key], result.time)
    return [replace(result, time=times[result.scene_id, result.im_id]) for result in results]


def check_times(results: Iterable[PoseResult]) -> None:
    """Make sure that the times of each image's results are equal, to a millisecond, as the benchmark demands.

    Raises:
        BopError: they are not; the message names the image.
    """
    first: dict[tuple[int, int], float] = {}
    for result in results:
        time = first.setdefault((result.scene_id, result.im_id), result.time)
        if not abs(result.time - time) <= TIME_TOLERANCE:
            raise BopError(
                f"the results of {describe_target(result.scene_id, result.im_id)} have different times, {time} and "
                f"{result.time} s; the benchmark wants one time per image"
            )


def write_results(path: str | Path, results: Iterable[PoseResult]) -> None:
    """Write a results file atomically; times are made equal within an image, all else is read back as it was.

    Raises:
        BopError: a number is not finite; nothing is written.
    """
    rows = [result.row() for result in share_image_times(results)]

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(HEADER)
            writer.writerows(rows)

    write_atomically(Path(path), write)


def read_results(path: str | Path) -> list[PoseResult]:
    """Read a results file; the header may be missing, as in the benchmark's own reader.

    Raises:
        FileNotFoundError: no such file.
        BopError: an empty file, or a line that is not a result; the message gives its number.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no results file at {path}; {describe_folder(path.parent)}")
    results = []
    number = 0
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for number, fields in enumerate(csv.reader(file), start=1):
                if fields and not (number == 1 and [field.strip() for field in fields] == HEADER):
                    results.append(_parse_row(fields))
    except (ValueError, csv.Error) as error:
        raise BopError(f"{path}, line {number}: not a BOP result ({error})") from error
    if number == 0:
        raise BopError(f"{path} is empty: not even a header ({','.join(HEADER)})")
    return results


def _parse_row(fields: list[str]) -> PoseResult:
    """Raises ValueError where the line is not a result."""
    if [field.strip() for field in fields] == HEADER:
        raise ValueError("a second header; was the file put together from several?")
    if len(fields) != len(HEADER):
        raise ValueError(f"expected {len(HEADER)} fields ({','.join(HEADER)}), got {len(fields)}")
    score, time = float(fields[3]), float(fields[6])
    R, t = ([float(value) for value in field.split()] for field in fields[4:6])
    if len(R) != 9 or len(t) != 3:
        raise ValueError(f"R must be 9 and t 3 numbers, got {len(R)} and {len(t)}")
    for name, values in (("score", [score]), ("R", R), ("t", t), ("time", [time])):
        if not all(math.isfinite(value) for value in values):
            raise ValueError(f"{name} must be finite, got {values}")
    if time < 0 and time != -1:
        raise ValueError(f"time must be at least 0, or -1 where it was not measured, got {time}")
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.tensor(R, dtype=torch.float64).reshape(3, 3)
    T[:3, 3] = torch.tensor(t, dtype=torch.float64)
    check_rotation(T[:3, :3], "R")
    return PoseResult(int(fields[0]), int(fields[1]), int(fields[2]), score, T, time)


def best_of_targets(results: Sequence[PoseResult], targets: Iterable[Target]) -> list[PoseResult]:
    """What to hand in: of each target as many results as it has instances, those of highest score.

    Args:
        results: the results; of equal scores the first wins.
        targets: what was to be found. Of a target that is an image (bop24) all results are kept.

    Returns:
        In the order given. Those of other objects and images than the targets' are dropped.

    Raises:
        ValueError: a score is NaN.
    """
    found: dict[tuple[int, int, int | None], list[int]] = defaultdict(list)
    for i, result in enumerate(results):
        if math.isnan(result.score):
            raise ValueError(f"scores must be numbers, score {i} is NaN")
        found[result.scene_id, result.im_id, result.obj_id].append(i)
        found[result.scene_id, result.im_id, None].append(i)
    kept: set[int] = set()
    for target in targets:
        mine = found[target[:3]]
        kept.update(mine[i] for i in best([results[i].score for i in mine], target.inst_count))
    return [results[i] for i in sorted(kept)]


def result_file_name(method: str, dataset: str, split: str) -> str:
    """Name of a results file as the benchmark wants it, ``METHOD_DATASET-SPLIT.csv``.

    Args:
        method: name of the method; its underscores become dashes, since the underscore ends the name.
        dataset: name of the dataset.
        split: folder of the scenes; its last part up to an underscore counts, so ``test_primesense`` is ``test``.

    Raises:
        ValueError: a part is empty or holds a slash.
    """
    parts = [method.replace("_", "-"), dataset.replace("_", "-"), Path(split).name.split("_")[0]]
    for name, part in zip(("method", "dataset", "split"), parts, strict=True):
        if not part.strip() or "/" in part or "\\" in part:
            raise ValueError(
                f"{name} must be a name without slashes, got method {method!r}, dataset {dataset!r}, split {split!r}"
            )
    return f"{parts[0]}_{parts[1]}-{parts[2]}.csv"
