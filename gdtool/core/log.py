"""What a run tells on stderr: one line an event, and bars only on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator

QUIET, NORMAL, VERBOSE = 0, 1, 2
level = NORMAL


def say(text: str, at: int = NORMAL) -> None:
    """Print a line to stderr when the verbosity is at least `at`."""
    if level >= at:
        print(text, file=sys.stderr, flush=True)


def status(text: str) -> None:
    """How a step gets on: a line on stderr when verbose, else, on a terminal, a line that the next one replaces."""
    if level >= VERBOSE:
        say(f"    {text}", at=VERBOSE)
    elif level == NORMAL and sys.stderr.isatty():
        print(f"\r\033[K  {text}", end="\r", file=sys.stderr, flush=True)


def progress(iterable: Iterable, total: int | None = None, label: str = "") -> Iterator:
    """Iterate with a bar on stderr; silent when quiet or when stderr is not a terminal."""
    from tqdm import tqdm

    return iter(tqdm(iterable, total=total, desc=label, disable=True if level == QUIET else None, leave=False))
