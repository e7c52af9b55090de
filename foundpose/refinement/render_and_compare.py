"""Learned refinement: render the object at the current pose, compare with the picture, move, again."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from foundpose.geometry import camera_on_boxes, invert_transform, project_points, transform_points
from foundpose.geometry.warp import warp_images
from foundpose.refinement.base import Observation, PoseProposals, PoseRefiner
from foundpose.refinement.pose_update import UPDATE_SIZE, apply_update
from foundpose.rendering import Mesh, Renderer
from foundpose.utils.devices import constant

# Objects that come nearer than this share of their own depth are not rendered: they surround the camera.
_NEAR = 0.01


class PicturedObjects(NamedTuple):
    """M objects in pictures.

    Attributes:
        images: (N, 3, H, W) in [0, 1].
        K: (N, 3, 3) intrinsics.
        image_index: (M,) which picture shows each object.
        meshes: the objects' meshes.
        mesh_index: (M,) which mesh each object has.
    """

    images: Tensor
    K: Tensor
    image_index: Tensor
    meshes: Sequence[Mesh]
    mesh_index: Tensor

    def to(self, device: torch.device) -> "PicturedObjects":
        """The same on a device."""
        images, K, image_index, meshes, mesh_index = self
        return PicturedObjects(
            images.to(device), K.to(device), image_index.to(device), meshes, mesh_index.to(device)
        )


class Views(NamedTuple):
    """Pictures of M objects from virtual cameras that look at their centres.

    Attributes:
        crops: (M, 3, s, s) cut from the pictures.
        renderings: (M, 3, s, s) of the meshes at the poses.
        K: (M, 3, 3) intrinsics of the virtual cameras.
        T_view_from_camera: (M, 4, 4) their rotations.
        T_view_from_model: (M, 4, 4) the poses in them, mesh units.
        centre: (M, 3) centres of the meshes' bounding boxes, model frame.
        valid: (M,) bool; what belongs to a pose that cannot be rendered is finite but means nothing.
    """

    crops: Tensor
    renderings: Tensor
    K: Tensor
    T_view_from_camera: Tensor
    T_view_from_model: Tensor
    centre: Tensor
    valid: Tensor


class ComparedPoses(NamedTuple):
    """Refined poses.

    Attributes:
        T_camera_from_model: (M, 4, 4), mesh units; the given poses where not valid.
        logit: (M,) the network's last score before the sigmoid; None where it gives none.
        valid: (M,) bool.
    """

    T_camera_from_model: Tensor
    logit: Tensor | None
    valid: Tensor


class RenderAndCompareRefiner(PoseRefiner):
    """Moves poses until renderings look like the picture, as a network sees it.

    In each iteration a virtual camera is turned to the object's centre at the current pose, so that the object's
    image with a margin fills its square. The network sees what that camera sees of the picture, cut anew from the
    original picture each time, and a rendering of the mesh, and predicts how the object should move
    (:func:`foundpose.refinement.pose_update.apply_update`).

    Poses that cannot be rendered come back as they came and are not valid: those that are not finite or no
    rotations, objects that reach the camera or lie outside the picture, and poses that the network moves there.

    Args:
        network: any module from pictures (M, 6, s, s), RGB of crop and rendering in [0, 1], to updates (M, 9), or
            (M, 10) with a score's logit; see :class:`foundpose.refinement.UpdateNetwork`.
        renderer: draws the meshes. A trained network wants the renderer that it was trained with.
        iterations: number of updates.
        size: side s of the pictures in pixels.
        margin: side of the pictures as a multiple of the object's extent (of twice the farthest that it reaches from
            its centre).
        antialias: filter the picture where a crop shrinks it.
        keep_graph: do not detach poses before an iteration: the gradient is that of all updates, through the cameras
            but not through the renderings, and reaches the initial poses.

    Raises:
        ValueError: a setting out of range.

    Source: Li et al., "DeepIM", ECCV 2018; Labbé et al., "CosyPose", ECCV 2020, and "MegaPose", CoRL 2022.
    """

    def __init__(
        self,
        network: nn.Module,
        renderer: Renderer,
        iterations: int = 5,
        size: int = 64,
        margin: float = 1.4,
        antialias: bool = True,
        keep_graph: bool = False,
    ) -> None:
        super().__init__()
        if iterations < 1 or size < 2 or not margin >= 1.0:
            raise ValueError(
                f"iterations, size and margin must be at least 1, 2 and 1, got {iterations}, {size} and {margin}"
            )
        self.network = network
        self.renderer = renderer
        self.iterations = iterations
        self.size = size
        self.margin = margin
        self.antialias = antialias
        self.keep_graph = keep_graph

    def forward(self, proposals: PoseProposals, observation: Observation) -> PoseProposals:
        """Refine all valid proposals as one batch.

        Returns:
            Poses, scores (the network's, or those that came if it gives none) and which are valid.

        Raises:
            ValueError: there are no meshes, or the network's output has another shape.

        Differentiable as :meth:`refine`; proposals that cannot be refined are passed through.
        """
        meshes, groups = observation.meshes, observation.groups
        if meshes is None:
            raise ValueError(
                "RenderAndCompareRefiner renders the objects: pass their meshes to FoundPose.forward (meshes=...)"
            )
        if len(meshes) != len(groups.objects):
            raise ValueError(f"got {len(meshes)} meshes for {len(groups.objects)} objects; give one for each")
        rows = torch.nonzero(proposals.valid)
        crop, (B, n) = rows[:, 0], proposals.valid.shape
        flat = crop * n + rows[:, 1]
        T_crop = proposals.T_crop_from_model.flatten(0, 1)
        T_crop_from_camera = observation.crops.T_crop_from_camera.to(T_crop)[crop]
        pictured = PicturedObjects(
            observation.images,
            observation.K,
            observation.image_index.to(crop.device)[crop],
            meshes,
            groups.object_index.to(crop.device)[crop],
        )
        result = self.refine(invert_transform(T_crop_from_camera) @ T_crop[flat], pictured)
        refined = torch.where(
            result.valid[:, None, None], T_crop_from_camera @ result.T_camera_from_model, T_crop[flat]
        )
        score = proposals.score
        if result.logit is not None:
            ours = result.logit.sigmoid().to(score).where(result.valid, 0.0)
            score = torch.zeros_like(score).index_put(tuple(rows.T), ours)
        return proposals._replace(
            T_crop_from_model=T_crop.index_put((flat,), refined).unflatten(0, (B, n)),
            score=score,
            valid=torch.zeros_like(proposals.valid).index_put(tuple(rows.T), result.valid),
        )

    def refine(self, T_camera_from_model: Tensor, pictured: PicturedObjects) -> ComparedPoses:
        """Refine M poses (M, 4, 4), mesh units, of objects in pictures.

        Differentiable w.r.t. the network's parameters and the pictures. Renderings are constants, and poses are
        detached before each iteration, as in CosyPose: the gradient is that of the last update (see ``keep_graph``).
        """
        T, valid = T_camera_from_model, torch.ones_like(pictured.mesh_index, dtype=torch.bool)
        logit: Tensor | None = None
        for _ in range(self.iterations):
            views = self.look(T if self.keep_graph else T.detach(), pictured)
            update, logit = self.predict(views)
            valid = valid & views.valid
            T = self.move(views, update)
        valid = valid & self._usable(T.detach(), pictured)[0]
        return ComparedPoses(torch.where(valid[:, None, None], T, T_camera_from_model), logit, valid)

    def look(self, T_camera_from_model: Tensor, pictured: PicturedObjects) -> Views:
        """What the network sees of objects at poses (M, 4, 4).

        Differentiable w.r.t. the pictures and, but for the renderings, the poses.
        """
        images = pictured.images.to(torch.promote_types(pictured.images.dtype, torch.float32))
        valid, boxes, T, K_camera, centre = self._usable(T_camera_from_model, pictured)
        K_view, T_view_from_camera = camera_on_boxes(boxes, K_camera, self.size, 1.0 / self.margin)
        T_view = T_view_from_camera @ T
        homographies = K_view @ T_view_from_camera[:, :3, :3] @ torch.linalg.inv(K_camera)
        shrink = K_camera[:, [0, 1], [0, 1]].amax(1) / K_view[:, 0, 0]
        levels = shrink.clamp(min=1.0).log2() if self.antialias else torch.zeros_like(shrink)
        crops = warp_images(
            images, homographies.to(images), pictured.image_index, levels.to(images), self.size
        )
        renderings = torch.zeros_like(crops, requires_grad=False)
        for i, mesh in enumerate(pictured.meshes):
            rows = torch.nonzero((pictured.mesh_index == i) & valid).flatten()
            if len(rows) > 0:
                rendered = self.renderer(mesh, T_view[rows], K_view[rows], (self.size, self.size)).rgb
                renderings[rows] = rendered.to(renderings)
        return Views(crops, renderings, K_view, T_view_from_camera, T_view, centre, valid)

    def predict(self, views: Views) -> tuple[Tensor, Tensor | None]:
        """Updates (M, 9) and logits (M,) of the network, the logits None if it gives none.

        Raises:
            ValueError: the network's output has another shape.

        Differentiable w.r.t. the network's parameters and the crops.
        """
        pictures = torch.cat([views.crops, views.renderings], dim=1)
        weight = next((p for p in self.network.parameters() if p.is_floating_point()), pictures)
        output = self.network(pictures.to(weight.dtype))
        if output.dim() != 2 or output.shape[0] != len(pictures) or output.shape[1] not in (9, 10):
            raise ValueError(
                f"the network must return (M, 9) or (M, 10) for M = {len(pictures)} pictures, "
                f"got {tuple(output.shape)}"
            )
        output = output.to(views.T_view_from_model.dtype)
        return output[:, :UPDATE_SIZE], output[:, UPDATE_SIZE] if output.shape[1] > UPDATE_SIZE else None

    def move(self, views: Views, update: Tensor) -> Tensor:
        """Poses ``T_camera_from_model`` (M, 4, 4) after updates (M, 9); differentiable w.r.t. the updates."""
        T_view = apply_update(views.T_view_from_model, update, views.K, views.centre)
        return invert_transform(views.T_view_from_camera) @ T_view

    def _usable(self, T: Tensor, pictured: PicturedObjects) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Which poses can be rendered; boxes (M, 4) round their images, poses, intrinsics and meshes' centres.

        What cannot be used is replaced by something that can be computed with.
        """
        height, width = pictured.images.shape[-2:]
        bounds = torch.stack([mesh.bounds for mesh in pictured.meshes]).to(T)
        low, high = bounds[pictured.mesh_index].unbind(1)
        centre, radius = (low + high) / 2, torch.linalg.vector_norm(high - low, dim=-1) / 2
        K = pictured.K.detach().to(T)[pictured.image_index]
        focal = float(max(height, width))
        common = K.new_tensor(
            [[focal, 0.0, (width - 1) / 2], [0.0, focal, (height - 1) / 2], [0.0, 0.0, 1.0]]
        )
        valid = torch.isfinite(K).flatten(1).all(1) & (K[:, [0, 1], [0, 1]] > 0).all(1)
        K = torch.where(valid[:, None, None], K, common)
        ahead = torch.eye(4).to(T).repeat(len(T), 1, 1)
        ahead[:, :3, 3] = -centre
        ahead[:, 2, 3] += 4.0 * radius
        # A rotation that is none, of columns without a direction for example, has another determinant.
        sound = torch.isfinite(T).flatten(1).all(1)
        T = torch.where(sound[:, None, None], T, ahead)
        valid &= sound & ((torch.linalg.det(T[:, :3, :3]) - 1.0).abs() < 0.1)
        boxes = torch.zeros_like(T[:, 0])
        for i, mesh in enumerate(pictured.meshes):
            rows = torch.nonzero(pictured.mesh_index == i).flatten()
            if len(rows) > 0:
                boxes[rows], in_front = self._boxes(mesh, T[rows], K[rows], centre[rows])
                valid[rows] &= in_front
        left, top, right, bottom = boxes.unbind(-1)
        valid = valid & torch.isfinite(boxes).all(-1) & (right > left) & (bottom > top)
        valid &= (right > -0.5) & (left < width - 0.5) & (bottom > -0.5) & (top < height - 0.5)
        whole = constant([-0.5, -0.5, width - 0.5, height - 0.5], boxes)
        return (
            valid,
            torch.where(valid[:, None], boxes, whole),
            torch.where(valid[:, None, None], T, ahead),
            K,
            centre,
        )

    @staticmethod
    def _boxes(mesh: Mesh, T: Tensor, K: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        """Boxes round the projected centre that hold the whole projection; False where a part is not in front."""
        points = transform_points(T, mesh.hull_vertices.to(T))
        pixels, depth = project_points(points, K)
        middle, middle_depth = project_points(transform_points(T, centre[:, None]), K)
        reach = (pixels - middle).abs().amax(1)
        in_front = (middle_depth[:, 0] > 0) & (depth.amin(1) > _NEAR * middle_depth[:, 0])
        return torch.cat([middle[:, 0] - reach, middle[:, 0] + reach], dim=-1), in_front
