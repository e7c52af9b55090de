"""Lightning's view of the pairs."""

from collections.abc import Sequence
from pathlib import Path

from foundpose.geometry import PerspectiveCrop, Symmetries
from foundpose.onboarding import ArtefactStore, Onboarder, Progress
from foundpose.rendering import Mesh
from foundpose.training.adapter.pairs import PairSettings, PatchPairs, make_pairs
from foundpose.training.base import RenderedDataModule


class PairDataModule(RenderedDataModule):
    """Renders and describes pairs of crop and template once, at first need, and deals them out in batches.

    Args:
        meshes: objects to train on.
        validation_meshes: other objects, for the validation loss; may be empty.
        onboarder: renders templates; its extractor describes all patches.
        crop: cuts the crops.
        pairs: what the pairs are made of.
        batch_size: pairs in a batch.
        seed: of scenes, templates and the order of the pairs.
        cache: folder to keep the described pairs in, or None.
        progress: is told how far rendering has come.
        symmetries: of the meshes to train on, one entry each; None: they have none.
        validation_symmetries: of the others.

    Raises:
        ValueError: no meshes or no batch.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        validation_meshes: Sequence[Mesh],
        onboarder: Onboarder,
        crop: PerspectiveCrop,
        pairs: PairSettings,
        batch_size: int = 16,
        seed: int = 0,
        cache: str | Path | None = None,
        progress: Progress | None = None,
        symmetries: Symmetries | None = None,
        validation_symmetries: Symmetries | None = None,
    ) -> None:
        super().__init__(meshes, validation_meshes, batch_size, 1, seed)
        self.onboarder = onboarder
        self.crop = crop
        self.pairs = pairs
        self.cache = None if cache is None else ArtefactStore(cache)
        self.progress = progress
        self.symmetries = symmetries
        self.validation_symmetries = validation_symmetries

    def render(self, validation: bool) -> PatchPairs:
        """Make the pairs."""
        meshes = self.validation_meshes if validation else self.meshes
        symmetries = self.validation_symmetries if validation else self.symmetries
        if symmetries is not None:
            symmetries.check(len(meshes), symmetries.transforms)  # now, not after hours of rendering
        seed = self.seed + validation
        found = make_pairs(meshes, self.onboarder, self.crop, self.pairs, seed, self.cache, self.progress)
        return PatchPairs(found.tensors, symmetries)
