"""What a BOP dataset asks for: the lists ``test_targets_*.json``."""

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from foundpose.bop.files import BopError

# Instances of which less is visible do not count, in BOP's localisation and detection alike.
MIN_VISIBLE_FRACTION = 0.1


class Target(NamedTuple):
    """What to find in an image, as listed by ``test_targets_*.json``.

    Localisation (bop19) asks for ``inst_count`` instances of object ``obj_id``. Detection (bop24) names the image
    alone: both are None, and every instance of every object counts.
    """

    scene_id: int
    im_id: int
    obj_id: int | None
    inst_count: int | None


def parse_targets(entries: Any, path: Path) -> list[Target]:
    """Targets of a file's entries, in its order.

    Raises:
        BopError: not a list of bop19 entries, nor one of bop24 entries, or a target twice.
    """
    if not isinstance(entries, list):
        raise BopError(f"{path} must hold a list of targets, it holds {type(entries).__name__}")
    targets = [_parse_target(entry, i, path) for i, entry in enumerate(entries)]
    if len({target.obj_id is None for target in targets}) > 1:
        raise BopError(f"{path} mixes entries with obj_id and inst_count (bop19) and without (bop24)")
    for key, count in Counter(target[:3] for target in targets).items():
        if count > 1:
            raise BopError(f"{path} lists {describe_target(*key)} {count} times")
    return targets


def _parse_target(entry: Any, position: int, path: Path) -> Target:
    names = ["scene_id", "im_id"]
    if isinstance(entry, Mapping) and entry.keys() & {"obj_id", "inst_count"}:
        names += ["obj_id", "inst_count"]
    values = [entry.get(name) for name in names] if isinstance(entry, Mapping) else [None]
    # bool is an int in Python, but true is no id.
    if not all(type(value) is int and value >= 0 for value in values) or values[3:] == [0]:
        raise BopError(
            f"{path}: entry {position} lacks scene_id, im_id, obj_id or inst_count (bop24: lacks scene_id or im_id), "
            f"or one of them is no whole number in range: {entry!r}"
        )
    return Target(*[*values, None, None][:4])


def describe_target(scene_id: int, im_id: int, obj_id: int | None = None) -> str:
    """A target in words."""
    text = f"image {im_id} of scene {scene_id}"
    return text if obj_id is None else f"object {obj_id} in {text}"


def count_visible(
    scene_id: int,
    im_id: int,
    annotations: Iterable[tuple[int, float | None]],
    at_least: float = MIN_VISIBLE_FRACTION,
) -> list[Target]:
    """Localisation targets of one image, by object: its instances of which at least a tenth is visible.

    Args:
        scene_id: the scene.
        im_id: the image.
        annotations: (object, visible fraction) of each annotated instance.
        at_least: visible fraction from which an instance counts.

    Raises:
        BopError: a visible fraction is not known.
    """
    counts: Counter[int] = Counter()
    for obj_id, visible in annotations:
        if visible is None:
            raise BopError(
                f"the visible fraction of {describe_target(scene_id, im_id, obj_id)} is not known: "
                "scene_gt_info.json with visib_fract is needed to tell which instances count"
            )
        counts[obj_id] += visible >= at_least
    return [Target(scene_id, im_id, obj_id, n) for obj_id, n in sorted(counts.items()) if n]
