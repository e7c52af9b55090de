"""Perspective crops: virtual pinhole cameras focused on image regions."""

from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from foundpose.geometry.boxes import boxes_from_masks, masks_from_boxes
from foundpose.geometry.cameras import camera_on_boxes
from foundpose.geometry.warp import sample_pixels, sample_pyramids, warped_pixels
from foundpose.utils.devices import constant, indices_on
from foundpose.utils.settings import Configured, Setting

Background = Literal["keep", "black"]


class Crops(NamedTuple):
    """A batch of perspective crops.

    Attributes:
        images: (B, 3, S, S), black where the crop camera looks beyond the image, and with a black background outside
            the mask.
        masks: (B, S, S) in [0, 1], warped bilinearly; inside where above 0.5.
        K_crop: (B, 3, 3) intrinsics of the virtual cameras, pixels.
        T_crop_from_camera: (B, 4, 4) rotations of the virtual cameras.
        boxes: (B, 4) boxes in the image that the crops are focused on, pixel edges.
        valid: (B,) False for a mask that is empty or smaller than ``min_box_size``, for a box that is degenerate
            or outside its image, and for intrinsics that are no camera's. Such a crop shows the whole image (with a
            black background nothing), its mask is zero, and all of it is constant for autograd.
    """

    images: Tensor
    masks: Tensor
    K_crop: Tensor
    T_crop_from_camera: Tensor
    boxes: Tensor
    valid: Tensor


class PerspectiveCrop(Configured):
    """Warps image regions to virtual pinhole cameras (paper, "Perspective cropping").

    The axis of a virtual camera passes through the centre of the mask's 2D box and the longer side of the warped
    box is ``fill * size`` pixels. Several crops of one image share its memory.

    Args:
        size: side S of a crop in pixels.
        fill: δ, share of the crop's side that the box takes, in (0, 1].
        antialias: filter the image where a crop shrinks it (trilinear sampling of a box-filtered pyramid).
        min_box_size: boxes whose longer side is less than this many pixels are flagged as not valid.
        background: "keep", or "black": pixels outside the mask become 0, as templates have it. (The paper keeps the
            background but for one row of its Table 2, since patches outside the mask count for nothing anyway.)
    """

    def __init__(
        self,
        size: int = 420,
        fill: float = 0.6,
        antialias: bool = True,
        min_box_size: float = 2.0,
        background: Background = "keep",
    ) -> None:
        super().__init__()
        if background not in get_args(Background):
            raise ValueError(f"background must be one of {get_args(Background)}, got {background!r}")
        if size < 2:
            raise ValueError(f"size must be at least 2 pixels, got {size}")
        if not 0.0 < fill <= 1.0:
            raise ValueError(f"fill must be in (0, 1], got {fill}")
        self.size = size
        self.fill = fill
        self.antialias = antialias
        self.min_box_size = min_box_size
        self.background: Background = background

    def settings(self) -> dict[str, Setting]:
        """Settings by name."""
        return {
            "size": self.size,
            "fill": self.fill,
            "antialias": self.antialias,
            "min_box_size": self.min_box_size,
            "background": self.background,
        }

    def forward(
        self,
        images: Tensor,
        K: Tensor,
        masks: Tensor | None = None,
        boxes: Tensor | None = None,
        image_index: Tensor | None = None,
    ) -> Crops:
        """Crop.

        Args:
            images: (N, 3, H, W) in [0, 1].
            K: (N, 3, 3) intrinsics in pixels.
            masks: (B, H, W), non-zero inside. Either masks or boxes must be given; with both, the boxes say where
                the crops look and the masks are warped along.
            boxes: (B, 4) as ``(left, top, right, bottom)`` pixel edges.
            image_index: (B,) which image each mask belongs to; may be left out where B == N. Best on the host.

        Returns:
            The crops; pictures in the dtype of ``images``, cameras in at least single precision.

        Raises:
            ValueError: shapes or values that do not fit.

        Differentiable w.r.t. ``images``, ``K`` and ``boxes``. The crops' masks, and boxes that are found from
        masks, are constants; to differentiate a soft mask, pass it through ``foundpose.geometry.warp.warp_images``.
        """
        image_of_crop = _check_inputs(images, K, masks, boxes, image_index)
        # Half precision and autocast move pixels: cameras and warps are computed in single precision at least.
        dtype = torch.promote_types(images.dtype, torch.float32)
        boxes = None if boxes is None else boxes.to(images.device, dtype)
        with torch.autocast(images.device.type, enabled=False):
            crops = self._crop(images.to(dtype), K.to(images.device, dtype), masks, boxes, image_of_crop)
        return crops._replace(images=crops.images.to(images.dtype))

    def _crop(
        self, images: Tensor, K: Tensor, masks: Tensor | None, boxes: Tensor | None, image_of_crop: list[int]
    ) -> Crops:
        image_index = indices_on(images.device, torch.tensor(image_of_crop, dtype=torch.int64))
        height, width = images.shape[-2:]
        K, is_camera = _usable_intrinsics(K, height, width)
        if masks is not None:
            mask_boxes, occupied = boxes_from_masks(masks)
            boxes = mask_boxes.to(K) if boxes is None else boxes
        else:
            assert boxes is not None
            occupied = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
        usable = occupied & is_camera[image_index]
        boxes, valid = _usable_boxes(boxes, usable, height, width, self.min_box_size)

        K_camera = K[image_index]
        K_camera = torch.where(valid[:, None, None], K_camera, K_camera.detach())
        K_crop, T_crop_from_camera = camera_on_boxes(boxes, K_camera, self.size, self.fill)
        homographies = K_crop @ T_crop_from_camera[:, :3, :3] @ torch.linalg.inv(K_camera)
        levels = torch.zeros(len(boxes), device=images.device, dtype=images.dtype)
        if self.antialias:
            shrink = torch.maximum(K_camera[:, 0, 0], K_camera[:, 1, 1]) / K_crop[:, 0, 0]
            levels = shrink.clamp(min=1.0).log2()
        positions = warped_pixels(homographies, self.size)
        crops = sample_pyramids(images, positions, image_of_crop, levels)
        if crops.requires_grad:
            crops = torch.where(valid[:, None, None, None], crops, crops.detach())
        region = masks_from_boxes(boxes.detach(), height, width) if masks is None else masks != 0
        region = (region & valid[:, None, None]).to(images.dtype)
        crop_masks = sample_pixels(region[:, None], positions.detach())
        if self.background == "black":
            crops = torch.where(crop_masks > 0.5, crops, torch.zeros_like(crops))
        return Crops(crops, crop_masks[:, 0], K_crop, T_crop_from_camera, boxes, valid)


