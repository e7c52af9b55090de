"""A folder of intermediate results that many jobs share, each named by what it depends on."""

import json
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from glob import escape
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch
from filelock import FileLock, Timeout
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from foundpose.utils.files import write_atomically
from foundpose.utils.settings import digest

ARTEFACT_VERSION = 2

_T = TypeVar("_T")


class ArtefactEntry(NamedTuple):
    """One file of an :class:`ArtefactStore`.

    Attributes:
        kind: what it holds.
        key: sha256 of what it depends on.
        path: the file.
        bytes: its size.
    """

    kind: str
    key: str
    path: Path
    bytes: int


def load_or_make(path: Path, load: Callable[[Path], _T | None], make: Callable[[Path], None]) -> _T:
    """Load a file, or make it first; of several processes that ask for one file at once, a single one makes it.

    The others wait. The lock is the operating system's, so that of a process that died is free. On a network file
    system it must work across machines (NFS 4, Lustre with ``flock``, …), else some work is done twice; as files
    are written whole or not at all, they stay sound even then.

    Args:
        path: the file.
        load: reads it; returns None where it is missing or broken.
        make: writes it by :func:`foundpose.utils.files.write_atomically`.

    Raises:
        OSError: what ``make`` wrote cannot be read.
    """
    found = load(path)
    if found is not None:
        return found
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(_lock_path(path)):
        found = load(path)
        if found is None:
            _remove_leftovers(path)
            make(path)
            found = load(path)
    if found is None:
        raise OSError(f"{path} cannot be read although it was written a moment ago; is the disk all right?")
    return found


class ArtefactStore:
    """Keeps named tensors in files, found again by exactly the facts that they depend on.

    A file is ``<folder>/<kind>/<key>.safetensors``; its header holds the facts and a checksum. Files are written
    whole or not at all, a broken one counts as missing, and of jobs that want the same one a single one makes it.
    Nothing is ever out of date: other facts have another key. What is no longer wanted can be deleted at any time, by
    :meth:`clear` or by hand.

    Args:
        folder: where the files lie; made when needed.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    @staticmethod
    def key(kind: str, facts: Mapping[str, Any]) -> str:
        """sha256 of a kind and of facts that JSON can hold; the order of the facts does not matter."""
        return digest([ARTEFACT_VERSION, kind, facts])

    def path(self, kind: str, facts: Mapping[str, Any]) -> Path:
        """File of an artefact, whether it exists or not."""
        return self.folder / kind / f"{self.key(kind, facts)}.safetensors"

    def get(
        self, kind: str, facts: Mapping[str, Any], make: Callable[[], Mapping[str, Tensor]]
    ) -> dict[str, Tensor]:
        """Load an artefact, or make and save it.

        Args:
            kind: what it holds; names a folder.
            facts: everything that it depends on.
            make: computes its tensors; called at most once, with the artefact's lock held.

        Returns:
            The tensors, on the CPU, as they lie in the file: memory is taken only for what is read.
        """
        metadata = {"facts": json.dumps(facts, sort_keys=True)}

        def write(path: Path) -> None:
            tensors = {name: t.detach().cpu().contiguous() for name, t in make().items()}
            checksum = {"crc32": json.dumps(_checksum(tensors))}
            write_atomically(path, lambda file: save_file(tensors, str(file), metadata=metadata | checksum))

        return load_or_make(self.path(kind, facts), _read, write)

    def entries(self) -> list[ArtefactEntry]:
        """All files, ordered by kind and key."""
        found = []
        for path in sorted(self.folder.glob("*/[!.]*.safetensors")):
            try:
                found.append(ArtefactEntry(path.parent.name, path.stem, path, path.stat().st_size))
            except FileNotFoundError:
                continue  # another job cleared it
        return found

    def size(self) -> dict[str, int]:
        """Bytes on disk of each kind, and their ``total``."""
        sizes: Counter[str] = Counter()
        for entry in self.entries():
            sizes[entry.kind] += entry.bytes
        return dict(sizes) | {"total": sizes.total()}

    def clear(self, kinds: Iterable[str] | None = None) -> int:
        """Delete artefacts and what killed jobs left; jobs that are running make again what they miss.

        Args:
            kinds: which kinds; None for all.

        Returns:
            Bytes freed by the artefacts.

        Raises:
            ValueError: ``kinds`` is a single string.
        """
        if isinstance(kinds, str):
            raise ValueError(f"kinds must be a list, as in clear([{kinds!r}]); got {kinds!r}")
        wanted = None if kinds is None else set(kinds)
        freed = 0
        for entry in self.entries():
            if wanted is None or entry.kind in wanted:
                entry.path.unlink(missing_ok=True)
                freed += entry.bytes
        for lock in self.folder.glob("*/.*.lock"):
            if wanted is None or lock.parent.name in wanted:
                _remove_if_idle(lock.with_name(lock.stem.removeprefix(".") + ".safetensors"))
        return freed


def _read(path: Path) -> dict[str, Tensor] | None:
    """Tensors of a file; None where it is missing or broken."""
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (FileNotFoundError, SafetensorError):
        return None
    return tensors if metadata.get("crc32") == json.dumps(_checksum(tensors)) else None


def _checksum(tensors: Mapping[str, Tensor]) -> int:
    """CRC-32 of the tensors' bytes; reads one gigabyte in about a second."""
    value = 0
    for name in sorted(tensors):
        value = zlib.crc32(tensors[name].reshape(-1).view(torch.uint8).numpy().data, value)
    return value


def _lock_path(path: Path) -> Path:
    return path.with_name(f".{path.stem}.lock")


def _remove_leftovers(path: Path) -> None:
    """Delete temporary files that killed writers of ``path`` left; the caller holds the lock."""
    for leftover in path.parent.glob(f".{escape(path.stem)}-*{path.suffix}"):
        leftover.unlink(missing_ok=True)


def _remove_if_idle(path: Path) -> None:
    """Delete what killed writers of ``path`` left, unless it is being written."""
    try:
        with FileLock(_lock_path(path), timeout=0):
            _remove_leftovers(path)
    except Timeout:
        pass
