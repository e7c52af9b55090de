"""From a mesh to an object representation."""

import copy
from itertools import chain
from typing import NamedTuple, Protocol, get_args

import torch
from torch import Tensor, nn

from foundpose.features.base import PatchExtractor
from foundpose.features.pca import CovarianceAccumulator, PcaProjection
from foundpose.onboarding.representation import ObjectRepresentation, RepresentationInfo
from foundpose.onboarding.templates import TemplateCameras, register_patches, template_cameras
from foundpose.rendering import Mesh, Renderer
from foundpose.retrieval import IdfMode, SoftAssignBow, VisualWords, WordAssignment
from foundpose.retrieval.bow import inverse_document_frequency, tf_idf, word_counts
from foundpose.retrieval.retriever import normalize_rows


class Progress(Protocol):
    """Is told how far a long computation has come."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``stage`` are finished."""


class _RawPatches(NamedTuple):
    """Valid patches of all templates before projection, on the CPU."""

    descriptors: list[Tensor]
    points_model: list[Tensor]
    patch_index: list[Tensor]
    counts: list[Tensor]
    cls: list[Tensor]


class Onboarder(nn.Module):
    """Builds the representation of an object from its mesh (paper, "Template-based object representation").

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
        batch_size: templates that are rendered and described at a time.
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
        batch_size: int = 16,
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
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
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
        self.batch_size = batch_size

    def settings(self) -> dict[str, str | int | float | bool | None]:
        """Settings that the representation depends on, beside mesh and extractor."""
        return {
            "viewpoints": repr(self.viewpoints),
            "words": repr(self.words),
            "bow": repr(self.bow),
            "num_components": self.projection.num_components,
            "image_size": self.image_size,
            "fill": self.fill,
            "distance": self.distance,
            "mask_erosion": self.mask_erosion,
            "idf_mode": self.idf_mode,
            "renderer": repr(self.renderer),
        }

    @torch.no_grad()  # clustering has no derivative, and a graph over all templates would fill the memory
    def forward(self, mesh: Mesh, name: str, progress: Progress | None = None) -> ObjectRepresentation:
        """Onboard an object.

        Args:
            mesh: the object.
            name: what to call it.
            progress: is told of every batch of templates and of every later stage.

        Returns:
            The representation, on the device of the extractor's parameters and buffers (the CPU if it has none).

        Raises:
            ValueError: too few patches for the PCA or the words.

        Not differentiable: what comes out are constants of later stages.
        """
        state = next(chain(self.extractor.parameters(), self.extractor.buffers()), torch.empty(0))
        # Autocast would move template cameras and points; the extractor has a precision of its own.
        with torch.autocast(state.device.type, enabled=False):
            return self._onboard(mesh, name, state.device, progress or _no_progress)

    def _onboard(self, mesh: Mesh, name: str, device: torch.device, report: Progress) -> ObjectRepresentation:
        rotations = self.viewpoints().to(device=device, dtype=torch.float32)
        cameras = template_cameras(mesh, rotations, self.image_size, self.fill, self.distance)
        raw, accumulator = self._describe_templates(mesh, cameras, report)

        report("PCA", 0, 1)
        projection = copy.deepcopy(self.projection).to(device).fit(accumulator)
        # One batch at a time, freeing the raw descriptors on the way.
        projected = []
        while raw.descriptors:
            projected.append(projection(raw.descriptors.pop(0).to(device)))
        descriptors = torch.cat(projected)
        report("PCA", 1, 1)

        most = self.words.num_iterations
        report("visual words", 0, most)
        words = self.words(descriptors, lambda done, _: report("visual words", min(done, most - 1), most))
        report("visual words", most, most)

        counts = torch.cat(raw.counts)
        grid = self.extractor.grid_size(self.image_size)
        cell_type = torch.int16 if grid**2 <= torch.iinfo(torch.int16).max else torch.int32
        representation = ObjectRepresentation(
            projection=projection,
            words=words,
            idf=words.new_zeros(len(words)),
            template_bow=words.new_zeros(len(counts), len(words)),
            descriptors=descriptors,
            points_model=torch.cat(raw.points_model).to(device),
            patch_index=torch.cat(raw.patch_index).to(device=device, dtype=cell_type),
            template_offsets=torch.cat([counts.new_zeros(1), counts.cumsum(0)]).to(device),
            T_template_from_model=cameras.T_template_from_model,
            K_template=cameras.K_template,
            template_cls=torch.cat(raw.cls).to(device) if raw.cls else None,
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
        )
        report("bags of words", 0, 1)
        idf, template_bow = describe_by_words(representation, self.bow, self.idf_mode)
        representation.idf.copy_(idf)
        representation.template_bow.copy_(template_bow)
        report("bags of words", 1, 1)
        return representation

    def _describe_templates(
        self, mesh: Mesh, cameras: TemplateCameras, report: Progress
    ) -> tuple[_RawPatches, CovarianceAccumulator]:
        """Render all templates and describe their valid patches, batch by batch."""
        device = cameras.K_template.device
        grid = self.extractor.grid_size(self.image_size)
        raw = _RawPatches([], [], [], [], [])
        accumulator = CovarianceAccumulator(self.extractor.channels, device)
        total = len(cameras.K_template)
        report("templates", 0, total)
        for start in range(0, total, self.batch_size):
            batch = TemplateCameras(*(part[start : start + self.batch_size] for part in cameras))
            render = self.renderer(mesh, *batch, (self.image_size, self.image_size))
            registered = register_patches(
                self.renderer,
                mesh,
                batch,
                render.mask,
                self.extractor.stride,
                self.extractor.offset,
                grid,
                self.mask_erosion,
            )
            features = self.extractor(render.rgb)
            valid = registered.valid.flatten(1)
            descriptors = features.patches.flatten(2).transpose(1, 2)[valid].float()
            accumulator.update(descriptors)
            raw.descriptors.append(descriptors.cpu())
            raw.points_model.append(registered.points_model.flatten(1, 2)[valid].cpu())
            raw.patch_index.append(torch.nonzero(valid)[:, 1].cpu())
            raw.counts.append(valid.sum(dim=1).cpu())
            if features.cls is not None:
                raw.cls.append(features.cls.float().cpu())
            report("templates", min(start + self.batch_size, total), total)
        return raw, accumulator


def describe_by_words(
    representation: ObjectRepresentation, bow: SoftAssignBow, idf_mode: IdfMode, batch_size: int = 64
) -> tuple[Tensor, Tensor]:
    """Inverse document frequencies (k,) and L2-normalised bags of words (T, k) of an object's templates."""
    words, valid = [], []
    for index in torch.arange(representation.num_templates, device=representation.words.device).split(
        batch_size
    ):
        patches = representation.gather_templates(index)
        words.append(bow.assign(patches.descriptors, patches.valid, representation.words))
        valid.append(patches.valid)
    assignment = WordAssignment(*(torch.cat(parts) for parts in zip(*words, strict=True)))
    num_words = len(representation.words)
    idf = inverse_document_frequency(assignment, torch.cat(valid), num_words, idf_mode)
    return idf, normalize_rows(tf_idf(word_counts(assignment, num_words), idf))


def _no_progress(stage: str, done: int, total: int) -> None:
    """Tell nobody."""
