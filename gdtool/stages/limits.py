"""Limit a stage to the time that --seconds or --budget gives it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

from gdtool.core.ending import GRACE, time_limit
from gdtool.core.errors import ResourceError

# A run has to end within OVER x its time limit + MORE seconds. The limit is for the main work; reading, checking and
# writing come on top.
OVER, MORE = 2.0, 5.0
_UNWIND = GRACE + 0.3  # seconds of MORE that are left for the end
# Share of the measured time that a quick machine takes. Work that would be too long even there is refused at once.
_QUICK = 0.5


@contextmanager
def limited_to(seconds: float, option: str, name: str, cure: str) -> Iterator[None]:
    """Raise ResourceError in a block that takes so long that the run could not end within OVER * seconds + MORE
    seconds.

    seconds: the time limit that the user gave by `option`. name: of the object, and cure: what to do about it, for the
    message.
    """
    latest = OVER * seconds + MORE - _UNWIND
    with time_limit(
        latest, ResourceError(name, f"is not done after {latest:g} s, and {option} {seconds:g} allows no more", cure)
    ):
        yield


def require_time(needed: float, seconds: float, option: str, name: str, cure: str) -> None:
    """Raise ResourceError before the work starts, where even the quickest method would take longer than limited_to()
    allows.

    needed: seconds of the quickest method on the machine where it was measured. seconds, option, name, cure: as for
    limited_to().
    """
    if _QUICK * needed > OVER * seconds + MORE - _UNWIND:
        raise ResourceError(
            name,
            f"needs about {math.ceil(needed)} s even with the quickest method, and {option} {seconds:g} allows less",
            f"raise {option} to {math.ceil(needed)}, or {cure}",
        )
