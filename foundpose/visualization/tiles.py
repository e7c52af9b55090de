"""Pictures with captions, side by side: figures that are drawn in milliseconds."""

from collections.abc import Sequence

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

_GAP = 6
_TEXT_SIZE = 12
_WHITE = (255, 255, 255)


def captioned(picture: Image.Image, caption: str) -> Image.Image:
    """A picture below a line of text, which is cut off where it is wider than the picture."""
    font = ImageFont.load_default(_TEXT_SIZE)
    tile = Image.new("RGB", (picture.width, picture.height + _TEXT_SIZE + _GAP), _WHITE)
    ImageDraw.Draw(tile).text((1, 0), caption, font=font, fill=(20, 20, 20))
    tile.paste(picture, (0, _TEXT_SIZE + _GAP))
    return tile


def side_by_side(tiles: Sequence[Image.Image]) -> Image.Image:
    """Pictures in a row, their tops aligned, on white."""
    width = sum(tile.width for tile in tiles) + _GAP * (len(tiles) - 1)
    row = Image.new("RGB", (width, max(tile.height for tile in tiles)), _WHITE)
    left = 0
    for tile in tiles:
        row.paste(tile, (left, 0))
        left += tile.width + _GAP
    return row


def stacked(rows: Sequence[Image.Image]) -> Image.Image:
    """Pictures below each other, with a margin, on white."""
    width = max(row.width for row in rows) + 2 * _GAP
    sheet = Image.new("RGB", (width, sum(row.height + _GAP for row in rows) + _GAP), _WHITE)
    top = _GAP
    for row in rows:
        sheet.paste(row, (_GAP, top))
        top += row.height + _GAP
    return sheet


def draw_patches(pixels: Tensor, colors: Tensor, patch: float, size: int) -> Image.Image:
    """Patches as squares of a colour each, on black.

    Args:
        pixels: (n, 2) centres, pixels of the picture to be drawn.
        colors: (n, 3) in [0, 1].
        patch: side of a patch, pixels.
        size: side of the picture, pixels.
    """
    picture = Image.new("RGB", (size, size))
    draw = ImageDraw.Draw(picture)
    corners = torch.cat([pixels - patch / 2, pixels + patch / 2 - 0.5], dim=1).tolist()
    for corner, color in zip(corners, (colors.clamp(0, 1) * 255).round().int().tolist(), strict=True):
        draw.rectangle(corner, fill=tuple(color))
    return picture


def principal_colors(*descriptors: Tensor) -> list[Tensor]:
    """Colours (n, 3) in [0, 1] of descriptors (n, d ≥ 1): their first three components, on one scale for all."""
    leading = [torch.nn.functional.pad(x[:, :3].float(), (0, max(0, 3 - x.shape[1]))) for x in descriptors]
    everything = torch.cat(leading)
    if not len(everything):
        return leading
    low, high = (everything.quantile(q, dim=0) for q in (0.02, 0.98))
    return [((x - low) / (high - low).clamp(min=1e-9)).clamp(0, 1) for x in leading]


def resized(image: Tensor, height: int) -> Image.Image:
    """A picture (3, H, W) in [0, 1] of another height, its sides in proportion."""
    array = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    width = max(1, round(height * image.shape[2] / image.shape[1]))
    return Image.fromarray(array).resize((width, height), Image.Resampling.BILINEAR)