def _usable_intrinsics(K: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Replace intrinsics (N, 3, 3) that are no pinhole camera's by a common camera's; say which ones were usable."""
    focal = K.diagonal(dim1=1, dim2=2)[:, :2]
    bottom = constant([0.0, 0.0, 1.0], K)
    usable = torch.isfinite(K).all(dim=(1, 2)) & (focal > 0).all(dim=1) & (K[:, 2] == bottom).all(dim=1)
    focal_length = float(max(height, width))
    common = constant(
        [[focal_length, 0.0, (width - 1) / 2], [0.0, focal_length, (height - 1) / 2], [0.0, 0.0, 1.0]], K
    )
    return torch.where(usable[:, None, None], K, common), usable


def _usable_boxes(
    boxes: Tensor, usable: Tensor, height: int, width: int, min_size: float
) -> tuple[Tensor, Tensor]:
    """Replace boxes that are not usable or cannot be cropped by the whole image; say which ones are left."""
    left, top, right, bottom = boxes.unbind(-1)
    valid = usable & torch.isfinite(boxes).all(dim=-1) & (right > left) & (bottom > top)
    valid &= torch.maximum(right - left, bottom - top) >= min_size
    valid &= (right > -0.5) & (left < width - 0.5) & (bottom > -0.5) & (top < height - 0.5)
    whole = constant([-0.5, -0.5, width - 0.5, height - 0.5], boxes)
    return torch.where(valid[:, None], boxes, whole), valid


def _check_inputs(
    images: Tensor, K: Tensor, masks: Tensor | None, boxes: Tensor | None, image_index: Tensor | None
) -> list[int]:
    """Check shapes and values; return the image of each crop."""
    if images.dim() != 4 or images.shape[1] != 3 or not images.is_floating_point():
        raise ValueError(
            f"images must be floating point (N, 3, H, W), got {images.dtype} {tuple(images.shape)}"
        )
    num_images, _, height, width = images.shape
    if K.shape != (num_images, 3, 3):
        raise ValueError(f"K must have shape ({num_images}, 3, 3), one for each image, got {tuple(K.shape)}")
    if masks is None and boxes is None:
        raise ValueError("give masks (B, H, W) or boxes (B, 4); got neither")
    if masks is not None and (masks.dim() != 3 or masks.shape[1:] != (height, width)):
        raise ValueError(
            f"masks must have shape (B, {height}, {width}) as the images, got {tuple(masks.shape)}"
        )
    if boxes is not None and (boxes.dim() != 2 or boxes.shape[1] != 4):
        raise ValueError(f"boxes must have shape (B, 4), got {tuple(boxes.shape)}")
    count = len(masks) if masks is not None else len(boxes) if boxes is not None else 0
    if masks is not None and boxes is not None and len(boxes) != len(masks):
        raise ValueError(f"masks and boxes must agree in number, got {len(masks)} and {len(boxes)}")
    if image_index is None:
        if count != num_images:
            raise ValueError(f"image_index is needed: {count} masks or boxes for {num_images} images")
        return list(range(count))
    if image_index.shape != (count,) or image_index.is_floating_point() or image_index.dtype == torch.bool:
        raise ValueError(
            f"image_index must be ({count},) integers, got {tuple(image_index.shape)} {image_index.dtype}"
        )
    # Waits for the device if the index lies there; on the host, where callers have it from, it costs nothing.
    image_of_crop: list[int] = image_index.tolist()
    if count and not 0 <= min(image_of_crop) <= max(image_of_crop) < num_images:
        raise ValueError(f"image_index must lie in [0, {num_images}), got {image_of_crop}")
    return image_of_crop
