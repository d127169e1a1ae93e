"""What a run tells on stderr: one line an event, and bars only on a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator

QUIET, NORMAL, VERBOSE = 0, 1, 2
level = NORMAL


def printable(text: str) -> str:
    """text as one line: control characters and line breaks escaped, bytes of names that are not UTF-8 as replacement
    characters."""
    return "".join(_shown(c) for c in text)


def _shown(character: str) -> str:
    code = ord(character)
    if 0xD800 <= code < 0xE000:
        return "\ufffd"
    if code < 0x20 or 0x7F <= code < 0xA0 or code in (0x2028, 0x2029):
        return character.encode("unicode_escape").decode()
    return character


def line(text: str) -> None:
    """Print text to stderr as one line. Where stderr cannot be written (closed, on a full disk) the work goes on."""
    with contextlib.suppress(OSError, ValueError):
        print(printable(text), file=sys.stderr, flush=True)


def say(text: str, at: int = NORMAL) -> None:
    """Print a line to stderr when the verbosity is at least `at`."""
    if level >= at:
        line(text)


def status(text: str) -> None:
    """How a step gets on: a line on stderr when verbose, else, on a terminal, a line that the next one replaces."""
    if level >= VERBOSE:
        say(f"    {text}", at=VERBOSE)
    elif level == NORMAL and sys.stderr.isatty():
        with contextlib.suppress(OSError, ValueError):
            print(f"\r\033[K  {printable(text)}", end="\r", file=sys.stderr, flush=True)


def progress(iterable: Iterable, total: int | None = None, label: str = "") -> Iterator:
    """Iterate with a bar on stderr; silent when quiet or when stderr is not a terminal."""
    from tqdm import tqdm

    return iter(tqdm(iterable, total=total, desc=label, disable=True if level == QUIET else None, leave=False))
