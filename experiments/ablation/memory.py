"""What an object representation takes in memory, beside what the paper says."""

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Protocol

import pandas as pd

from ablation.paper import paper_numbers
from ablation.records import RunRecord, varied_settings
from ablation.text_tables import MISSING, Format, text_table

_MIB = 2**20
_FIGURE = "memory."
_SMALL = 0.01


class HasMemory(Protocol):
    """What tells its size, such as an :class:`~foundpose.onboarding.ObjectRepresentation`."""

    def memory_bytes(self) -> dict[str, int]:
        """Bytes taken by each part, and their ``total``."""
        ...


def paper_memory(
    templates: int, patches_per_template: int, dimensions: int, words: int, bytes_per_scalar: int = 4
) -> dict[str, int]:
    """Bytes of a representation as the paper counts them.

    The totals that the paper prints, 234 MB and 59 MB, are ``descriptors`` alone: 800 × 300 × 256 × 4 bytes =
    234.4 MiB and 400 × 300 × 128 × 4 bytes = 58.6 MiB.

    Args:
        templates: number of templates.
        patches_per_template: valid patches in each, on average.
        dimensions: of a projected descriptor.
        words: visual words.
        bytes_per_scalar: 4, or 2 in half precision.

    Returns:
        Bytes of ``descriptors`` and ``template_bow`` (the templates' bags of words), and their ``total``.

    Raises:
        ValueError: a size that is not positive.

    Source: paper, "Memory requirements".
    """
    sizes = (templates, patches_per_template, dimensions, words, bytes_per_scalar)
    if min(sizes) <= 0:
        raise ValueError(f"sizes must be positive, got {sizes}")
    descriptors = templates * patches_per_template * dimensions * bytes_per_scalar
    template_bow = templates * words * bytes_per_scalar
    return {"descriptors": descriptors, "template_bow": template_bow, "total": descriptors + template_bow}


def recorded_memory(record: RunRecord) -> dict[str, float]:
    """Bytes by part that a run recorded as ``memory.*``."""
    return {
        name.removeprefix(_FIGURE): value
        for name, value in record.figures.items()
        if name.startswith(_FIGURE) and value is not None
    }


def memory_table(
    representations: Mapping[str, HasMemory | Mapping[str, float]] | Sequence[RunRecord],
    format: Format = "markdown",
) -> str:
    """A table of the memory of representations by part and in total, in MiB, with the paper's two below them.

    Parts that nowhere take a hundredth of the whole are added up as ``others``.

    Args:
        representations: by the name that heads their row, representations or their bytes by part (with or without a
            ``total``); or runs, of which those of one size share a row that is named after the settings it follows.
        format: ``markdown`` or ``latex``.

    Returns:
        The table's text. Parts that a representation does not have are marked –.

    Raises:
        ValueError: a given ``total`` is not the sum of its parts, or a representation takes nothing.
    """
    if not isinstance(representations, Mapping):
        representations = _sizes_of_runs(representations)
    sizes = {
        name: _checked(name, each if isinstance(each, Mapping) else each.memory_bytes())
        for name, each in representations.items()
    }
    facts = paper_numbers()["memory"]
    printed = dict.fromkeys(sizes, MISSING)
    for each in facts["representations"]:
        name = f"paper: {each['templates']} templates, {each['dimensions']}-d, {each['words']} words"
        sizes[name] = dict(
            paper_memory(
                each["templates"],
                facts["patches_per_template"],
                each["dimensions"],
                each["words"],
                facts["bytes_per_scalar"],
            )
        )
        printed[name] = f"{each['printed_mb']} MB"
    bytes_ = pd.DataFrame(sizes).T.astype(float)
    total = bytes_.pop("total")
    share = bytes_.div(total, axis=0).max()
    small = sorted(share.index[share < _SMALL])
    shown = bytes_[share[share >= _SMALL].sort_values(ascending=False, kind="stable").index].copy()
    if small:
        shown["others"] = bytes_[small].sum(axis=1, min_count=1)
    shown["total"] = total
    cells = shown.map(_mebibytes).assign(printed=pd.Series(printed)).reset_index(names="MiB")
    table = text_table(list(cells.columns), cells.to_numpy().tolist())
    table.caption = "Memory of an object representation"
    table.key = "memory"
    table.remarks.append(
        f"The paper's rows are {facts['patches_per_template']} patches per template and {facts['bytes_per_scalar']} "
        "bytes per scalar; the totals that it prints are the patch descriptors alone."
    )
    if small:
        table.remarks.append(f"Others: {', '.join(small)}.")
    return table.render(format)


def _sizes_of_runs(records: Sequence[RunRecord]) -> dict[str, dict[str, float]]:
    """Distinct sizes of runs that recorded any, by dataset and the settings that tell them apart."""
    groups: dict[str, list[RunRecord]] = defaultdict(list)
    for record in records:
        if record.status == "finished" and recorded_memory(record):
            facts = [record.dataset, recorded_memory(record)]
            groups[json.dumps(facts, sort_keys=True)].append(record)
    varied = varied_settings([record for group in groups.values() for record in group])
    within = {key for group in groups.values() for key in varied_settings(group)}
    telling = [key for key in varied if key not in within]
    several = len({group[0].dataset for group in groups.values()}) > 1
    sizes = {}
    for number, group in enumerate(groups.values(), 1):
        settings = [f"{key}={group[0].settings[key]}" for key in telling if key in group[0].settings]
        name = ", ".join(([group[0].dataset] if several else []) + settings) or f"size {number}"
        sizes[name if name not in sizes else f"{name} ({number})"] = recorded_memory(group[0])
    return sizes


def _checked(name: str, sizes: Mapping[str, float]) -> dict[str, float]:
    parts = {part: size for part, size in sizes.items() if part != "total"}
    total = sum(parts.values())
    # Means over objects are not exact.
    if not math.isclose(sizes.get("total", total), total, rel_tol=1e-9):
        raise ValueError(f"the parts of {name!r} take {total} bytes, its total says {sizes['total']}")
    if total <= 0:
        raise ValueError(f"{name!r} takes no memory: {sizes}")
    return parts | {"total": total}


def _mebibytes(size: float) -> str:
    if math.isnan(size):
        return MISSING
    mebibytes = size / _MIB
    if mebibytes >= 100:
        return f"{mebibytes:.1f}"
    return f"{mebibytes:.2f}" if mebibytes >= 0.01 else f"{mebibytes:.1g}"
