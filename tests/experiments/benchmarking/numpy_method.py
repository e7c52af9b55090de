"""Retrieval and matching as they are often written: loops over crops and templates, in NumPy."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def retrieve_by_template(
    descriptors: Array,
    valid: Array,
    words: Array,
    idf: Array,
    template_bow: Array,
    sigma: float,
    num_nearest: int,
    num_templates: int,
    root: bool = False,
) -> NDArray[np.int64]:
    """The most similar templates (B, h) of crops, one cosine similarity at a time.

    Args:
        descriptors: (B, P, d) projected descriptors.
        valid: (B, P) bool.
        words: (k, d).
        idf: (k,).
        template_bow: (T, k).
        sigma: of the soft assignment.
        num_nearest: words per patch.
        num_templates: h.
        root: take square roots of the weighted frequencies, as Hellinger's kernel does.
    """
    found = []
    for crop, mask in zip(descriptors, valid, strict=True):
        x = crop[mask]
        squared = (x**2).sum(1)[:, None] - 2.0 * x @ words.T + (words**2).sum(1)
        nearest = np.argsort(squared, axis=1)[:, :num_nearest]
        distance = np.take_along_axis(squared, nearest, axis=1)
        weight = np.exp(-(distance - distance[:, :1]) / (2.0 * sigma**2))
        weight /= weight.sum(1, keepdims=True)
        bow = np.zeros(len(words), dtype=x.dtype)
        np.add.at(bow, nearest, weight)
        bow = bow / max(len(x), 1) * idf
        bow = np.sqrt(bow) if root else bow
        bow /= max(float(np.linalg.norm(bow)), 1e-12)
        similarity = [float(bow @ template) / float(np.linalg.norm(template)) for template in template_bow]
        found.append(np.argsort(-np.asarray(similarity), kind="stable")[:num_templates])
    return np.stack(found)


def match_by_template(
    query: Array, query_valid: Array, template: Array, template_valid: Array
) -> NDArray[np.int64]:
    """The nearest template patch of each patch: (B, h, P); 0 for patches that are not valid.

    Args:
        query: (B, P, d) descriptors of crops.
        query_valid: (B, P) bool.
        template: (B, h, Q, d) descriptors of their templates.
        template_valid: (B, h, Q) bool.
    """
    matches = np.zeros((*template.shape[:2], query.shape[1]), dtype=np.int64)
    for b in range(len(query)):
        rows = np.flatnonzero(query_valid[b])
        for i in range(template.shape[1]):
            columns = np.flatnonzero(template_valid[b, i])
            x, y = query[b, rows], template[b, i, columns]
            squared = (x**2).sum(1)[:, None] - 2.0 * x @ y.T + (y**2).sum(1)
            matches[b, i, rows] = columns[squared.argmin(axis=1)]
    return matches
