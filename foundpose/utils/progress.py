"""Progress on standard error: stage, what is done of it, rate and time left.

Bars are not shown where standard error is no terminal, or where the environment says ``FOUNDPOSE_PROGRESS=false``
(the apps' ``progress=false``).
"""

import os
import sys
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from tqdm import tqdm

T = TypeVar("T")


def say(line: str) -> None:
    """Tell of a step on standard error, at once, whatever it is."""
    print(line, file=sys.stderr, flush=True)


def track(items: Iterable[T], stage: str, total: int | None = None) -> Iterator[T]:
    """Go through items with a bar; ``total`` is for those that have no length."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with _bar(stage, total) as bar:
        for item in items:
            yield item
            bar.update()


class ProgressBars:
    """One bar per stage of a long computation; pass it where a ``Progress`` is asked for.

    Args:
        title: stands before the stage's name.
    """

    def __init__(self, title: str = "") -> None:
        self.title = title
        self._stage: str | None = None
        self._bar: tqdm | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of ``stage`` are finished."""
        if self._bar is None or stage != self._stage:
            self.close()
            self._stage = stage
            self._bar = _bar(f"{self.title} {stage}".strip(), total)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """End the current bar."""
        if self._bar is not None:
            self._bar.close()
        self._bar = None
        self._stage = None


def _bar(title: str, total: int | None) -> tqdm:
    wanted = os.environ.get("FOUNDPOSE_PROGRESS", "true").lower() != "false"
    # None: tqdm finds out whether it writes to a terminal.
    return tqdm(
        total=total, desc=title, disable=None if wanted else True, file=sys.stderr, dynamic_ncols=True
    )
