"""Measure the time that is left, so that a long computation can stop with a complete result."""

from __future__ import annotations

import time
from collections.abc import Callable


class Clock:
    """Count seconds since construction.

    budget: seconds in all, 0 for no limit. now: function that returns the current time in seconds.
    """

    def __init__(self, budget: float = 0.0, now: Callable[[], float] = time.perf_counter):
        self.budget, self._now = budget, now
        self._start = now()

    @property
    def limited(self) -> bool:
        """Tell whether there is a time limit."""
        return self.budget > 0

    def spent(self) -> float:
        """Return the seconds since the start."""
        return self._now() - self._start

    def left(self) -> float:
        """Return the seconds until the limit: negative after it, infinite without one."""
        return self.budget - self.spent() if self.limited else float("inf")
