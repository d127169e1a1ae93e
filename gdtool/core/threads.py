"""How many processors there are, and the same work on many parts in several threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mapped(run: Callable, parts: list, threads: int) -> Iterator:
    """run(part) of each part, in order, on several threads."""
    if threads <= 1:
        yield from map(run, parts)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(run, parts)
