"""What is kept of an object after onboarding."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from foundpose.features.base import Fingerprint, PatchExtractor
from foundpose.features.pca import PcaProjection
from foundpose.representation.info import SCHEMA_VERSION, RepresentationInfo
from foundpose.representation.quantization import DescriptorCodec, Storage, codec_from_state, compress
from foundpose.utils.files import read_weights, save_weights

_HEADER = "foundpose"
_TENSORS = (
    *("words", "idf", "template_bow", "descriptors", "points_model", "patch_index", "template_offsets"),
    *("T_template_from_model", "K_template"),
)


class TemplatePatches(NamedTuple):
    """Patches of some templates, padded to the largest template of the object.

    Attributes:
        descriptors: (..., Q, d) projected descriptors, zero where not valid.
        points_model: (..., Q, 3) mesh units, zero where not valid.
        pixels: (..., Q, 2) patch centres in the template.
        valid: (..., Q) bool.
    """

    descriptors: Tensor
    points_model: Tensor
    pixels: Tensor
    valid: Tensor


class ObjectRepresentation(nn.Module):
    """Everything that inference needs to know of one object, as buffers.

    The patches of all templates lie one after another; ``template_offsets`` cuts them apart.

    Args:
        projection: fitted PCA, from C to d dimensions.
        words: (k, d) visual words.
        idf: (k,) inverse document frequencies.
        template_bow: (T, k) L2-normalised bags of words of the templates.
        descriptors: (M, d) projected descriptors of the valid patches of all templates; may be float16, for storage.
            With a codec, their codes (M, n), uint8; :meth:`read_descriptors` reads either.
        points_model: (M, 3) their 3D points, mesh units.
        patch_index: (M,) int, cell ``row * grid + column`` of each patch in its template.
        template_offsets: (T + 1,) int64; template t owns patches ``offsets[t]`` to ``offsets[t + 1]``.
        T_template_from_model: (T, 4, 4) poses of the object in the templates' cameras.
        K_template: (T, 3, 3) intrinsics of the templates.
        template_cls: (T, C') global descriptors, or None.
        info: facts that are not tensors.
        codec: decodes the descriptors; None where they are stored as numbers.

    Raises:
        ValueError: codes without a codec, or a codec without codes.
    """

    words: Tensor
    idf: Tensor
    template_bow: Tensor
    descriptors: Tensor
    points_model: Tensor
    patch_index: Tensor
    template_offsets: Tensor
    T_template_from_model: Tensor
    K_template: Tensor
    template_cls: Tensor | None

    def __init__(
        self,
        projection: PcaProjection,
        words: Tensor,
        idf: Tensor,
        template_bow: Tensor,
        descriptors: Tensor,
        points_model: Tensor,
        patch_index: Tensor,
        template_offsets: Tensor,
        T_template_from_model: Tensor,
        K_template: Tensor,
        template_cls: Tensor | None,
        info: RepresentationInfo,
        codec: DescriptorCodec | None = None,
    ) -> None:
        super().__init__()
        if descriptors.is_floating_point() != (codec is None):
            raise ValueError(
                f"descriptors are {descriptors.dtype} and the codec is {codec}; descriptors that are codes need the "
                "codec that made them, others have none"
            )
        self.projection = projection
        self.codec = codec
        self.register_buffer("words", words)
        self.register_buffer("idf", idf)
        self.register_buffer("template_bow", template_bow)
        self.register_buffer("descriptors", descriptors)
        self.register_buffer("points_model", points_model)
        self.register_buffer("patch_index", patch_index)
        self.register_buffer("template_offsets", template_offsets)
        self.register_buffer("T_template_from_model", T_template_from_model)
        self.register_buffer("K_template", K_template)
        self.register_buffer("template_cls", template_cls)
        self.info = info
        counts = template_offsets.diff()
        # Kept on the host: the padded size of a template must not cost a device read at every call.
        self.max_patches = int(counts.max()) if len(counts) else 0

    @property
    def num_templates(self) -> int:
        """Number of templates T."""
        return len(self.template_offsets) - 1

    def read_descriptors(self, rows: Tensor, components: int | None = None) -> Tensor:
        """Descriptors (..., d) of patches (...), which are rows of ``descriptors``, decoded where they are codes.

        They come in the type of the projection's components, whatever type they are stored in. With ``components``
        only so many leading components are returned, and read where they are not codes.

        Differentiable w.r.t. the buffer ``descriptors``, unless it holds codes, which are constants.
        """
        # Rows are copied whole, several times as fast as by indexing.
        table = self.descriptors if self.codec is not None else self.descriptors[:, :components]
        stored = table.index_select(0, rows.flatten())
        if self.codec is not None:
            stored = self.codec.decode(stored)[:, :components]
        # Converted after the gather: all of them in float32 would undo what storage in less saves.
        return stored.to(self.projection.components.dtype).reshape(*rows.shape, stored.shape[1])

    def gather_templates(self, index: Tensor, components: int | None = None) -> TemplatePatches:
        """Patches of templates: any shape of template indices (...) → (..., Q, ·), Q the largest template's count.

        With ``components`` descriptors have only so many leading components.

        Only the rows of these templates are read, which is all that a file mapped into memory then loads.

        Differentiable w.r.t. the buffers ``descriptors`` (unless they are codes) and ``points_model``.
        """
        start = self.template_offsets[index]
        count = self.template_offsets[index + 1] - start
        position = torch.arange(self.max_patches, device=index.device)
        valid = position < count.unsqueeze(-1)
        rows = torch.where(valid, start.unsqueeze(-1) + position, torch.zeros_like(position))
        keep = valid.unsqueeze(-1)
        gathered = self.read_descriptors(rows, components)
        descriptors = torch.where(keep, gathered, gathered.new_zeros(()))
        points = self.points_model.index_select(0, rows.flatten()).unflatten(0, rows.shape)
        points_model = torch.where(keep, points, points.new_zeros(()))
        cell = self.patch_index[rows].long()
        pixels = self.info.patch_grid.pixels_of(cell, self.points_model.dtype)
        return TemplatePatches(descriptors, points_model, pixels, valid)

    def nearest_views(self, T_camera_from_model: Tensor, count: int = 1) -> Tensor:
        """Indices (..., count) of the templates that see the object most as poses (..., 4, 4) do, nearest first.

        Not differentiable (indices).
        """
        R = T_camera_from_model[..., :3, :3].flatten(-2)
        views = self.T_template_from_model[:, :3, :3].flatten(1).to(R)
        return (R @ views.T).topk(min(count, len(views)), dim=-1).indices

    def with_storage(self, storage: Storage, subspaces: int = 64) -> Self:
        """The same representation with its descriptors kept otherwise; the other buffers are shared.

        Retrieval by bags of words does not change: those of the templates were made of the full descriptors.

        Args:
            storage: see :func:`foundpose.representation.quantization.compress`.
            subspaces: bytes of a descriptor with "pq".

        Raises:
            ValueError: this one holds codes already, which are less exact than what they were made of; or as
                :func:`~foundpose.representation.quantization.compress`.
        """
        if self.codec is not None:
            raise ValueError(
                f"the descriptors of {self.info.name!r} are codes ({type(self.codec).__name__}) already; convert the "
                "representation with storage=float32"
            )
        descriptors, codec = compress(self.descriptors, storage, subspaces)
        facts = {"storage": storage} | ({"pq_subspaces": subspaces} if storage == "pq" else {})
        tensors = dict(self.named_buffers(recurse=False)) | {"descriptors": descriptors}
        info = replace(self.info, settings=self.info.settings | facts)
        return self._of(self.projection, tensors, info, codec)

    def memory_bytes(self) -> dict[str, int]:
        """Bytes taken by each part, and their ``total``.

        The parts are the buffers' names (``descriptors``, ``template_bow``, ``points_model``, …), ``projection`` and,
        where descriptors are codes, ``codec``. Of a file that is mapped into memory, it is what can be resident.
        """
        parts: Counter[str] = Counter()
        for name, tensor in self.state_dict().items():
            parts[name.split(".")[0]] += tensor.numel() * tensor.element_size()
        return dict(parts) | {"total": parts.total()}

    def check_extractor(self, fingerprint: Fingerprint) -> None:
        """Refuse an extractor whose descriptors cannot be compared with this representation's.

        Args:
            fingerprint: of the extractor.

        Raises:
            ValueError: names the settings that differ.
        """
        expected = self.info.extractor
        if expected != fingerprint:
            names = sorted(set(expected) | set(fingerprint))
            differences = ", ".join(
                f"{name}: {expected.get(name)!r} here, {fingerprint.get(name)!r} given"
                for name in names
                if expected.get(name) != fingerprint.get(name)
            )
            raise ValueError(
                f"the representation of {self.info.name!r} was made with another extractor ({differences}); "
                "onboard the object again with this one"
            )

    def save(self, path: str | Path) -> None:
        """Write one safetensors file whose header holds the facts as JSON. Atomic."""
        save_weights(Path(path), self, _HEADER, asdict(self.info))

    @classmethod
    def load(
        cls,
        path: str | Path,
        device: torch.device | str = "cpu",
        extractor: PatchExtractor | None = None,
        mmap: bool = True,
    ) -> Self:
        """Read a representation.

        On the CPU the buffers are the file itself, mapped into memory: loading takes a millisecond and nearly no
        memory, the system reads pages when they are first used, shares them among processes, and may drop them when
        memory gets scarce. Writing into a buffer changes this process's copy of a page, never the file. Files that
        are replaced by :meth:`save`, renamed or deleted meanwhile stay readable for those that have them open, on
        Linux and macOS; only overwriting a file in place, which :meth:`save` never does, is not allowed.

        Args:
            path: a file written by :meth:`save`.
            device: where the buffers go; other devices than the CPU get copies.
            extractor: when given, the representation must have been made with an extractor like it.
            mmap: False reads everything at once, for file systems on which reading later is slow or may fail.

        Raises:
            FileNotFoundError: no such file.
            ValueError: not a representation, of another schema version, or made with another extractor.
        """
        facts, tensors = read_weights(
            Path(path), _HEADER, SCHEMA_VERSION, "object representation", "onboard the object first"
        )
        # On the CPU, a tensor of the file is a view of it.
        tensors = {name: (tensor if mmap else tensor.clone()).to(device) for name, tensor in tensors.items()}
        try:
            codec = codec_from_state(_part(tensors, "codec."))
            representation = cls._of(_load_projection(tensors), tensors, RepresentationInfo(**facts), codec)
        except ValueError as error:
            raise ValueError(f"{path}: {error}; onboard the object again") from error
        if extractor is not None:
            representation.check_extractor(extractor.fingerprint())
        return representation

    @classmethod
    def _of(
        cls,
        projection: PcaProjection,
        tensors: Mapping[str, Tensor],
        info: RepresentationInfo,
        codec: DescriptorCodec | None,
    ) -> Self:
        """The representation with some buffers, by name."""
        named = {name: _take(tensors, name) for name in _TENSORS}
        cls_tokens = tensors.get("template_cls")
        return cls(projection=projection, **named, template_cls=cls_tokens, info=info, codec=codec)


def _take(tensors: Mapping[str, Tensor], name: str) -> Tensor:
    """A tensor of the file."""
    if name not in tensors:
        raise ValueError(f"the tensor {name!r} is missing")
    return tensors[name]


def _part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """State dict of a submodule."""
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}


def _load_projection(tensors: Mapping[str, Tensor]) -> PcaProjection:
    """The PCA that is stored in the file."""
    components = _take(tensors, "projection.components")
    projection = PcaProjection(len(components)).to(components)
    # Assigned, not copied: the components of many objects take memory, too.
    projection.load_state_dict(_part(tensors, "projection."), assign=True)
    return projection
