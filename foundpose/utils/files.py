"""Files: atomic writing, and weights with a header that says what they are."""

import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn


def describe_folder(folder: Path, most: int = 12) -> str:
    """Say in words what a folder holds."""
    if not folder.is_dir():
        return f"the folder {folder} does not exist"
    names = sorted(entry.name + ("/" if entry.is_dir() else "") for entry in folder.iterdir())
    if not names:
        return f"the folder {folder} is empty"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{folder} holds {', '.join(names[:most])}{more}"


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file in the folder of ``path``, then rename it to ``path``.

    A reader sees the old file or the whole new one; after an interruption at most a hidden temporary file is left.

    Args:
        path: the file to make; missing folders are made.
        write: called with the path of the temporary file, which has the suffix of ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text, whole or not at all."""
    write_atomically(path, lambda temporary: temporary.write_text(text))


def write_json(path: Path, content: Any) -> None:
    """Write JSON, whole or not at all."""
    write_text(path, json.dumps(content, indent=1))


def save_weights(path: Path, module: nn.Module, header: str, facts: dict[str, Any]) -> None:
    """Write a module's state as one safetensors file, whole or not at all.

    Args:
        path: the file.
        module: whose state dict is written.
        header: name of the entry that tells what the file holds.
        facts: goes into that entry, as JSON.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in module.state_dict().items()}
    metadata = {header: json.dumps(facts, sort_keys=True)}
    write_atomically(path, lambda temporary: save_file(tensors, str(temporary), metadata=metadata))


def read_weights(
    path: Path, header: str, schema_version: int, what: str, hint: str
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read what :func:`save_weights` wrote.

    Args:
        path: the file.
        header: name of the entry that tells what the file holds.
        schema_version: the version that its facts must have.
        what: what is looked for, for messages.
        hint: how to make such a file, for messages.

    Returns:
        The facts but for the version, and the tensors on the CPU.

    Raises:
        FileNotFoundError: no such file.
        ValueError: another kind of file, or of another schema version.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no {what} at {path}; {hint}")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except SafetensorError as error:
        raise ValueError(f"{path} is not a readable safetensors file ({error}); {hint}") from error
    if header not in metadata:
        raise ValueError(f"{path} holds no {what} (no {header!r} entry in its header); {hint}")
    facts = json.loads(metadata[header])
    version = facts.pop("schema_version", None)
    if version != schema_version:
        raise ValueError(f"{path} has schema version {version}, this library reads {schema_version}; {hint}")
    return facts, tensors


def check_weights(path: Path, tensors: dict[str, Tensor], module: nn.Module) -> None:
    """Raise ValueError unless tensors of a file have a module's names and shapes and are finite."""
    expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    if expected != found:
        raise ValueError(f"{path} should hold the tensors {expected}, it holds {found}")
    if not all(bool(torch.isfinite(value).all()) for value in tensors.values()):
        raise ValueError(f"{path} holds weights that are not finite")
