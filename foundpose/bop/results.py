"""Pose estimates in the CSV format of the BOP benchmark."""

import csv
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from foundpose.bop.files import BopError
from foundpose.io import write_atomically

HEADER = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]


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
        """The line's fields."""
        R = " ".join(f"{v:.9g}" for v in self.T_camera_from_model[:3, :3].flatten().tolist())
        t = " ".join(f"{v:.9g}" for v in self.T_camera_from_model[:3, 3].tolist())
        return [
            str(self.scene_id),
            str(self.im_id),
            str(self.obj_id),
            f"{self.score:.9g}",
            R,
            t,
            f"{self.time:.6g}",
        ]


def share_image_times(results: Iterable[PoseResult]) -> list[PoseResult]:
    """Give all results of an image the largest of their times, since the benchmark demands one time per image."""
    results = list(results)
    times: dict[tuple[int, int], float] = defaultdict(lambda: -1.0)
    for result in results:
        key = (result.scene_id, result.im_id)
        times[key] = max(times[key], result.time)
    return [replace(result, time=times[result.scene_id, result.im_id]) for result in results]


def write_results(path: str | Path, results: Iterable[PoseResult]) -> None:
    """Write a results file atomically; times are made equal within an image."""
    rows = [result.row() for result in share_image_times(results)]

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(HEADER)
            writer.writerows(rows)

    write_atomically(Path(path), write)


def read_results(path: str | Path) -> list[PoseResult]:
    """Read a results file.

    Raises:
        FileNotFoundError: no such file.
        BopError: a line that is not a result; the message gives its number.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no results file at {path}")
    results = []
    with path.open(newline="") as file:
        for number, fields in enumerate(csv.reader(file), start=1):
            if not fields or fields[0] == "scene_id":
                continue
            try:
                scene_id, im_id, obj_id, score, R, t, time = fields
                T = torch.eye(4, dtype=torch.float64)
                T[:3, :3] = torch.tensor([float(v) for v in R.split()], dtype=torch.float64).reshape(3, 3)
                T[:3, 3] = torch.tensor([float(v) for v in t.split()], dtype=torch.float64)
                results.append(
                    PoseResult(int(scene_id), int(im_id), int(obj_id), float(score), T, float(time))
                )
            except (ValueError, RuntimeError) as error:
                raise BopError(f"{path}, line {number}: not a BOP result ({error})") from error
    return results
