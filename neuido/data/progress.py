"""Progress of long work: a bar on a terminal, elsewhere a plain line every half minute."""

import math
import sys
import threading
import time
from types import TracebackType
from typing import Any

from tqdm import tqdm

PLAIN_SECONDS = 30.0
"""Seconds between two lines where there is no terminal."""


class Progress:
    """Show on stderr what is done, how much of it, the time elapsed and the time that remains.

    Work that ends within half a minute prints nothing where there is no terminal. The lines come from a thread of their own, so that one
    long step does not silence them.

    Args:
        what: Name of the work: "trajectories".
        total: Steps in all; none: not known.
        unit: Name of the steps, where `what` does not say it: "images".
        done: Steps that an earlier run has done.
        shown: Whether anything is shown.
    """

    def __init__(self, what: str, total: int | None = None, *, unit: str = "", done: int = 0, shown: bool = True) -> None:
        self.what, self.total, self.unit, self.done, self.shown = what, total, unit, done, shown
        self.stage, self.first, self.begun = "", done, time.monotonic()
        self._bar: Any = None
        self._ended = threading.Event()

    def __enter__(self) -> "Progress":
        self.begun = time.monotonic()
        if self.shown and sys.stderr.isatty():
            self._bar = tqdm(desc=self.what, total=self.total, initial=self.done, unit=f" {self.unit or self.what}", leave=False)
        elif self.shown:
            threading.Thread(target=self._print_lines, daemon=True).start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the bar and the lines."""
        self._ended.set()
        if self._bar is not None:
            self._bar.close()

    def update(self, count: int = 1) -> None:
        """Count further steps."""
        self.move_to(self.done + count)

    def move_to(self, done: int) -> None:
        """Set how many steps are done."""
        if self._bar is not None:
            self._bar.update(done - self.done)
        self.done = done

    def say(self, stage: str) -> None:
        """Name what is being done now."""
        self.stage = stage
        if self._bar is not None:
            self._bar.set_postfix_str(stage)

    def note(self, line: str) -> None:
        """Print a line above the bar, on a terminal alone."""
        if self._bar is not None:
            self._bar.write(line, file=sys.stderr)

    def print(self, line: str) -> None:
        """Print a line to stdout without damaging the progress bar.

        Args:
            line: A result of the work, which belongs on stdout; `note` is for remarks about its progress.
        """
        if self._bar is not None:
            self._bar.write(line)
        else:
            print(line, flush=True)

    def line(self, now: float) -> str:
        """Return the plain line at a time of `time.monotonic`."""
        elapsed, share = now - self.begun, self.done - self.first
        count = f"{self.done}" if self.total is None else f"{self.done} of {self.total}"
        parts = [f"{self.what}: {count} {self.unit}".rstrip()] if self.unit or self.total is not None else [self.what]
        parts += [self.stage] if self.stage else []
        parts.append(f"{duration(elapsed)} elapsed")
        if self.total is not None and share > 0:
            parts.append(f"about {duration(elapsed * max(0, self.total - self.done) / share)} left")
        return ", ".join(parts)

    def _print_lines(self) -> None:
        while not self._ended.wait(PLAIN_SECONDS):
            print(self.line(time.monotonic()), file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Return a time in words: 42 s, 3 min 20 s, 2 h 5 min."""
    whole = math.ceil(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
