"""Batches that are prepared one ahead of the one being worked on."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

_T = TypeVar("_T")
_R = TypeVar("_R")


@contextmanager
def prefetch(make: Callable[[_T], _R], items: Iterable[_T], ahead: bool = True) -> Iterator[Iterator[_R]]:
    """Results of ``make`` for some items, in order; the next is made in a thread while the last is worked on.

    Only one is ever made in advance, so no more than two are in memory. An exception in ``make`` is raised where its
    result would come. However the block is left, the thread has ended then.

    Args:
        make: must not depend on state of the calling thread, such as autograd's mode.
        items: arguments.
        ahead: False makes each result when it is asked for, in the calling thread.
    """
    if not ahead:
        yield map(make, items)
        return
    pool = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    try:
        yield _results(pool, make, items)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _results(pool: ThreadPoolExecutor, make: Callable[[_T], _R], items: Iterable[_T]) -> Iterator[_R]:
    waiting: Future[_R] | None = None
    for item in items:
        current, waiting = waiting, pool.submit(make, item)
        if current is not None:
            yield current.result()
    if waiting is not None:
        yield waiting.result()


def pin(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor on the CPU, in memory that a device fetches by itself, if the device does such things."""
    return tensor.pin_memory() if device.type == "cuda" else tensor


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor on a device. A GPU fetches it from pinned memory while the program goes on."""
    return tensor.to(device, non_blocking=device.type == "cuda")
