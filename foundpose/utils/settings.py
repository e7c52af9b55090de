"""What modules say of their settings: what files on disk are named after."""

import hashlib
import json
from abc import ABC, abstractmethod
from typing import Any

from torch import nn

Setting = str | int | float | bool | None


class Configured(nn.Module, ABC):
    """A module that says all settings which its results depend on."""

    @abstractmethod
    def settings(self) -> dict[str, Setting]:
        """Settings by name."""

    def extra_repr(self) -> str:
        """Settings, for printing."""
        return ", ".join(f"{name}={value!r}" for name, value in self.settings().items())


def identity(module: nn.Module) -> str:
    """A module's class and settings, as one string.

    Raises:
        ValueError: the module does not say its settings, so that its results on disk could not be told from those of
            other settings.
    """
    settings = getattr(module, "settings", None)
    if not callable(settings):
        name = type(module).__name__
        raise ValueError(
            f"{name} has no method settings(), so files made with it could not be told from those of other settings: "
            "give it one that returns a dict of all that its results depend on"
        )
    text = ", ".join(f"{key}={value!r}" for key, value in settings().items())
    return f"{type(module).__name__}({text})"


def digest(facts: Any) -> str:
    """sha256 of facts that JSON can hold; the order of the facts does not matter."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
