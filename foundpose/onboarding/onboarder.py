"""From a mesh to an object representation."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from typing import TypeVar, get_args

import torch
from torch import Tensor, nn

from foundpose.features.base import PatchExtractor
from foundpose.features.pca import PcaProjection
from foundpose.onboarding.bags import describe_by_words
from foundpose.onboarding.compression import dequantize, quantize
from foundpose.onboarding.fitting import fit_words
from foundpose.onboarding.prefetch import pin, prefetch, upload
from foundpose.onboarding.scales import measure_scales
from foundpose.onboarding.stages import (
    FittedWords,
    PatchTable,
    Progress,
    RawDescriptors,
    TemplatePictures,
    ignore_progress,
)
from foundpose.onboarding.templates import TemplateCameras, register_patches, template_cameras
from foundpose.rendering import Mesh, Renderer
from foundpose.representation import ObjectRepresentation, RepresentationInfo
from foundpose.representation.quantization import Storage, check_storage
from foundpose.retrieval import IdfMode, SoftAssignBow, VisualWords
from foundpose.utils.batch_size import BatchSize, check_batch_size, measure_batch_size
from foundpose.utils.settings import Setting, identity

_T = TypeVar("_T")


class Onboarder(nn.Module):
    """Builds the representation of an object from its mesh (paper, "Template-based object representation").

    :meth:`forward` does all of it and keeps nothing on disk. The methods below it are its stages, which
    :class:`CachedOnboarding` runs as well, with files in between.

    Args:
        renderer: renders the templates.
        extractor: describes their patches; inference must use one with the same fingerprint.
        viewpoints: module that returns the orientations of the templates (T, 3, 3).
        words: clusters projected descriptors to visual words.
        bow: makes the templates' bags of words; its settings must be those of the retriever.
        projection: says how many PCA components there are; each object gets a fitted copy.
        image_size: side S of a template in pixels.
        fill: δ, share of the side that the object's 2D box takes.
        distance: distance of the templates' cameras in diameters.
        mask_erosion: template masks are eroded by a square of this many pixels (odd; 0 for none).
        idf_mode: "document" or "occurrence", see :func:`inverse_document_frequency`.
        batch_size: templates that are rendered and described at a time; "auto" finds out on first use how many the
            device has memory for.
        storage: how the representation keeps the patches' descriptors. "float16" halves their memory, "int8" quarters
            it with a scale for each component, "pq" takes ``pq_subspaces`` bytes for each by product quantisation;
            computations are in float32 all the same.
        pq_subspaces: bytes of a descriptor with ``storage="pq"``; divides the number of PCA components.
        margin: describe templates without the patches that lie farther than so many from the square that the object
            fills, for extractors that can leave out a border: less work, and slightly other descriptors. None: whole.
    """

    def __init__(
        self,
        renderer: Renderer,
        extractor: PatchExtractor,
        viewpoints: nn.Module,
        words: VisualWords,
        bow: SoftAssignBow,
        projection: PcaProjection | None = None,
        image_size: int = 420,
        fill: float = 0.6,
        distance: float = 6.0,
        mask_erosion: int = 5,
        idf_mode: IdfMode = "document",
        batch_size: BatchSize = 16,
        storage: Storage = "float32",
        pq_subspaces: int = 64,
        margin: int | None = None,
    ) -> None:
        super().__init__()
        projection = PcaProjection() if projection is None else projection
        if projection.num_components > extractor.channels:
            raise ValueError(
                f"num_components is {projection.num_components} but the extractor's descriptors have "
                f"{extractor.channels} channels; set projection.num_components to at most that"
            )
        if idf_mode not in get_args(IdfMode):
            raise ValueError(f"idf_mode must be one of {get_args(IdfMode)}, got {idf_mode!r}")
        if not 0.0 < fill <= 1.0:
            raise ValueError(f"fill must be in (0, 1], got {fill}")
        if mask_erosion < 0 or (mask_erosion > 0 and mask_erosion % 2 == 0):
            raise ValueError(f"mask_erosion must be 0 or odd, got {mask_erosion}")
        if distance <= 1.0:
            raise ValueError(f"distance must be more than one diameter, got {distance}")
        check_batch_size(batch_size)
        check_storage(storage, pq_subspaces, projection.num_components)
        for module in (renderer, viewpoints, words, bow):
            identity(module)  # raises for one that does not say its settings
        self.renderer = renderer
        self.extractor = extractor
        self.viewpoints = viewpoints
        self.words = words
        self.bow = bow
        self.projection = projection
        self.image_size = image_size
        self.fill = fill
        self.distance = distance
        self.mask_erosion = mask_erosion
        self.idf_mode: IdfMode = idf_mode
        self._batch_size: BatchSize = batch_size
        self.storage: Storage = storage
        self.pq_subspaces = pq_subspaces
        self.border = extractor.border(image_size, fill, margin)

    def settings(self) -> dict[str, Setting]:
        """Settings that the representation depends on, beside mesh and extractor."""
        return {
            "viewpoints": identity(self.viewpoints),
            "words": identity(self.words),
            "bow": identity(self.bow),
            "num_components": self.projection.num_components,
            "image_size": self.image_size,
            "fill": self.fill,
            "distance": self.distance,
            "mask_erosion": self.mask_erosion,
            "idf_mode": self.idf_mode,
            "renderer": identity(self.renderer),
            "bits": self.renderer.bits,
            "storage": self.storage,
            **({"pq_subspaces": self.pq_subspaces} if self.storage == "pq" else {}),
            **({"border": self.border} if self.border else {}),
        }

    @property
    def device(self) -> torch.device:
        """Device of the extractor's parameters and buffers (the CPU if it has none); the stages compute there."""
        return next(chain(self.extractor.parameters(), self.extractor.buffers()), torch.empty(0)).device

    @property
    def batch_size(self) -> int:
        """Templates that are rendered and described at a time.

        Raises:
            ValueError: it is "auto", and the device is one whose free memory cannot be told.
        """
        if self._batch_size == "auto":
            with self.constants():
                self._batch_size = measure_batch_size(self._try_batch, self.device)
        return self._batch_size

    @batch_size.setter
    def batch_size(self, value: BatchSize) -> None:
        check_batch_size(value)
        self._batch_size = value

    def forward(self, mesh: Mesh, name: str, progress: Progress | None = None) -> ObjectRepresentation:
        """Onboard an object.

        Args:
            mesh: the object.
            name: what to call it.
            progress: is told of every batch of templates and of every later stage.

        Returns:
            The representation, on the extractor's device.

        Raises:
            ValueError: too few patches for the PCA or the words, or descriptors too large for ``storage``.

        Not differentiable: what comes out are constants of later stages.

        Until the words are found a GPU holds the raw descriptors, 1 GB with a ViT-L and 800 templates;
        :class:`CachedOnboarding` keeps them in files.
        """
        report = progress or ignore_progress
        with self.constants():
            cameras = self.cameras(mesh)
            device = self.device
            tables, raw, cls = [], [], []

            def prepare(batch: TemplateCameras, _: slice) -> tuple[Tensor, PatchTable]:
                pictures = self.render(mesh, batch)
                table = self.register(mesh, batch, pictures.masks)
                return pin(pictures.levels, device), PatchTable(*(pin(part, device) for part in table))

            with self.batches(cameras, prepare, "templates", report) as batches:
                for (levels, table), _ in batches:
                    described = self.describe(levels, table)
                    tables.append(table)
                    raw.append(described.descriptors)
                    cls.append(described.template_cls)
            patches = PatchTable(*(torch.cat(parts) for parts in zip(*tables, strict=True)))
            fitted = self.fit(raw, report)
            return self.assemble(mesh, name, cameras, patches, torch.cat(cls), fitted, report)

    @contextmanager
    def constants(self) -> Iterator[None]:
        """Within it run the stages: without autograd and without autocast.

        Clustering has no derivative and a graph over all templates would fill the memory; autocast would move
        template cameras and points (the extractor has a precision of its own).
        """
        with torch.no_grad(), torch.autocast(self.device.type, enabled=False):
            yield

    @contextmanager
    def batches(
        self,
        cameras: TemplateCameras,
        prepare: Callable[[TemplateCameras, slice], _T],
        stage: str,
        report: Progress,
    ) -> Iterator[Iterator[tuple[_T, slice]]]:
        """What ``prepare`` makes of the cameras of ``batch_size`` templates at a time, and which templates these are.

        Where the extractor has a processor of its own, the next batch is prepared while the caller works on the last
        one. On the CPU both would wait for the same cores. ``report`` is told of each batch that is done with.
        """
        total, size = len(cameras.K_template), self.batch_size
        rows = [slice(start, min(start + size, total)) for start in range(0, total, size)]

        def make(chosen: slice) -> tuple[_T, slice]:
            with self.constants():  # of the thread
                return prepare(TemplateCameras(*(part[chosen] for part in cameras)), chosen), chosen

        def reported(batches: Iterator[tuple[_T, slice]]) -> Iterator[tuple[_T, slice]]:
            report(stage, 0, total)
            for prepared, chosen in batches:
                yield prepared, chosen
                report(stage, chosen.stop, total)

        with prefetch(make, rows, ahead=self.device.type != "cpu") as batches:
            yield reported(batches)

    def cameras(self, mesh: Mesh) -> TemplateCameras:
        """Cameras of all templates, on the CPU, where they are rendered."""
        rotations = self.viewpoints().to(device="cpu", dtype=torch.float32)
        return template_cameras(mesh, rotations, self.image_size, self.fill, self.distance)

    def render(self, mesh: Mesh, cameras: TemplateCameras) -> TemplatePictures:
        """Render some templates. Their colours are rounded, as those of photographs are, so files lose nothing."""
        render = self.renderer(mesh, *cameras, (self.image_size, self.image_size))
        return TemplatePictures(quantize(render.rgb, self.renderer.bits), render.mask)

    def register(self, mesh: Mesh, cameras: TemplateCameras, masks: Tensor) -> PatchTable:
        """Find the valid patches of some templates and their 3D points."""
        extractor = self.extractor
        grid = extractor.patch_grid(self.image_size)
        found = register_patches(self.renderer, mesh, cameras, masks, grid, self.mask_erosion)
        valid = found.valid.flatten(1)
        points_model = found.points_model.flatten(1, 2)[valid]
        return PatchTable(points_model, torch.nonzero(valid)[:, 1], valid.sum(dim=1))

    def describe(self, levels: Tensor, patches: PatchTable) -> RawDescriptors:
        """Describe some templates and their valid patches, on the extractor's device.

        Args:
            levels: (B, 3, S, S) pictures, on any device; those in pinned memory are fetched without waiting.
            patches: of the pictures, on the CPU.
        """
        template = torch.arange(len(levels)).repeat_interleave(patches.counts)
        template = upload(pin(template, self.device), self.device)
        cells = upload(patches.patch_index, self.device)
        images = dequantize(upload(levels, self.device), self.renderer.bits)
        features = self.extractor.within(images, self.border)
        descriptors = features.patches.flatten(2).transpose(1, 2)[template, cells].float()
        cls = descriptors.new_empty(len(levels), 0) if features.cls is None else features.cls.float()
        return RawDescriptors(descriptors, cls)

    def _try_batch(self, samples: int) -> None:
        """Describe so many pictures of nothing, with all their patches."""
        extractor, size = self.extractor, self.image_size
        levels = torch.zeros(samples, 3, size, size, dtype=torch.uint8)
        cells = torch.arange(extractor.patch_grid(size).size ** 2)
        counts = torch.full((samples,), len(cells))
        self.describe(levels, PatchTable(torch.empty(0, 3), cells.repeat(samples), counts))

    def fit(self, raw: list[Tensor], report: Progress) -> FittedWords:
        """Fit projection and words.

        Args:
            raw: descriptors (m, C) of batches of templates; the list is emptied on the way, which frees memory.
            report: is told of the progress.
        """
        return fit_words(raw, self.projection, self.words, self.device, report)

    def assemble(
        self,
        mesh: Mesh,
        name: str,
        cameras: TemplateCameras,
        patches: PatchTable,
        template_cls: Tensor,
        fitted: FittedWords,
        report: Progress,
    ) -> ObjectRepresentation:
        """Describe the templates by words and put the representation together, on the extractor's device."""
        device = self.device
        grid = self.extractor.patch_grid(self.image_size).size
        cell_type = torch.int16 if grid**2 <= torch.iinfo(torch.int16).max else torch.int32
        words, counts = fitted.words, patches.counts
        representation = ObjectRepresentation(
            projection=fitted.projection,
            words=words,
            idf=words.new_zeros(len(words)),
            template_bow=words.new_zeros(len(counts), len(words)),
            descriptors=fitted.descriptors,
            points_model=patches.points_model,
            patch_index=patches.patch_index.to(cell_type),
            template_offsets=torch.cat([counts.new_zeros(1), counts.cumsum(0)]),
            T_template_from_model=cameras.T_template_from_model,
            K_template=cameras.K_template,
            template_cls=template_cls if template_cls.shape[1] > 0 else None,
            info=RepresentationInfo(
                name=name,
                diameter=float(mesh.diameter),
                mesh_checksum=mesh.checksum,
                extractor=self.extractor.fingerprint(),
                image_size=self.image_size,
                stride=self.extractor.stride,
                offset=self.extractor.offset,
                grid=grid,
                settings=self.settings(),
            ),
        ).to(device)
        report("bags of words", 0, 1)
        scales = measure_scales(representation).known()
        representation.info = replace(representation.info, scales=scales)
        idf, template_bow = describe_by_words(representation, self.bow, self.idf_mode)
        representation.idf.copy_(idf)
        representation.template_bow.copy_(template_bow)
        report("bags of words", 1, 1)
        # Only now: the templates' bags of words do not depend on how the descriptors are stored.
        if self.storage == "float32":
            return representation
        report("storage", 0, 1)
        stored = representation.with_storage(self.storage, self.pq_subspaces)
        report("storage", 1, 1)
        return stored
