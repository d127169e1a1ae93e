"""Count the processors, and work on many parts in several threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mapped(run: Callable, parts: list, threads: int) -> Iterator:
    """Yield run(part) for each part, in order, computed on several threads."""
    if threads <= 1:
        yield from map(run, parts)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(run, parts)
