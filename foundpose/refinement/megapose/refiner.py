"""MegaPose's refiner and its scoring of poses, in the loop of the render-and-compare refiner."""

import torch
from torch import Tensor

from foundpose.geometry import make_transform, shift_intrinsics
from foundpose.refinement.megapose.geometry import (
    crop_boxes,
    crop_intrinsics,
    front_views,
    normal_colors,
    sample_boxes,
)
from foundpose.refinement.megapose.network import MegaPoseNetwork
from foundpose.refinement.pose_update import rotation_from_6d, rotation_to_6d
from foundpose.refinement.render_and_compare import (
    ComparedPoses,
    PicturedObjects,
    RenderAndCompareRefiner,
    Views,
)
from foundpose.rendering import Renderer

_NEAR_METRES = 0.1
_POINTS, _POINTS_OF_VIEWS = 2000, 200  # of a mesh, whose projection the crops hold
_BATCH = 16  # poses that are refined at a time, so that memory does not grow with their number
# The release renders with intrinsics that count from the corner of a picture; everything else counts from the centre
# of the first pixel, as we do. Its networks have learnt with that, so the renderings here are off alike.
_RENDERED_OFF = 0.5  # pixels


class MegaPoseRefiner(RenderAndCompareRefiner):
    """MegaPose's refiner: its network sees the crop and four renderings, with normals, and moves the pose.

    Nothing of MegaPose has to be installed. Poses that cannot be rendered come back as they came and are not valid.
    The scores are those that came: :class:`MegaPoseScorer` gives others.

    Args:
        network: predicts updates; its weights are the published run ``refiner-rgb-653307694``.
        renderer: draws the meshes. The published network wants ambient light alone: ``RaycastRenderer(ambient=1.0)``.
        iterations: number of updates.
        metres: length of a mesh unit in metres; BOP's meshes are in millimetres.
        resolution: (height, width) of the pictures in pixels.
        keep_graph: do not detach poses between iterations.

    Raises:
        ValueError: a setting out of range, or a network for another number of views than 1 or 4.

    Source: Labbé et al., "MegaPose", CoRL 2022.
    """

    network: MegaPoseNetwork

    def __init__(
        self,
        network: MegaPoseNetwork,
        renderer: Renderer,
        iterations: int = 5,
        metres: float = 0.001,
        resolution: tuple[int, int] = (240, 320),
        keep_graph: bool = False,
    ) -> None:
        super().__init__(network, renderer, iterations, keep_graph=keep_graph)
        if not metres > 0 or min(resolution) < 32 or network.views not in (1, 4):
            raise ValueError(
                "metres must be positive, resolution at least 32 pixels and the network's views 1 or 4, "
                f"got {metres}, {tuple(resolution)} and {network.views}"
            )
        self.metres = metres
        self.resolution = (int(resolution[0]), int(resolution[1]))

    def refine(self, T_camera_from_model: Tensor, pictured: PicturedObjects) -> ComparedPoses:
        """Refine M poses (M, 4, 4); see :meth:`RenderAndCompareRefiner.refine`."""
        parts = [
            self._refine_some(
                T_camera_from_model[rows],
                pictured._replace(
                    image_index=pictured.image_index[rows], mesh_index=pictured.mesh_index[rows]
                ),
            )
            for rows in torch.arange(len(T_camera_from_model)).split(_BATCH)
        ]
        logits = [part.logit for part in parts if part.logit is not None]
        return ComparedPoses(
            torch.cat([part.T_camera_from_model for part in parts]),
            torch.cat(logits) if logits else None,
            torch.cat([part.valid for part in parts]),
        )

    def _refine_some(self, T_camera_from_model: Tensor, pictured: PicturedObjects) -> ComparedPoses:
        return super().refine(T_camera_from_model, pictured)

    def look(self, T_camera_from_model: Tensor, pictured: PicturedObjects) -> Views:
        """What the network sees of objects at poses (M, 4, 4).

        The renderings (M, 6 · views, height, width) are RGB and normals as colours of each view. The poses returned
        have their rotations made orthonormal; the centre about which they turn is the model's origin.

        Differentiable w.r.t. the pictures and, but for the renderings, the poses.
        """
        valid, _, T, K_camera, _ = self._usable(T_camera_from_model, pictured)
        T = make_transform(rotation_from_6d(rotation_to_6d(T[:, :3, :3])), T[:, :3, 3])
        T_views = T.unsqueeze(1) if self.network.views == 1 else front_views(T)
        shape, near = T_views.shape[:2], _NEAR_METRES / self.metres
        boxes = T.new_zeros(*shape, 4)
        for i, mesh in enumerate(pictured.meshes):
            rows = torch.nonzero(pictured.mesh_index == i).flatten()
            points, camera = _spread(mesh.vertices).to(T), K_camera[rows].unsqueeze(1)
            for views, of_view in ((slice(1), points), (slice(1, None), points[:_POINTS_OF_VIEWS])):
                boxes[rows, views] = crop_boxes(of_view, T_views[rows, views], camera, self.resolution, near)
        K_views = crop_intrinsics(K_camera.unsqueeze(1), boxes, self.resolution)
        images = pictured.images.to(torch.promote_types(pictured.images.dtype, torch.float32))
        crops = sample_boxes(images, boxes[:, 0], pictured.image_index, self.resolution)
        renderings = torch.zeros(*shape, 6, *self.resolution, dtype=crops.dtype, device=crops.device)
        K_rendered = shift_intrinsics(K_views, K_views.new_tensor([_RENDERED_OFF, _RENDERED_OFF]))
        for i, mesh in enumerate(pictured.meshes):
            rows = torch.nonzero((pictured.mesh_index == i) & valid).flatten()
            if len(rows) > 0:
                cameras = T_views[rows].flatten(0, 1), K_rendered[rows].flatten(0, 1)
                out = self.renderer(mesh, *cameras, self.resolution)
                seen = torch.cat([out.rgb, normal_colors(out.normals, out.mask)], dim=1)
                renderings[rows] = seen.unflatten(0, (len(rows), shape[1])).to(renderings)
        still = torch.eye(4).to(T).expand_as(T)
        return Views(
            crops, renderings.flatten(1, 2), K_views[:, 0], still, T, torch.zeros_like(T[:, :3, 3]), valid
        )


