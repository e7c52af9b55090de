"""Onboarding with files between its stages, so that a changed setting redoes only what depends on it."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from foundpose.features.base import Fingerprint
from foundpose.features.pca import PcaProjection
from foundpose.onboarding.artefacts import ArtefactStore
from foundpose.onboarding.compression import PackedPictures, join_pictures, pack_pictures, unpack_pictures
from foundpose.onboarding.onboarder import Onboarder
from foundpose.onboarding.prefetch import pin
from foundpose.onboarding.stages import FittedWords, PatchTable, Progress, TemplatePictures, ignore_progress
from foundpose.onboarding.templates import TemplateCameras
from foundpose.rendering import Mesh
from foundpose.representation.object_representation import ObjectRepresentation
from foundpose.utils.settings import identity

Facts = dict[str, Any]
_PROJECTION = "projection."


class CachedOnboarding:
    """Onboards objects as an :class:`Onboarder` does, bit for bit, and keeps the results of its stages.

    Each kind of artefact depends on the one before and on the settings named here, and on nothing else:

    - ``renderings``: mesh, renderer, viewpoints, size, fill and distance of the templates;
    - ``patches``: stride, offset and grid of the extractor, erosion of the masks;
    - ``descriptors``: fingerprint of the extractor, the precision that it runs in, what it leaves out;
    - ``words``: number of components, settings of the visual words.

    An artefact is made only when one that needs it is missing: with ``patches`` and ``words`` there, the others may
    be deleted. Settings that leave the result alone but for rounding (batch size, device) are not told apart.

    Args:
        onboarder: computes the stages.
        artefacts: keeps their results.
        fingerprint: of the onboarder's extractor, where the caller knows it already.
    """

    def __init__(
        self, onboarder: Onboarder, artefacts: ArtefactStore, fingerprint: Fingerprint | None = None
    ) -> None:
        self.onboarder = onboarder
        self.artefacts = artefacts
        self.fingerprint = onboarder.extractor.fingerprint() if fingerprint is None else fingerprint

    def __call__(self, mesh: Mesh, name: str, progress: Progress | None = None) -> ObjectRepresentation:
        """Onboard an object; see :meth:`Onboarder.forward`.

        Args:
            mesh: the object.
            name: what to call it.
            progress: is told of the stages that are not there yet: beside the onboarder's own, "renderings" and
                "patches".
        """
        report = progress or ignore_progress
        with self.onboarder.constants():
            cameras, patches = self._patches(mesh, report)
            fitted, template_cls = self._words(mesh, report)
            return self.onboarder.assemble(mesh, name, cameras, patches, template_cls, fitted, report)

    def facts(self, mesh: Mesh) -> dict[str, Facts]:
        """What each kind of artefact of an object depends on."""
        onboarder, extractor = self.onboarder, self.onboarder.extractor
        renderings = {
            "mesh": mesh.checksum,
            "renderer": identity(onboarder.renderer),
            "bits": onboarder.renderer.bits,
            "viewpoints": identity(onboarder.viewpoints),
            "image_size": onboarder.image_size,
            "fill": onboarder.fill,
            "distance": onboarder.distance,
        }
        patches = {
            "renderings": self.artefacts.key("renderings", renderings),
            "stride": extractor.stride,
            "offset": extractor.offset,
            "grid": extractor.patch_grid(onboarder.image_size).size,
            "mask_erosion": onboarder.mask_erosion,
        }
        descriptors = {
            "patches": self.artefacts.key("patches", patches),
            "extractor": self.fingerprint,
            "precision": extractor.running_precision(),
            **({"border": onboarder.border} if onboarder.border else {}),
        }
        words = {
            "descriptors": self.artefacts.key("descriptors", descriptors),
            "num_components": onboarder.projection.num_components,
            "words": identity(onboarder.words),
        }
        return {"renderings": renderings, "patches": patches, "descriptors": descriptors, "words": words}

    def _get(self, kind: str, mesh: Mesh, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
        return self.artefacts.get(kind, self.facts(mesh)[kind], make)

    def _renderings(self, mesh: Mesh, report: Progress) -> tuple[TemplateCameras, PackedPictures]:
        """Cameras and compressed pictures of all templates."""
        onboarder = self.onboarder

        def make() -> Mapping[str, Tensor]:
            cameras = onboarder.cameras(mesh)

            def prepare(batch: TemplateCameras, _: slice) -> TemplatePictures:
                return onboarder.render(mesh, batch)

            with onboarder.batches(cameras, prepare, "renderings", report) as batches:
                bits = onboarder.renderer.bits
                packed = join_pictures([pack_pictures(*pictures, bits) for pictures, _ in batches])
            return cameras._asdict() | packed._asdict()

        tensors = self._get("renderings", mesh, make)
        return _cameras(tensors), PackedPictures(*(tensors[name] for name in PackedPictures._fields))

    def _unpack(self, packed: PackedPictures, rows: slice) -> TemplatePictures:
        """Pictures and masks of some templates."""
        size = (self.onboarder.image_size, self.onboarder.image_size)
        return TemplatePictures(*unpack_pictures(packed, rows, size, self.onboarder.renderer.bits))

    def _patches(self, mesh: Mesh, report: Progress) -> tuple[TemplateCameras, PatchTable]:
        """Cameras of all templates and their valid patches."""
        onboarder = self.onboarder

        def make() -> Mapping[str, Tensor]:
            cameras, packed = self._renderings(mesh, report)

            def prepare(batch: TemplateCameras, rows: slice) -> PatchTable:
                return onboarder.register(mesh, batch, self._unpack(packed, rows).masks)

            with onboarder.batches(cameras, prepare, "patches", report) as batches:
                tables = [table for table, _ in batches]
            table = PatchTable(*(torch.cat(parts) for parts in zip(*tables, strict=True)))
            return cameras._asdict() | table._asdict()

        tensors = self._get("patches", mesh, make)
        return _cameras(tensors), PatchTable(*(tensors[name] for name in PatchTable._fields))

    def _descriptors(self, mesh: Mesh, report: Progress) -> tuple[list[Tensor], Tensor]:
        """Descriptors of all templates, and their global ones."""
        onboarder = self.onboarder
        device = onboarder.device
        _, patches = self._patches(mesh, report)
        counts = patches.counts
        ends = [0, *counts.cumsum(0).tolist()]

        def make() -> Mapping[str, Tensor]:
            cameras, packed = self._renderings(mesh, report)

            def prepare(_: TemplateCameras, rows: slice) -> tuple[Tensor, PatchTable]:
                of_batch = slice(ends[rows.start], ends[rows.stop])
                table = PatchTable(
                    patches.points_model[of_batch], patches.patch_index[of_batch], counts[rows]
                )
                levels = self._unpack(packed, rows).levels
                return pin(levels, device), PatchTable(*(pin(part, device) for part in table))

            # Filled batch by batch: joining a list would take the memory twice.
            descriptors = torch.empty(ends[-1], onboarder.extractor.channels, device=device)
            cls = []
            with onboarder.batches(cameras, prepare, "templates", report) as batches:
                for (levels, table), rows in batches:
                    described = onboarder.describe(levels, table)
                    descriptors[ends[rows.start] : ends[rows.stop]] = described.descriptors
                    cls.append(described.template_cls)
            return {"descriptors": descriptors, "template_cls": torch.cat(cls)}

        tensors = self._get("descriptors", mesh, make)
        return [tensors["descriptors"]], tensors["template_cls"]

    def _words(self, mesh: Mesh, report: Progress) -> tuple[FittedWords, Tensor]:
        """Projection, words and projected descriptors; and the templates' global descriptors."""
        onboarder = self.onboarder

        def make() -> Mapping[str, Tensor]:
            raw, template_cls = self._descriptors(mesh, report)
            fitted = onboarder.fit(raw, report)
            state = {_PROJECTION + name: value for name, value in fitted.projection.state_dict().items()}
            # Kept here as well, so that the raw descriptors, the largest files by far, may be deleted.
            return state | {
                "words": fitted.words,
                "descriptors": fitted.descriptors,
                "template_cls": template_cls,
            }

        tensors = self._get("words", mesh, make)
        state = {
            name.removeprefix(_PROJECTION): t for name, t in tensors.items() if name.startswith(_PROJECTION)
        }
        projection = PcaProjection(onboarder.projection.num_components).to(state["components"])
        projection.load_state_dict(state)
        return FittedWords(projection, tensors["words"], tensors["descriptors"]), tensors["template_cls"]


def _cameras(tensors: Mapping[str, Tensor]) -> TemplateCameras:
    return TemplateCameras(*(tensors[name] for name in TemplateCameras._fields))
