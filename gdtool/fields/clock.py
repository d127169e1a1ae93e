"""How much time is left: what makes a long computation stop while its result is whole."""

from __future__ import annotations

import time
from collections.abc import Callable


class Clock:
    """Counts seconds since it was made. budget: seconds in all, 0 for no end; now: the clock behind it, in seconds."""

    def __init__(self, budget: float = 0.0, now: Callable[[], float] = time.perf_counter):
        self.budget, self._now = budget, now
        self._start = now()

    @property
    def limited(self) -> bool:
        """Whether there is an end."""
        return self.budget > 0

    def spent(self) -> float:
        """Seconds since the start."""
        return self._now() - self._start

    def left(self) -> float:
        """Seconds until the end, below 0 after it; infinite without one."""
        return self.budget - self.spent() if self.limited else float("inf")
