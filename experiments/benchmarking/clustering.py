"""k-means of other libraries."""

import logging
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_ROWS = 8192


def faiss_kmeans(points: NDArray[np.float32], clusters: int, iterations: int) -> NDArray[np.float32]:
    """Centroids (k, d) by faiss, of all points (it samples them by default)."""
    # It tells how it looked for its own libraries.
    logging.getLogger("faiss").setLevel(logging.WARNING)
    import faiss

    kmeans = faiss.Kmeans(
        points.shape[1], clusters, niter=iterations, seed=0, max_points_per_centroid=len(points)
    )
    kmeans.train(points)
    return np.asarray(kmeans.centroids)


def sklearn_kmeans(points: NDArray[np.float32], clusters: int, iterations: int) -> NDArray[np.float32]:
    """Centroids (k, d) by scikit-learn."""
    from sklearn.cluster import KMeans
    from sklearn.exceptions import ConvergenceWarning

    with warnings.catch_warnings():
        # That the iterations do not suffice is what they are there to say.
        warnings.simplefilter("ignore", ConvergenceWarning)
        kmeans = KMeans(clusters, n_init=1, max_iter=iterations, tol=0.0, random_state=0).fit(points)
    return np.asarray(kmeans.cluster_centers_, dtype=np.float32)


def inertia(points: Tensor, centroids: Tensor) -> float:
    """Sum of squared distances of points (N, d) to the nearest of the centroids (k, d), from differences."""
    total = torch.zeros((), dtype=torch.float64)
    for block in points.split(_ROWS):
        nearest = torch.cdist(block, centroids).argmin(dim=1)
        total += (block - centroids[nearest]).double().square().sum().cpu()
    return float(total)
