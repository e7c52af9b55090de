"""Objects of a dataset: meshes and representations, loaded when they are needed."""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch

from foundpose.bop import BopDataset
from foundpose.onboarding import RepresentationStore
from foundpose.onboarding.onboarder import Progress
from foundpose.rendering import Mesh, load_mesh
from foundpose.representation import ObjectRepresentation
from foundpose.utils.files import write_json
from foundpose.utils.units import check_unit

MIB = 2**20


class DatasetObjects:
    """Meshes and representations of a dataset's objects.

    Both are loaded when first asked for; beyond their limits the least recently used are dropped. On the CPU,
    representations are files mapped into memory: only the pages in use take any.

    Args:
        dataset: the dataset.
        store: keeps representations on disk and makes missing ones.
        memory_limit: MiB that loaded representations may take together; None for no limit. Sizes are those of the
            files, which hold little but the tensors: what is resident once every page has been used.
        mesh_limit: MiB of meshes that are kept, the one used last in any case; None for no limit.
        color: [red, green, blue] in [0, 1] of surfaces for which a mesh gives no colour; None: light grey.
    """

    def __init__(
        self,
        dataset: BopDataset,
        store: RepresentationStore,
        memory_limit: float | None = None,
        mesh_limit: float | None = 1024.0,
        color: Sequence[float] | None = None,
    ) -> None:
        for name, limit in (("memory_limit", memory_limit), ("mesh_limit", mesh_limit)):
            if limit is not None and not limit > 0:
                raise ValueError(f"{name} must be positive (MiB), or None for no limit; got {limit}")
        self.dataset = dataset
        self.store = store
        self.memory_limit = memory_limit
        self.mesh_limit = mesh_limit
        self.color = color
        self._meshes: OrderedDict[int, Mesh] = OrderedDict()
        self._checksums = MeshChecksums(store.folder, dataset, color)
        self._sizes: dict[int, float] = {}
        self._loaded: OrderedDict[int, ObjectRepresentation] = OrderedDict()

    def mesh(self, obj_id: int) -> Mesh:
        """Mesh of an object.

        Raises:
            UnitError: its size and the dataset's entry for it disagree by more than a factor of two.
        """
        if obj_id not in self._meshes:
            path = self.dataset.mesh_path(obj_id)
            mesh = load_mesh(path, self.color)
            published = self.dataset.diameter(obj_id)
            check_unit(mesh.diameter, f"the diameter of {path}", published, "that in models_info.json", 2.0)
            self._meshes[obj_id] = mesh
        self._meshes.move_to_end(obj_id)
        if self.mesh_limit is not None:
            taken = sum(map(_mesh_size, self._meshes.values()))
            while taken > self.mesh_limit and len(self._meshes) > 1:
                _, dropped = self._meshes.popitem(last=False)
                taken -= _mesh_size(dropped)
        return self._meshes[obj_id]

    def path(self, obj_id: int) -> Path:
        """File of an object's representation, whether it exists or not."""
        return self.store.path_of(self._checksum(obj_id), self.dataset.object_name(obj_id))

    def onboard(self, ids: Iterable[int], progress: Callable[[str], Progress] | None = None) -> None:
        """Make the representations that are not in the store yet.

        Args:
            ids: objects.
            progress: makes a progress callback from an object's name.
        """
        for obj_id in ids:
            if not self.path(obj_id).is_file():
                name = self.dataset.object_name(obj_id)
                self.store.get(self.mesh(obj_id), name, None if progress is None else progress(name))
        self._checksums.write()

    def size(self, obj_id: int) -> float:
        """MiB of an onboarded object's representation."""
        if obj_id not in self._sizes:
            self._sizes[obj_id] = self.path(obj_id).stat().st_size / MIB
        return self._sizes[obj_id]

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
            found = self.store.find(self._checksum(obj_id), self.dataset.object_name(obj_id))
            if found is None:
                found = self.store.get(self.mesh(obj_id), self.dataset.object_name(obj_id))
            self._loaded[obj_id] = found
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

    def _checksum(self, obj_id: int) -> str:
        known = self._checksums.get(obj_id)
        if known is None:
            known = self.mesh(obj_id).checksum
            self._checksums.add(obj_id, known)
        return known


class MeshChecksums:
    """Remembers the checksums of a dataset's meshes, so that representations are found without loading the meshes.

    They lie in a file beside the representations, named after the names, sizes and times of all files in the
    folder of the meshes (textures among them): if any of these changes, checksums are computed again.

    Args:
        folder: of the file.
        dataset: whose meshes.
        color: with which they are loaded.
    """

    def __init__(self, folder: Path, dataset: BopDataset, color: Sequence[float] | None = None) -> None:
        self.folder = folder
        self.dataset = dataset
        self.color = color
        self._path: Path | None = None
        self._known: dict[str, str] = {}
        self._new = False

    def get(self, obj_id: int) -> str | None:
        """Checksum of an object's mesh; None where it is not known."""
        if self._path is None:
            color = "" if self.color is None else "-".join(["", *(f"{value:g}" for value in self.color)])
            name = f".{self.dataset.name}-meshes-{_state_of(self.dataset.models)}{color}.json"
            self._path = self.folder / name
            if self._path.is_file():
                self._known = json.loads(self._path.read_text())
        return self._known.get(str(obj_id))

    def add(self, obj_id: int, checksum: str) -> None:
        """Remember a checksum."""
        self._known[str(obj_id)] = checksum
        self._new = True

    def write(self) -> None:
        """Write what is new, for the next time and for other processes."""
        if self._new and self._path is not None:
            write_json(self._path, self._known)
            self._new = False


def _state_of(folder: Path) -> str:
    """Hash of the names, sizes and times of the files in a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        stat = path.stat()
        digest.update(f"{path.relative_to(folder)}|{stat.st_size}|{stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:12]


def _mesh_size(mesh: Mesh) -> float:
    """MiB of a mesh's tensors."""
    parts = (mesh.vertices, mesh.faces, mesh.vertex_normals, mesh.vertex_colors, mesh.uv, mesh.texture)
    return sum(part.nbytes for part in parts if part is not None) / MIB
