"""The report of an evaluation: average recalls, curves, and every instance with its errors and what explains them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from PIL import Image
from torch import Tensor

from foundpose.bop import BopDataset, Scores
from foundpose.evaluation.judgement import Judgement, judge
from foundpose.evaluation.records import pose_of
from foundpose.evaluation.report import Estimated
from foundpose.geometry import resize_intrinsics, shift_intrinsics
from foundpose.pipeline.figure import ObjectView
from foundpose.utils.progress import ProgressBars
from foundpose.visualization.overlay import REFINED, TRUTH, Color, draw_contour, from_pil, to_pil
from foundpose.visualization.report import Cell, Report, lines_chart, stacked_bars, write_report

if TYPE_CHECKING:
    import plotly.graph_objects as go

_THUMBNAIL = 96  # pixels
_ROOM = 1.6  # of a thumbnail around the mask


class EvaluationReport:
    """Writes ``report.html``.

    Args:
        figures: so many of the worst instances get a large figure, for which their poses are estimated once more
            (about 60 KB each in the file).
        thumbnails: so many of the worst get a small picture (3 KB each).
    """

    def __init__(self, figures: int = 20, thumbnails: int = 1000) -> None:
        if min(figures, thumbnails) < 0:
            raise ValueError(f"figures and thumbnails must not be negative, got {figures} and {thumbnails}")
        import plotly  # noqa: F401  # if it is missing, that is found before the work

        self.figures = figures
        self.thumbnails = thumbnails

    def __call__(self, path: Path, estimated: Estimated, scores: Scores | None) -> None:
        """Write the report of an evaluation; without scores (and ground truth) instances are ordered by their own.

        Args:
            path: of the HTML file.
            estimated: the estimates.
            scores: average recalls, or None.
        """
        dataset, records = estimated.dataset, estimated.records
        judged: Sequence[Judgement | None] = [None] * len(records)
        if scores is not None:
            judged = judge(dataset, estimated.objects, records, estimated.instances)
        order = sorted(range(len(records)), key=lambda k: _goodness(records[k], judged[k]))
        cases = [_case(dataset, records[k], judged[k]) for k in order]
        facts = {"dataset": f"{dataset.name}, {dataset.split.name}", "instances": str(len(records))}
        facts["with a pose"] = str(sum(record["valid"] for record in records))
        tables: dict[str, Sequence[Mapping[str, Cell]]] = {}
        charts: dict[str, go.Figure] = {}
        if scores is not None:
            facts["judged"] = "right: MSSD below 0.1 diameters or MSPD below 10 px (of a picture 640 px wide)"
            facts |= {
                f"AR_{name.upper()}": f"not computed: {why}" for name, why in scores.not_computed.items()
            }
            tables["Average recall"] = recall_table(scores, dataset)
            charts = recall_charts(scores, dataset)
            charts["What explains the errors, by object"] = _reasons_chart(cases)
        report = Report(
            title=f"{dataset.name}: {len(records)} instances",
            facts=facts,
            tables=tables,
            charts=charts,
            cases=cases,
            thumbnails=self._thumbnails(estimated, judged, order[: self.thumbnails]),
            figures=self._figures(estimated, judged, order[: self.figures]),
        )
        write_report(path, report)

    def _thumbnails(
        self, estimated: Estimated, judged: Sequence[Judgement | None], places: Sequence[int]
    ) -> dict[int, Image.Image]:
        """Small pictures with the contours of truth and estimate, image by image, as images take time to read."""
        progress, views, drawn = ProgressBars("report"), dict[int, ObjectView](), dict[int, Image.Image]()
        image, pixels = None, torch.empty(0)
        by_image = sorted(enumerate(places), key=lambda pair: _image_of(estimated.records[pair[1]]))
        for done, (rank, place) in enumerate(by_image, start=1):
            record, judgement = estimated.records[place], judged[place]
            if _image_of(record) != image:
                image = _image_of(record)
                pixels = estimated.pictures(estimated.dataset, *image)
            obj_id = record["obj_id"]
            if obj_id not in views:
                representation = estimated.objects.representations([obj_id])[0]
                views[obj_id] = ObjectView(representation, None)
            poses = [(REFINED, pose_of(record))] if record["valid"] else []
            if judgement is not None and judgement.T_true is not None:
                poses.insert(0, (TRUTH, judgement.T_true))
            mask = estimated.instances[place].mask(estimated.dataset)
            K = estimated.dataset.intrinsics(*_image_of(record)).float()
            drawn[rank] = thumbnail(pixels, K, mask, views[obj_id], poses)
            progress("thumbnails", done, len(places))
        return drawn

    def _figures(
        self, estimated: Estimated, judged: Sequence[Judgement | None], places: Sequence[int]
    ) -> dict[int, Image.Image]:
        """Large figures, of poses that are estimated again."""
        progress, drawn = ProgressBars("report"), {}
        device, pipeline = estimated.device, estimated.pipeline.to(estimated.device)
        for rank, place in enumerate(places):
            instance, judgement = estimated.instances[place], judged[place]
            image = estimated.pictures(estimated.dataset, instance.scene_id, instance.im_id)
            with torch.no_grad():
                estimates = pipeline(
                    image[None].to(device),
                    estimated.dataset.intrinsics(instance.scene_id, instance.im_id)[None].float().to(device),
                    estimated.objects.representations([instance.obj_id], device),
                    masks=instance.mask(estimated.dataset)[None].to(device),
                    meshes=estimated.objects.mesh(instance.obj_id),
                )
            note = "" if judgement is None else _in_words(judgement)
            drawn[rank] = estimates.draw(0, None if judgement is None else judgement.T_true, note)
            progress("figures", rank + 1, len(places))
        return drawn


def write_pictures_report(
    path: Path,
    records: Sequence[Mapping[str, Any]],
    thumbnails: Mapping[int, Image.Image],
    figures: Mapping[int, Image.Image],
) -> None:
    """Write the report of pictures of one's own, of which no truth is known: no pose first, then the lowest scores.

    Args:
        path: of the HTML file.
        records: as :func:`~foundpose.evaluation.records.pose_records` makes them, with ``image`` (its name), ``mesh``
            (its file) and ``time``.
        thumbnails: small pictures, by place in ``records``.
        figures: large ones (``estimates.draw(i)``), by place in ``records``.
    """
    order = sorted(range(len(records)), key=lambda k: (records[k]["valid"], records[k]["score"]))
    cases: list[dict[str, Cell]] = [
        {
            "picture": Path(record["image"]).name,
            "object": Path(record["mesh"]).stem,
            "status": record["status"],
            "score": record["score"],
            "inliers": record["num_inliers"],
            "patches": record["num_patches"],
            "distance": record["t"][2] if record["valid"] else None,
            "s": record["time"],
        }
        for record in (records[k] for k in order)
    ]
    found = sum(record["valid"] for record in records)
    places = {place: rank for rank, place in enumerate(order)}
    report = Report(
        title=f"{len(records)} objects in {len({record['image'] for record in records})} pictures",
        facts={"with a pose": str(found), "without": str(len(records) - found)},
        tables={},
        charts={},
        cases=cases,
        thumbnails={places[k]: picture for k, picture in thumbnails.items()},
        figures={places[k]: picture for k, picture in figures.items()},
    )
    write_report(path, report)


def thumbnail(
    image: Tensor, K: Tensor, mask: Tensor, view: ObjectView, poses: Sequence[tuple[Color, Tensor]]
) -> Image.Image:
    """A small square picture of what a mask shows, with contours.

    Args:
        image: (3, H, W) in [0, 1].
        K: (3, 3) intrinsics.
        mask: (H, W) bool; an empty one shows all of the picture.
        view: of the object.
        poses: colours and poses (4, 4) of the contours.
    """
    rows, columns = torch.nonzero(mask.any(dim=1)).flatten(), torch.nonzero(mask.any(dim=0)).flatten()
    if not len(rows):
        rows, columns = torch.arange(image.shape[1]), torch.arange(image.shape[2])
    side = max(8, round(_ROOM * float(max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1)))
    left = int(columns[0] + columns[-1]) // 2 - side // 2
    top = int(rows[0] + rows[-1]) // 2 - side // 2
    cut = to_pil(image).crop((left, top, left + side, top + side))
    small = from_pil(cut.resize((_THUMBNAIL, _THUMBNAIL), Image.Resampling.BILINEAR))
    K = resize_intrinsics(shift_intrinsics(K, K.new_tensor([left, top])), _THUMBNAIL / side)
    for color, T in poses:
        small = draw_contour(small, view.outline(T.float(), K, (_THUMBNAIL, _THUMBNAIL)), color, width=1)
    return to_pil(small)


def recall_table(scores: Scores, dataset: BopDataset) -> list[dict[str, Cell]]:
    """Average recalls in percent, of all objects together and of each."""
    rows: list[dict[str, Cell]] = []
    for obj_id in (None, *scores.targets):
        targets = sum(scores.targets.values()) if obj_id is None else scores.targets[obj_id]
        row: dict[str, Cell] = {"object": "all" if obj_id is None else dataset.object_name(obj_id)}
        averages = {"AR": scores.overall(obj_id)}
        averages |= {f"AR_{name.upper()}": scores.average_recall(name, obj_id) for name in scores.functions}
        rows.append(
            row | {"targets": targets} | {k: None if v is None else 100 * v for k, v in averages.items()}
        )
    return rows


def recall_charts(scores: Scores, dataset: BopDataset) -> "dict[str, go.Figure]":
    """Recall against the threshold under each error, of all objects together and of each."""
    charts = {}
    for name, found in scores.functions.items():
        lines = {}
        for obj_id, recall in ((None, found.total), *found.objects.items()):
            if recall.recalls is not None:
                label = "all" if obj_id is None else dataset.object_name(obj_id)
                # VSD has a recall for each of its tolerances too.
                lines[label] = recall.recalls.reshape(-1, len(found.thresholds)).mean(dim=0).tolist()
        charts[f"Recall under {name.upper()}"] = lines_chart(
            found.thresholds, lines, f"threshold, {found.unit}"
        )
    return charts


def _reasons_chart(cases: Sequence[Mapping[str, Cell]]) -> "go.Figure":
    objects = sorted({str(case["object"]) for case in cases})
    counts = Counter((str(case["reason"]), str(case["object"])) for case in cases)
    reasons = sorted({reason for reason, _ in counts}, key=lambda reason: (reason != "right", reason))
    return stacked_bars({r: {o: counts[r, o] for o in objects} for r in reasons}, "object")


def _case(dataset: BopDataset, record: Mapping[str, Any], judgement: Judgement | None) -> dict[str, Cell]:
    case: dict[str, Cell] = {
        "object": dataset.object_name(record["obj_id"]),
        "image": f"{record['scene_id']}/{record['im_id']}",
        "status": record["status"],
    }
    if judgement is not None:
        case |= {
            "reason": judgement.reason,
            "MSSD / diameter": judgement.mssd,
            "MSPD / px": judgement.mspd,
            "rotation / °": judgement.rotation,
            "translation": judgement.translation,
            "mask's overlap": judgement.overlap,
        }
    numbers = {"score": record["score"], "inliers": record["num_inliers"], "patches": record["num_patches"]}
    return case | numbers | {"detection": record["detection_score"], "s / image": record["time"]}


def _goodness(record: Mapping[str, Any], judgement: Judgement | None) -> tuple[bool, float]:
    """By which instances are ordered, worst first."""
    if judgement is None:
        return record["valid"], record["score"]
    return judgement.mspd is not None, -(judgement.mspd or 0.0)


def _in_words(judgement: Judgement) -> str:
    if judgement.mssd is None:
        return judgement.reason
    return (
        f"{judgement.reason}: MSSD {judgement.mssd:.2f} diameters, MSPD {judgement.mspd:.0f} px, "
        f"rotation {judgement.rotation:.0f}°"
    )


def _image_of(record: Mapping[str, Any]) -> tuple[int, int]:
    return record["scene_id"], record["im_id"]
