"""Which of many objects a crop shows."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

import torch
from torch import Tensor, nn

from foundpose.representation import ObjectRepresentation
from foundpose.retrieval.base import normalize_rows
from foundpose.utils.files import read_weights, save_weights

_HEADER, _SCHEMA_VERSION = "foundpose.object_index", 1


class RankedObjects(NamedTuple):
    """Objects for each of B crops, most similar first.

    Attributes:
        object_index: (B, k) places in the index, int64.
        score: (B, k) mean cosine similarity of an object's templates that are most like the crop.
    """

    object_index: Tensor
    score: Tensor


class ObjectIndex(nn.Module):
    """The global (cls) tokens of the templates of many objects, to be compared with a crop's in one matrix product.

    Args:
        tokens: (N, T, C) of N objects with T templates each, of unit length.
        names: of the objects.
        num_best: an object's score is the mean over so many of its templates, those most like the crop.

    Raises:
        ValueError: shapes do not fit, or ``num_best`` is out of range.

    Source: the score is that of Nguyen et al., "CNOS: A strong baseline for CAD-based novel object segmentation",
    2023.
    """

    tokens: Tensor

    def __init__(self, tokens: Tensor, names: Sequence[str], num_best: int = 5) -> None:
        super().__init__()
        if tokens.ndim != 3 or len(tokens) != len(names):
            raise ValueError(f"tokens must have shape ({len(names)}, T, C), got {tuple(tokens.shape)}")
        if not 1 <= num_best <= tokens.shape[1]:
            raise ValueError(f"num_best must lie between 1 and {tokens.shape[1]}, got {num_best}")
        self.register_buffer("tokens", tokens)
        self.names = list(names)
        self.num_best = num_best

    @classmethod
    def of(cls, objects: Sequence[ObjectRepresentation], num_best: int = 5) -> Self:
        """The index of onboarded objects.

        Raises:
            ValueError: an object has no cls tokens, or another number of templates than the first.
        """
        missing = [obj.info.name for obj in objects if obj.template_cls is None]
        if missing:
            raise ValueError(
                f"{missing[0]!r} has no cls tokens: onboard it with a vision transformer that has one"
            )
        tokens = [normalize_rows(obj.template_cls) for obj in objects if obj.template_cls is not None]
        counts = sorted({len(each) for each in tokens})
        if len(counts) != 1:
            raise ValueError(f"the objects must have equally many templates, got {counts}")
        return cls(torch.stack(tokens), [obj.info.name for obj in objects], num_best)

    def forward(self, cls: Tensor, count: int = 1) -> RankedObjects:
        """Rank all objects for B crops.

        Args:
            cls: (B, C) global tokens of the crops, framed and on black background as templates are.
            count: number k of objects to return.

        Raises:
            ValueError: ``cls`` does not fit the tokens.

        Differentiable w.r.t. ``cls`` through ``score``.
        """
        objects, _, channels = self.tokens.shape
        if cls.ndim != 2 or cls.shape[1] != channels:
            raise ValueError(f"cls must have shape (B, {channels}), got {tuple(cls.shape)}")
        similarity = normalize_rows(cls) @ self.tokens.flatten(0, 1).T.to(cls)
        best = similarity.unflatten(1, (objects, -1)).topk(self.num_best, dim=-1).values
        score, object_index = best.mean(dim=-1).topk(min(count, objects), dim=-1)
        return RankedObjects(object_index, score)

    def save(self, path: str | Path) -> None:
        """Write one safetensors file. Atomic."""
        facts = {"schema_version": _SCHEMA_VERSION, "names": self.names, "num_best": self.num_best}
        save_weights(Path(path), self, _HEADER, facts)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what :meth:`save` wrote; on the CPU the tokens are the file itself, mapped into memory.

        Raises:
            FileNotFoundError: no such file.
            ValueError: another kind of file.
        """
        facts, tensors = read_weights(
            Path(path), _HEADER, _SCHEMA_VERSION, "object index", "make one by save"
        )
        return cls(tensors["tokens"], **facts)
