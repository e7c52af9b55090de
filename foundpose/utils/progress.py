"""Progress bars on the terminal."""

from tqdm import tqdm


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
            self._bar = tqdm(total=total, desc=f"{self.title} {stage}".strip())
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def close(self) -> None:
        """End the current bar."""
        if self._bar is not None:
            self._bar.close()
        self._bar = None
        self._stage = None
