"""Pairs of a crop and a template near it, described once and kept."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from foundpose.features import PatchFeatures
from foundpose.geometry import PerspectiveCrop, Symmetries
from foundpose.onboarding import ArtefactStore, Onboarder, Progress
from foundpose.pipeline import select_query_patches
from foundpose.rendering import Mesh
from foundpose.synthetic import LightVariation, combine_seeds
from foundpose.training.views import nearby_rotations, render_crops, render_templates
from foundpose.utils.settings import identity


class PairBatch(NamedTuple):
    """B pairs of a crop and a template of the same object, padded.

    Attributes:
        query_descriptors: (B, P, C) raw descriptors of the crop's patches inside the mask.
        query_pixels: (B, P, 2) their centres, pixels of the crop.
        query_valid: (B, P) bool.
        template_descriptors: (B, Q, C) raw descriptors of the template's patches on the object.
        template_points: (B, Q, 3) their points, mesh units.
        template_valid: (B, Q) bool.
        K_crop: (B, 3, 3) pixels.
        T_crop_from_model: (B, 4, 4) true poses, mesh units.
        surface: (B, M, 3) points of the object's surface, mesh units.
        diameter: (B,) mesh units.
        symmetries: of the B objects; None: they have none.
    """

    query_descriptors: Tensor
    query_pixels: Tensor
    query_valid: Tensor
    template_descriptors: Tensor
    template_points: Tensor
    template_valid: Tensor
    K_crop: Tensor
    T_crop_from_model: Tensor
    surface: Tensor
    diameter: Tensor
    symmetries: Symmetries | None = None


@dataclass(frozen=True)
class PairSettings:
    """What pairs are made of.

    Args:
        crops_per_mesh: number of scenes of each mesh.
        templates_per_crop: number of pairs that each crop is in.
        min_degrees: smallest angle between crop and template.
        max_degrees: largest angle between them. Retrieval delivers about 10 to 35 degrees.
        occlusion: hide a corner of the object in each scene.
        light: how the light of the scenes varies; templates have the onboarder's.
        surface_points: points of the object that the loss is taken on.

    Raises:
        ValueError: a number out of range.
    """

    crops_per_mesh: int = 60
    templates_per_crop: int = 2
    min_degrees: float = 5.0
    max_degrees: float = 35.0
    occlusion: bool = True
    light: LightVariation | None = None
    surface_points: int = 256

    def __post_init__(self) -> None:
        counts = (self.crops_per_mesh, self.templates_per_crop, self.surface_points)
        if min(counts) < 1:
            raise ValueError(
                f"crops_per_mesh, templates_per_crop and surface_points must be at least 1, got {counts}"
            )
        if not 0.0 <= self.min_degrees <= self.max_degrees <= 180.0:
            raise ValueError(
                f"need 0 <= min_degrees <= max_degrees <= 180, got {self.min_degrees} and {self.max_degrees}"
            )


class PatchPairs(torch.utils.data.Dataset[PairBatch]):
    """A data set of pairs in memory; ragged patches lie one after another.

    Use with a ``DataLoader`` whose ``collate_fn`` returns what it gets: a list of indices gives one padded batch.

    Args:
        tensors: ``query_*`` and ``template_*`` as in :class:`PairBatch` but all in a row; ``query_offsets`` and
            ``template_offsets`` cut them apart; ``query_of`` (N,) is the crop and ``mesh_of`` (N,) the mesh of each
            pair, ``K_crop`` and ``T_crop_from_model`` are those of the crops, ``surface`` and ``diameter`` of the
            meshes. Pair n owns template n.
        symmetries: of the meshes, one entry each (:func:`foundpose.geometry.stack_symmetries`); None: they have none.

    Raises:
        ValueError: symmetries of another number of objects.
    """

    def __init__(self, tensors: dict[str, Tensor], symmetries: Symmetries | None = None) -> None:
        if symmetries is not None:
            symmetries = symmetries.to("cpu", torch.float32)
            symmetries.check(len(tensors["surface"]), tensors["surface"])
        self.tensors = tensors
        self.symmetries = symmetries

    def __len__(self) -> int:
        return len(self.tensors["query_of"])

    def __getitem__(self, index: int) -> PairBatch:
        """One pair, as a batch of one."""
        return self.__getitems__([range(len(self))[index]])

    def __getitems__(self, indices: Sequence[int]) -> PairBatch:
        """A batch of pairs."""
        t = self.tensors
        pair = torch.as_tensor(indices) % len(self)
        query, mesh = t["query_of"][pair], t["mesh_of"][pair]
        query_rows, query_valid = _rows(t["query_offsets"], query)
        template_rows, template_valid = _rows(t["template_offsets"], pair)
        return PairBatch(
            _padded(t["query_descriptors"], query_rows, query_valid),
            _padded(t["query_pixels"], query_rows, query_valid),
            query_valid,
            _padded(t["template_descriptors"], template_rows, template_valid),
            _padded(t["template_points"], template_rows, template_valid),
            template_valid,
            t["K_crop"][query],
            t["T_crop_from_model"][query],
            t["surface"][mesh],
            t["diameter"][mesh],
            None if self.symmetries is None else self.symmetries.gather(mesh),
        )


def make_pairs(
    meshes: Sequence[Mesh],
    onboarder: Onboarder,
    crop: PerspectiveCrop,
    settings: PairSettings,
    seed: int,
    cache: ArtefactStore | None = None,
    progress: Progress | None = None,
) -> PatchPairs:
    """Render and describe pairs of objects without symmetries, or read them from the cache.

    Args:
        meshes: the objects; object i's scenes differ from those of object j.
        onboarder: its extractor describes the patches (without gradients), and templates are rendered as it does.
        crop: cuts the crops.
        settings: what the pairs are made of.
        seed: of everything that is random.
        cache: keeps the pairs; other settings, meshes or weights get another file. Symmetries change no picture:
            ``PatchPairs(make_pairs(…).tensors, symmetries)`` has them.
        progress: is told of every crop.

    Raises:
        ValueError: no meshes, or crop and templates of different sizes.
    """
    if not meshes:
        raise ValueError("meshes is empty: give at least one to make pairs of")
    if crop.size != onboarder.image_size:
        raise ValueError(
            f"crops are {crop.size} px wide, templates {onboarder.image_size} px; use one size for both"
        )
    facts = {
        "meshes": [mesh.checksum for mesh in meshes],
        "extractor": onboarder.extractor.fingerprint(),
        "precision": onboarder.extractor.running_precision(),
        "templates": [onboarder.image_size, onboarder.fill, onboarder.distance, onboarder.mask_erosion],
        "renderer": identity(onboarder.renderer),
        "crop": identity(crop),
        "pairs": asdict(settings),
        "seed": seed,
    }

    def make() -> dict[str, Tensor]:
        return _describe(meshes, onboarder, crop, settings, seed, progress)

    return PatchPairs(make() if cache is None else cache.get("pairs", facts, make))


@torch.no_grad()  # the descriptors are data; what is trained comes after them
def _describe(
    meshes: Sequence[Mesh],
    onboarder: Onboarder,
    crop: PerspectiveCrop,
    settings: PairSettings,
    seed: int,
    progress: Progress | None,
) -> dict[str, Tensor]:
    parts: dict[str, list[Tensor]] = {}
    done, total = 0, len(meshes) * settings.crops_per_mesh
    for number, mesh in enumerate(meshes):
        for chunk in _chunks(settings.crops_per_mesh, onboarder.batch_size):
            # One seed for each scene, whatever the size of the chunks.
            seeds = [combine_seeds(seed, number, k) for k in chunk]
            found = _describe_crops(mesh, seeds, onboarder, crop, settings)
            found["mesh_of"] = torch.full_like(found["query_of"], number)
            found["query_of"] += done
            for name, value in found.items():
                parts.setdefault(name, []).append(value)
            done += len(chunk)
            if progress is not None:
                progress("training pairs", done, total)
    joined = {name: torch.cat(values) for name, values in parts.items()}
    for name in ("query", "template"):
        counts = joined.pop(f"{name}_counts")
        joined[f"{name}_offsets"] = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    joined["surface"] = torch.stack([_surface(mesh, settings.surface_points, seed) for mesh in meshes])
    joined["diameter"] = torch.tensor([float(mesh.diameter) for mesh in meshes])
    return joined


def _describe_crops(
    mesh: Mesh, seeds: list[int], onboarder: Onboarder, crop: PerspectiveCrop, settings: PairSettings
) -> dict[str, Tensor]:
    """Pairs of some crops of one mesh; ``query_of`` counts from 0."""
    extractor = onboarder.extractor
    state = next(iter(extractor.parameters()), next(iter(extractor.buffers()), torch.empty(0)))
    crops, T = render_crops(mesh, seeds, crop, onboarder.renderer, settings.light, settings.occlusion)
    # The rest is small, and stays on the CPU.
    query = select_query_patches(
        PatchFeatures(extractor(crops.images.to(state.device)).patches.cpu(), None), crops, extractor
    )
    rotations = torch.cat(
        [
            nearby_rotations(
                R.expand(settings.templates_per_crop, 3, 3),
                settings.min_degrees,
                settings.max_degrees,
                torch.Generator().manual_seed(scene),
            )
            for R, scene in zip(T[:, :3, :3], seeds, strict=True)
        ]
    )
    views = render_templates(mesh, rotations, onboarder)
    patches = extractor(views.rgb.to(state.device)).patches.flatten(2).transpose(1, 2).cpu()
    valid = views.patches.valid.flatten(1)
    return {
        "query_descriptors": query.descriptors[query.valid].float(),
        "query_pixels": query.pixels[query.valid],
        "query_counts": query.valid.sum(1),
        "query_of": torch.arange(len(seeds)).repeat_interleave(settings.templates_per_crop),
        "K_crop": crops.K_crop,
        "T_crop_from_model": T,
        "template_descriptors": patches[valid].float(),
        "template_points": views.patches.points_model.flatten(1, 2)[valid],
        "template_counts": valid.sum(1),
    }


def _surface(mesh: Mesh, count: int, seed: int) -> Tensor:
    """Vertices (count, 3) drawn at random, with repetition."""
    generator = torch.Generator().manual_seed(seed)
    return mesh.vertices[torch.randint(len(mesh.vertices), (count,), generator=generator)]


def _chunks(count: int, size: int) -> Iterator[range]:
    for start in range(0, count, size):
        yield range(start, min(start + size, count))


def _rows(offsets: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (B, most) of ragged items, and which of them are the item's own."""
    start = offsets[index]
    count = offsets[index + 1] - start
    position = torch.arange(max(int(count.max()), 1))
    valid = position < count.unsqueeze(1)
    return torch.where(valid, start.unsqueeze(1) + position, 0), valid


def _padded(values: Tensor, rows: Tensor, valid: Tensor) -> Tensor:
    if len(values) == 0:
        return values.new_zeros(*rows.shape, values.shape[-1])
    return values[rows].masked_fill(~valid.unsqueeze(-1), 0.0)
