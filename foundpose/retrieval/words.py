"""Visual words: the clusters of an object's patch descriptors."""

from torch import Tensor

from foundpose.clustering.kmeans import OnIteration, kmeans
from foundpose.utils.settings import Configured, Setting


class VisualWords(Configured):
    """Clusters descriptors to visual words; see :func:`foundpose.clustering.kmeans.kmeans`.

    Args:
        num_words: number k of words.
        num_iterations: upper bound of the k-means iterations.
        tolerance: relative fall of the inertia per iteration at which to stop.
        seed: of the initial centroids.

    Source: paper, "Bag-of-words descriptors".
    """

    def __init__(
        self, num_words: int = 2048, num_iterations: int = 25, tolerance: float = 1e-3, seed: int = 0
    ) -> None:
        super().__init__()
        if num_words < 1 or num_iterations < 1:
            raise ValueError(
                f"num_words and num_iterations must be at least 1, got {num_words} and {num_iterations}"
            )
        self.num_words = num_words
        self.num_iterations = num_iterations
        self.tolerance = tolerance
        self.seed = seed

    def forward(self, descriptors: Tensor, progress: OnIteration | None = None) -> Tensor:
        """Cluster descriptors (N, d) to words (k, d).

        Args:
            descriptors: (N, d) of all templates.
            progress: called after each iteration with its number and the inertia.

        Raises:
            ValueError: fewer (distinct) descriptors than words, or descriptors that are not finite.

        Not differentiable: descriptors are detached.
        """
        return kmeans(
            descriptors, self.num_words, self.num_iterations, self.seed, self.tolerance, progress
        ).centroids

    def settings(self) -> dict[str, Setting]:
        """Settings by name."""
        return {
            "num_words": self.num_words,
            "num_iterations": self.num_iterations,
            "tolerance": self.tolerance,
            "seed": self.seed,
        }
