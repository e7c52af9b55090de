"""Drawing on pictures."""

from collections.abc import Sequence
from colorsys import hsv_to_rgb

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from foundpose.geometry import grow_masks, project_points, transform_points

Color = tuple[float, float, float]

# The paper's colours of contours.
TRUTH: Color = (1.0, 0.1, 0.1)
COARSE: Color = (0.2, 0.45, 1.0)
REFINED: Color = (0.1, 0.85, 0.2)


def draw_contour(image: Tensor, mask: Tensor, color: Color, width: int = 2) -> Tensor:
    """Draw the outline of a mask.

    Args:
        image: (3, H, W) in [0, 1].
        mask: (H, W) bool.
        color: of the outline.
        width: of the outline in pixels; it lies just outside the mask.

    Returns:
        A new (3, H, W) image.
    """
    outline = grow_masks(mask, width) & ~mask
    return torch.where(outline, image.new_tensor(color)[:, None, None], image)


def draw_axes(image: Tensor, T_camera_from_model: Tensor, K: Tensor, length: float, width: int = 2) -> Tensor:
    """Draw the model frame's axes: x red, y green, z blue.

    Args:
        image: (3, H, W) in [0, 1].
        T_camera_from_model: (4, 4).
        K: (3, 3) intrinsics.
        length: of an axis, mesh units.
        width: of a line in pixels.

    Returns:
        A new (3, H, W) image; unchanged where the axes do not lie in front of the camera.
    """
    points = torch.cat([torch.zeros(1, 3), length * torch.eye(3)]).to(T_camera_from_model)
    pixels, depth = project_points(transform_points(T_camera_from_model, points), K.to(T_camera_from_model))
    if not bool((depth > 0).all()):
        return image.clone()
    picture = to_pil(image)
    draw = ImageDraw.Draw(picture)
    origin, *tips = [tuple(pixel) for pixel in pixels.tolist()]
    for tip, color in zip(tips, ((255, 40, 40), (40, 220, 40), (60, 90, 255)), strict=True):
        draw.line([origin, tip], fill=color, width=width)
    return from_pil(picture).to(image)


def draw_instances(image: Tensor, masks: Sequence[Tensor], labels: Sequence[str], width: int = 2) -> Tensor:
    """Draw the outlines of instances, each in a colour of its own, with labels.

    Args:
        image: (3, H, W) in [0, 1].
        masks: (H, W) bool each.
        labels: what stands at each outline.
        width: of an outline in pixels.

    Returns:
        A new (3, H, W) image.
    """
    colors = [hsv_to_rgb(i / max(len(masks), 1), 0.85, 1.0) for i in range(len(masks))]
    for mask, color in zip(masks, colors, strict=True):
        image = draw_contour(image, mask.to(image.device), color, width)
    picture = to_pil(image)
    draw = ImageDraw.Draw(picture)
    for mask, color, label in zip(masks, colors, labels, strict=True):
        rows, columns = mask.nonzero(as_tuple=True)
        if not len(rows):
            continue
        at = (int(columns.min()), max(0, int(rows.min()) - 13))
        draw.rectangle(draw.textbbox(at, label), fill=(0, 0, 0))
        draw.text(at, label, fill=tuple(round(255 * x) for x in color))
    return from_pil(picture).to(image)


def to_pil(image: Tensor) -> Image.Image:
    """Convert (3, H, W) in [0, 1] to a picture."""
    array = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    return Image.fromarray(np.ascontiguousarray(array))


def from_pil(picture: Image.Image) -> Tensor:
    """Convert an RGB picture to (3, H, W) float32 in [0, 1]."""
    return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0).permute(2, 0, 1)
