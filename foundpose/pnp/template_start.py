"""The pose of a retrieved template, moved to where its patches were matched to."""

import torch
from torch import Tensor, nn

from foundpose.geometry.cameras import axis_rotation_to_ray, pixel_rays
from foundpose.geometry.similarity import apply_similarity, fit_similarity_robustly
from foundpose.geometry.transforms import make_transform

# Distances in pixels at which a match counts a half, in each fit: templates and crops are framed alike, so right
# matches lie near each other from the start.
_SCALES = (84.0, 56.0, 35.0, 21.0, 21.0)


class TemplateStart(nn.Module):
    """Poses of templates, moved as the matches between their patches and the crop's say.

    The matches give a similarity transform of the image plane (rotation, scale, shift). The object is turned about
    the camera's axis by the rotation, its distance follows from the scale, and it is moved onto the ray that its
    centre is shifted to; it is seen from the side from which the template shows it. So it is off by the difference
    of the two views, but it cannot be upside down: a start beside RANSAC's poses, which can.

    Source: weak perspective; see also :class:`foundpose.pnp.TopTemplatePose`, which aligns by the mask alone.
    """

    def forward(
        self,
        pixels_crop: Tensor,
        pixels_template: Tensor,
        weight: Tensor,
        K_crop: Tensor,
        T_template_from_model: Tensor,
        K_template: Tensor,
        centre: Tensor,
    ) -> Tensor:
        """Poses of h templates for each of B crops.

        Args:
            pixels_crop: (B, P, 2) patch centres.
            pixels_template: (B, h, P, 2) centres of the matched patches.
            weight: (B, h, P) how much each match counts, 0 for none.
            K_crop: (B, 3, 3), pixels.
            T_template_from_model: (B, h, 4, 4) poses of the object in the templates' cameras, mesh units.
            K_template: (B, h, 3, 3) their intrinsics, pixels.
            centre: (3,) a point in the middle of the object, mesh units.

        Returns:
            T_crop_from_model (B, h, 4, 4), mesh units.

        Differentiable w.r.t. all tensors.
        """
        target = pixels_crop.unsqueeze(1).expand_as(pixels_template)
        A = fit_similarity_robustly(pixels_template, target, weight, _SCALES)
        return weak_perspective_poses(A, K_crop, T_template_from_model, K_template, centre)


def weak_perspective_poses(
    A: Tensor, K_crop: Tensor, T_template_from_model: Tensor, K_template: Tensor, centre: Tensor
) -> Tensor:
    """Poses (B, h, 4, 4) of templates whose pictures are moved to the crop by similarity transforms (B, h, 2, 3).

    Differentiable w.r.t. all tensors.
    """
    T, K = T_template_from_model.to(K_crop), K_template.to(K_crop)
    K_crop = K_crop.unsqueeze(1).expand_as(K)
    R, t = T[..., :3, :3], T[..., :3, 3]
    centre = centre.to(K_crop)
    in_template = R @ centre + t
    image = K @ in_template.unsqueeze(-1)
    pixel = (image[..., :2, 0] / image[..., 2:, 0]).unsqueeze(-2)
    moved = apply_similarity(A, pixel)
    scale = torch.linalg.vector_norm(A[..., 0, :2], dim=-1)
    cosine, sine = A[..., 0, 0] / scale, A[..., 1, 0] / scale
    zero, one = torch.zeros_like(sine), torch.ones_like(sine)
    rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]]
    in_plane = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    from_ray = pixel_rays(pixel.flatten(0, 1), K.flatten(0, 1)).unflatten(0, scale.shape).squeeze(-2)
    to_ray = pixel_rays(moved.flatten(0, 1), K_crop.flatten(0, 1)).unflatten(0, scale.shape).squeeze(-2)
    # What the template's camera sees around its ray to the centre, the crop's sees around its own.
    turn = axis_rotation_to_ray(to_ray).transpose(-1, -2) @ in_plane @ axis_rotation_to_ray(from_ray)
    R = turn @ R
    focal, focal_crop = (M.diagonal(dim1=-2, dim2=-1)[..., :2].mean(dim=-1) for M in (K, K_crop))
    depth = in_template[..., 2] * focal_crop / (focal * scale)
    return make_transform(R, to_ray * depth.unsqueeze(-1) - R @ centre)
