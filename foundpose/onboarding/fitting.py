"""Projection and visual words of an object's descriptors."""

import copy
from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from foundpose.features.pca import CovarianceAccumulator, PcaProjection
from foundpose.onboarding.stages import FittedWords, Progress
from foundpose.retrieval import VisualWords

# Sums and products round alike, whatever batches the extractor ran in.
_ROWS_PER_BLOCK = 4096


def fit_words(
    raw: list[Tensor], projection: PcaProjection, words: VisualWords, device: torch.device, report: Progress
) -> FittedWords:
    """Fit projection and words.

    Args:
        raw: descriptors (m, C) of batches of templates, at least one; the list is emptied on the way, which frees
            memory.
        projection: says how many components there are; a copy is fitted.
        words: finds the words.
        device: to compute on.
        report: is told of the progress.
    """
    report("PCA", 0, 1)
    accumulator = CovarianceAccumulator(raw[0].shape[1], device)
    for rows in _equal_blocks(raw):
        accumulator.update(rows.to(device))
    projection = copy.deepcopy(projection).to(device).fit(accumulator)
    # Filled batch by batch: joining a list would take the memory twice.
    descriptors = projection.mean.new_empty(accumulator.count, projection.num_components)
    filled = 0
    for rows in _equal_blocks(raw.pop(0) for _ in range(len(raw))):
        projected = projection(rows.to(device))
        descriptors[filled : filled + len(projected)] = projected
        filled += len(projected)
    report("PCA", 1, 1)

    most = words.num_iterations
    report("visual words", 0, most)
    found = words(descriptors, lambda done, _: report("visual words", min(done, most - 1), most))
    report("visual words", most, most)
    return FittedWords(projection, found, descriptors)


def _equal_blocks(batches: Iterable[Tensor]) -> Iterator[Tensor]:
    """Rows (m, C) of all batches in blocks of one size, the last smaller."""
    kept: list[Tensor] = []
    for batch in batches:
        kept.append(batch)
        while sum(map(len, kept)) >= _ROWS_PER_BLOCK:
            rows = torch.cat(kept) if len(kept) > 1 else kept[0]
            yield rows[:_ROWS_PER_BLOCK]
            kept = [rows[_ROWS_PER_BLOCK:]]
    rest = torch.cat(kept) if kept else torch.empty(0, 0)
    if len(rest) > 0:
        yield rest
