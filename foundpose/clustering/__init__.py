"""k-means, for visual words and for codes of descriptors."""

from foundpose.clustering.kmeans import KMeansResult, kmeans

__all__ = ["KMeansResult", "kmeans"]
