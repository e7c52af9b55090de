"""Meshes to train on."""

from collections.abc import Sequence

from foundpose.rendering import Mesh, load_mesh
from foundpose.synthetic import procedural_mesh


def small_mesh(seed: int) -> Mesh:
    """A procedural object of 10 k vertices."""
    return procedural_mesh(seed, subdivisions=5)


def meshes_to_train_on(wanted: Sequence[str] | int, first_seed: int, name: str) -> list[Mesh]:
    """Meshes from files, or so many procedural ones.

    Args:
        wanted: mesh files, or a number.
        first_seed: of the procedural objects.
        name: of the setting, for messages.

    Raises:
        ValueError: neither.
        FileNotFoundError: a file is missing.
    """
    if isinstance(wanted, Sequence) and not isinstance(wanted, str):
        return [load_mesh(file) for file in wanted]
    if not isinstance(wanted, int) or wanted < 0:
        raise ValueError(
            f"{name} must be a list of mesh files or a number of procedural objects, got {wanted!r}"
        )
    return [small_mesh(first_seed + i) for i in range(wanted)]
