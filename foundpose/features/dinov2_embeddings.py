"""Embeddings of DINOv2 without registers; imports transformers' model code, so import it late."""

from torch import Tensor
from transformers.models.dinov2.modeling_dinov2 import Dinov2Embeddings

from foundpose.features.dinov2_checkpoints import PATCH_SIZE
from foundpose.features.resample import resample_position_embeddings


class OriginalDinov2Embeddings(Dinov2Embeddings):
    """transformers' embeddings with the position embeddings resampled as in the original code."""

    def interpolate_pos_encoding(self, embeddings: Tensor, height: int, width: int) -> Tensor:
        """Position embeddings (1, 1 + rows * columns, C) of an image of this size in pixels."""
        return resample_position_embeddings(
            self.position_embeddings, height // PATCH_SIZE, width // PATCH_SIZE
        )
