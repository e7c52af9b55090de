"""Reading the files of a BOP dataset, with errors that say what is wrong."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from foundpose.utils.files import describe_folder


class BopError(ValueError):
    """A BOP dataset or file is not as the format demands."""


def read_json(path: Path, object_hook: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        object_hook: as of :func:`json.loads`: gets every object and returns what takes its place.

    Raises:
        FileNotFoundError: no such file; the message lists what its folder holds.
        BopError: not JSON; the message gives line and column.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; {describe_folder(path.parent)}")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"), object_hook=object_hook)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BopError(f"{path} is not valid JSON: {error}") from error


def parse_models_info(content: Any, path: Path) -> dict[int, dict[str, Any]]:
    """Entries of a ``models_info.json`` by object id.

    Raises:
        BopError: the content is something else.
    """
    if not isinstance(content, dict) or not all(
        key.isdecimal() and isinstance(value, dict) for key, value in content.items()
    ):
        raise BopError(f"{path} must map object ids to entries")
    return {int(key): value for key, value in content.items()}


class JsonCache:
    """Contents of the JSON files read last; a file that has changed is read again.

    Args:
        max_bytes: size on disk of the files kept. The file read last is kept whatever its size.
    """

    def __init__(self, max_bytes: int = 32 * 2**20) -> None:
        self.max_bytes = max_bytes
        self._entries: dict[Path, tuple[tuple[int, int, int], Any]] = {}

    def read(self, path: Path) -> Any:
        """Content of a file, not to be changed by the caller. Raises as :func:`read_json`."""
        if not path.is_file():
            self._entries.pop(path, None)
            return read_json(path)
        stat = path.stat()
        state = (stat.st_mtime_ns, stat.st_size, stat.st_ino)
        # Taken out and put back at the end, so that the order is that of use.
        entry = self._entries.pop(path, None)
        if entry is None or entry[0] != state:
            entry = (state, read_json(path))
        self._entries[path] = entry
        while len(self._entries) > 1 and sum(kept[1] for kept, _ in self._entries.values()) > self.max_bytes:
            self._entries.pop(next(iter(self._entries)))
        return entry[1]

    def __getstate__(self) -> dict[str, Any]:
        # Workers of a data loader read for themselves.
        return {"max_bytes": self.max_bytes, "_entries": {}}
