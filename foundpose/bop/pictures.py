"""Where the pictures of a dataset come from."""

from torch import Tensor, nn

from foundpose.bop import BopDataset
from foundpose.rendering import Mesh, load_mesh
from foundpose.rendering.coordinates import CoordinateRenderer, render_coordinate_image


class Photographs(nn.Module):
    """The dataset's own pictures."""

    def forward(self, dataset: BopDataset, scene_id: int, im_id: int) -> Tensor:
        """Picture (3, H, W) in [0, 1]."""
        return dataset.image(scene_id, im_id)


class TrueCoordinates(nn.Module):
    """Pictures whose colours are model coordinates, rendered from the true poses with mutual occlusion.

    Goes with the extractor :class:`foundpose.features.CoordinateCode`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.renderer = CoordinateRenderer()
        self._meshes: dict[tuple[str, int], Mesh] = {}

    def forward(self, dataset: BopDataset, scene_id: int, im_id: int) -> Tensor:
        """Picture (3, H, W) of the size of the dataset's own.

        Raises:
            FileNotFoundError: the dataset has no ground truth.
        """
        annotations = dataset.annotations(scene_id, im_id)
        meshes = [self._mesh(dataset, annotation.obj_id) for annotation in annotations]
        size = dataset.image_size(scene_id, im_id)
        K = dataset.intrinsics(scene_id, im_id).float()
        T = [annotation.T_camera_from_model.float() for annotation in annotations]
        return render_coordinate_image(self.renderer, meshes, T, K, size)

    def _mesh(self, dataset: BopDataset, obj_id: int) -> Mesh:
        key = (str(dataset.models), obj_id)
        if key not in self._meshes:
            self._meshes[key] = load_mesh(dataset.mesh_path(obj_id))
        return self._meshes[key]