class MegaPoseScorer(MegaPoseRefiner):
    """Scores poses by MegaPose's coarse network and leaves them where they are; put it behind a refiner.

    Args:
        network: gives logits; its weights are the published run ``coarse-rgb-906902141``.
        renderer: as for :class:`MegaPoseRefiner`.
        metres: length of a mesh unit in metres.
        resolution: (height, width) of the pictures in pixels.

    Raises:
        ValueError: a setting out of range, or a network that gives no score.

    Source: Labbé et al., "MegaPose", CoRL 2022.
    """

    def __init__(
        self,
        network: MegaPoseNetwork,
        renderer: Renderer,
        metres: float = 0.001,
        resolution: tuple[int, int] = (240, 320),
    ) -> None:
        super().__init__(network, renderer, 1, metres, resolution)
        if network.head != "score":
            raise ValueError("MegaPoseScorer needs a network with head=score")

    def _refine_some(self, T_camera_from_model: Tensor, pictured: PicturedObjects) -> ComparedPoses:
        views = self.look(T_camera_from_model, pictured)
        logit = self.network(torch.cat([views.crops, views.renderings], dim=1)).squeeze(1)
        return ComparedPoses(T_camera_from_model, logit.to(T_camera_from_model), views.valid)


def _spread(vertices: Tensor) -> Tensor:
    """Some of the vertices, drawn at random but always the same ones."""
    order = torch.randperm(len(vertices), generator=torch.Generator().manual_seed(0))
    return vertices[order[:_POINTS]]
