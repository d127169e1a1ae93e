"""The same work on many parts, in several threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor


def mapped(run: Callable, parts: list, threads: int) -> Iterator:
    """run(part) of each part, in order, on several threads."""
    if threads <= 1:
        yield from map(run, parts)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(run, parts)
