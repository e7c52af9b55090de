"""Wall-clock time of modules, measured from outside."""

import time
from collections import defaultdict
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import torch
from torch import nn


class StageTimer:
    """Adds up the time spent in the ``forward`` of some modules, as a context manager.

    Args:
        modules: what to time, by name.
        synchronize: wait for the GPUs before a clock is read, which costs time, so measure only when asked to. False
            for modules that compute on the CPU.

    Attributes:
        seconds: time by name, of all calls so far.
        calls: number of calls by name.
    """

    def __init__(self, modules: Mapping[str, nn.Module], synchronize: bool = True) -> None:
        self.modules = dict(modules)
        self.synchronize = synchronize
        self.seconds: dict[str, float] = defaultdict(float)
        self.calls: dict[str, int] = defaultdict(int)
        self._started: dict[str, list[float]] = defaultdict(list)
        self._handles: list[torch.utils.hooks.RemovableHandle] = []

    def __enter__(self) -> Self:
        for name, module in self.modules.items():
            self._handles.append(module.register_forward_pre_hook(self._start(name)))
            self._handles.append(module.register_forward_hook(self._stop(name), always_call=True))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles.clear()

    def _start(self, name: str) -> Any:
        def hook(module: nn.Module, arguments: tuple[Any, ...]) -> None:
            self._started[name].append(self._now())

        return hook

    def _stop(self, name: str) -> Any:
        def hook(module: nn.Module, arguments: tuple[Any, ...], output: Any) -> None:
            self.seconds[name] += self._now() - self._started[name].pop()
            self.calls[name] += 1

        return hook

    def _now(self) -> float:
        if self.synchronize and torch.cuda.is_available():
            torch.cuda.synchronize()
        return time.perf_counter()
