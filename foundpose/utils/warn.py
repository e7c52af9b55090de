"""Warnings that point at whoever called the library."""

import sys
import warnings
from pathlib import Path

import torch

_INSIDE = (str(Path(__file__).resolve().parents[1]), str(Path(torch.__file__).parent))


def warn_caller(message: str) -> None:
    """Warn, naming the line outside of this library and of PyTorch that led here."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_INSIDE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
