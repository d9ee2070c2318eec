"""When a diagnosis has to come to its end: what is left out from then on, and said to be."""

import math
import time
from collections.abc import Callable

SEARCH = 0.8
"""Share of the time for the search; the rest is for the last fit, the intervals and the report."""


class Deadline:
    """The time that a diagnosis may take.

    Args:
        seconds: From now on; infinite: as long as it takes.
        clock: Seconds on a clock that never goes back.

    Attributes:
        left_out: What the search has not done, in words.
    """

    def __init__(self, seconds: float = math.inf, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock, self.begun, self.seconds = clock, clock(), seconds
        self.share = SEARCH
        self.left_out: list[str] = []

    @property
    def over(self) -> bool:
        """Whether the time for the search is up, or all of it once the diagnosis concludes."""
        return self.past(1.0)

    def past(self, share: float) -> bool:
        """Whether this share of the time that counts is over."""
        return self.clock() - self.begun > share * self.share * self.seconds

    def skips(self, what: str, until: float = 1.0) -> bool:
        """Whether there is no time left for a step, or it is past this share of it; which is noted then."""
        if not self.past(until):
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def conclude(self) -> None:
        """From here on the whole time counts."""
        self.share = 1.0
