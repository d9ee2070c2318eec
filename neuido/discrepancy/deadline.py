"""When a diagnosis has to come to its end: what is left out from then on, and said to be."""

import math
import time
from collections.abc import Callable

SEARCH = 0.8
"""Share of the time for the search at the most; the rest is for the last fit, the intervals and the report."""
LEAST = 0.6
"""The same at the least."""
AFTER = 200
"""Simulations that follow it: what was begun is weighed, the best is fitted to its end, and its intervals are taken."""


class Deadline:
    """The time that a diagnosis may take.

    Args:
        seconds: From now on; infinite: as long as it takes.
        clock: Seconds on a clock that never goes back.
        pace: Seconds that a simulation has taken so far; where one is slow the search ends earlier.

    Attributes:
        left_out: What the search has not done, in words.
        cut: Whether a step or a fit ended early for lack of time, so that more time could change the answer.
    """

    def __init__(
        self, seconds: float = math.inf, *, clock: Callable[[], float] = time.monotonic, pace: Callable[[], float] = lambda: 0.0
    ) -> None:
        self.clock, self.begun, self.seconds, self.pace = clock, clock(), seconds, pace
        self.concluding = False
        self.left_out: list[str] = []
        self.cut = False

    @property
    def share(self) -> float:
        """Share of the time that counts: that of the search, or all of it."""
        if self.concluding or math.isinf(self.seconds):
            return 1.0
        return min(max(1.0 - AFTER * self.pace() / max(self.seconds, 1e-9), LEAST), SEARCH)

    @property
    def over(self) -> bool:
        """Whether the time for the search is up, or all of it once the diagnosis concludes; nothing is noted."""
        return self._is_past(1.0)

    def ends(self, share: float = 1.0) -> bool:
        """Whether something ends here because this share of the time that counts is over; the search counts as cut off then."""
        past = self._is_past(share)
        self.cut = self.cut or past
        return past

    def _is_past(self, share: float) -> bool:
        return self.clock() - self.begun > share * self.share * self.seconds

    def skips(self, what: str, until: float = 1.0) -> bool:
        """Whether there is no time left for a step, or it is past this share of it; which is noted then."""
        if not self.ends(until):
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True

    def conclude(self) -> None:
        """From here on the whole time counts."""
        self.concluding = True
