"""Resizing of images and resampling of feature maps; integer pixel coordinates are pixel centres."""

import torch
from torch import Tensor, nn


def resize_images(images: Tensor, size: int) -> Tensor:
    """Resize square images; a point at ``u`` goes to ``(u + 0.5) * size / S - 0.5``.

    Args:
        images: (B, C, S, S).
        size: new side in pixels.

    Returns:
        (B, C, size, size), bilinear, antialiased where the image shrinks.

    Differentiable w.r.t. ``images``.
    """
    old = images.shape[-1]
    if size == old:
        return images
    # Enlarging needs no antialiasing, and some devices have none.
    return nn.functional.interpolate(images, size=(size, size), mode="bilinear", antialias=size < old)


def sample_cells(features: Tensor, points: Tensor, stride: float, offset: float) -> Tensor:
    """Bilinear samples of feature maps at pixel coordinates.

    Args:
        features: (B, C, H, W); cell (row, column) is centred at ``(stride * column + offset,
            stride * row + offset)`` pixels.
        points: (h, w, 2) pixel coordinates ``(u, v)``.
        stride: distance of neighbouring cells in pixels.
        offset: pixel coordinate of the first cell.

    Returns:
        (B, C, h, w). Beyond the outermost cells' centres these are repeated.

    Differentiable w.r.t. ``features`` and ``points``.
    """
    height, width = features.shape[-2:]
    cells = (points - offset) / stride
    size = torch.tensor([width, height], device=points.device, dtype=points.dtype)
    grid = ((2 * cells + 1) / size - 1).to(features.dtype)
    return nn.functional.grid_sample(
        features,
        grid.expand(features.shape[0], -1, -1, -1),
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )


def on_grid(features: Tensor, n: int) -> Tensor:
    """Bilinear samples of feature maps at the centres of n × n cells, where both grids tile the same image.

    Args:
        features: (B, C, m, m).
        n: number of cells along a side.

    Returns:
        (B, C, n, n), in at least single precision; ``features`` themselves where they have n cells.

    Differentiable w.r.t. ``features``.
    """
    m = features.shape[-1]
    if m == n:
        return features
    # half precision could not hold the coordinates
    features = features.to(torch.promote_types(features.dtype, torch.float32))
    # the image is n pixels wide, so that its pixels are the cells asked for
    axis = torch.arange(n, device=features.device, dtype=features.dtype)
    centers = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), dim=-1)
    return sample_cells(features, centers, n / m, (n / m - 1) / 2)


def resample_position_embeddings(embeddings: Tensor, rows: int, columns: int, offset: float = 0.1) -> Tensor:
    """Resample position embeddings as the original DINOv2 (without registers) does.

    Args:
        embeddings: (1, 1 + n², C), that of the cls token first.
        rows: new number of rows of patches.
        columns: new number of columns.
        offset: added to the new numbers when the scale factor is computed, not to the numbers themselves.

    Returns:
        (1, 1 + rows * columns, C). Differentiable w.r.t. ``embeddings``.
    """
    n = round((embeddings.shape[1] - 1) ** 0.5)
    if rows == n and columns == n:
        return embeddings
    # bicubic in half precision would move the embeddings
    grid = embeddings[:, 1:].to(torch.promote_types(embeddings.dtype, torch.float32))
    grid = nn.functional.interpolate(
        grid.unflatten(1, (n, n)).permute(0, 3, 1, 2),
        scale_factor=((rows + offset) / n, (columns + offset) / n),
        mode="bicubic",
    )
    return torch.cat([embeddings[:, :1], grid.flatten(2).transpose(1, 2).to(embeddings.dtype)], dim=1)
