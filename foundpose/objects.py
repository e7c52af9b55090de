"""Objects of a dataset: meshes and representations, loaded when they are needed."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch

from foundpose.bop import BopDataset
from foundpose.onboarding import ObjectRepresentation, RepresentationStore
from foundpose.onboarding.onboarder import Progress
from foundpose.rendering import Mesh, load_mesh

MIB = 2**20


class DatasetObjects:
    """Meshes and representations of a dataset's objects.

    Representations are loaded when first asked for; beyond the limit the least recently used are dropped.

    Args:
        dataset: the dataset.
        store: keeps representations on disk and makes missing ones.
        memory_limit: MiB that loaded representations may take together; None for no limit. Sizes are those of the
            files, which hold little but the tensors. Meshes come on top and stay.
    """

    def __init__(
        self, dataset: BopDataset, store: RepresentationStore, memory_limit: float | None = None
    ) -> None:
        if memory_limit is not None and not memory_limit > 0:
            raise ValueError(f"memory_limit must be positive (MiB), or None for no limit; got {memory_limit}")
        self.dataset = dataset
        self.store = store
        self.memory_limit = memory_limit
        self._meshes: dict[int, Mesh] = {}
        self._paths: dict[int, Path] = {}
        self._loaded: OrderedDict[int, ObjectRepresentation] = OrderedDict()

    def mesh(self, obj_id: int) -> Mesh:
        """Mesh of an object.

        Raises:
            ValueError: its size and the dataset's entry for it disagree by more than a factor of two.
        """
        if obj_id not in self._meshes:
            path = self.dataset.mesh_path(obj_id)
            mesh = load_mesh(path)
            if not 0.5 < mesh.diameter / self.dataset.diameter(obj_id) < 2.0:
                raise ValueError(
                    f"{path} has a diameter of {mesh.diameter:.4g}, models_info.json says "
                    f"{self.dataset.diameter(obj_id):.4g}: are they in the same unit?"
                )
            self._meshes[obj_id] = mesh
        return self._meshes[obj_id]

    def name(self, obj_id: int) -> str:
        """Name of an object's representation."""
        return f"{self.dataset.name}-{obj_id:06d}"

    def onboard(self, ids: Iterable[int], progress: Callable[[str], Progress] | None = None) -> None:
        """Make the representations that are not in the store yet.

        Args:
            ids: objects.
            progress: makes a progress callback from an object's name.
        """
        for obj_id in ids:
            mesh, name = self.mesh(obj_id), self.name(obj_id)
            if not self.store.has(mesh, name):
                self.store.get(mesh, name, None if progress is None else progress(name))

    def size(self, obj_id: int) -> float:
        """MiB of an onboarded object's representation."""
        if obj_id not in self._paths:
            self._paths[obj_id] = self.store.path(self.mesh(obj_id), self.name(obj_id))
        return self._paths[obj_id].stat().st_size / MIB

    def representations(
        self, ids: Sequence[int], device: torch.device | str = "cpu"
    ) -> list[ObjectRepresentation]:
        """Representations of objects, loaded on a device.

        Args:
            ids: the objects, each once; they are held together.
            device: where the buffers go; representations on another device are moved.

        Raises:
            ValueError: these objects alone exceed the memory limit.
        """
        self.check_limit([ids])
        missing = [obj_id for obj_id in ids if obj_id not in self._loaded]
        for obj_id in ids:
            if obj_id in self._loaded:
                self._loaded.move_to_end(obj_id)
        if self.memory_limit is not None:
            needed = sum(self.size(obj_id) for obj_id in missing)
            while self._loaded and needed + self.loaded_size() > self.memory_limit:
                self._loaded.popitem(last=False)
        for obj_id in missing:
            self._loaded[obj_id] = self.store.get(self.mesh(obj_id), self.name(obj_id))
        return [self._loaded[obj_id].to(device) for obj_id in ids]

    def loaded_size(self) -> float:
        """MiB of all loaded representations."""
        return sum(self.size(obj_id) for obj_id in self._loaded)

    @property
    def loaded(self) -> list[int]:
        """Ids of the loaded representations, the one used last at the end."""
        return list(self._loaded)

    def check_limit(self, groups: Iterable[Sequence[int]]) -> None:
        """Check that each group of objects can be held together.

        Raises:
            ValueError: a group exceeds the memory limit.
        """
        if self.memory_limit is None:
            return
        for ids in groups:
            needed = sum(self.size(obj_id) for obj_id in ids)
            if needed > self.memory_limit:
                raise ValueError(
                    f"the objects {list(ids)} of one batch take {needed:.0f} MiB, memory_limit is "
                    f"{self.memory_limit:g} MiB: raise it, lower batch_size or use order=object"
                )
