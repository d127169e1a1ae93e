"""Show the progress of a run: one line per event on stderr, all lines with times in a file, bars on a terminal only."""

from __future__ import annotations

import contextlib
import datetime
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TextIO

from gdtool.core.errors import from_os_error

QUIET, NORMAL, VERBOSE = 0, 1, 2
level = NORMAL
_file: TextIO | None = None


def append_to(path: Path) -> None:
    """Append each line from now on to a file, with its time and whatever the verbosity. Raises OutputError."""
    global _file
    try:
        _file = path.open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise from_os_error(error, path) from None


def printable(text: str) -> str:
    """Convert text to one line: escape control characters and line breaks, replace bytes that are not UTF-8."""
    return "".join(_escaped(c) for c in text)


def _escaped(character: str) -> str:
    """Escape a character that would break a line; replace a lone surrogate."""
    code = ord(character)
    if 0xD800 <= code < 0xE000:
        return "\ufffd"
    if code < 0x20 or 0x7F <= code < 0xA0 or code in (0x2028, 0x2029):
        return character.encode("unicode_escape").decode()
    return character


def line(text: str, shown: bool = True) -> None:
    """Print text to stderr as one line, and append it to the file of append_to().

    A stderr or a file that cannot be written (closed, on a full disk) does not stop the work.
    """
    if shown:
        with contextlib.suppress(OSError, ValueError):
            print(printable(text), file=sys.stderr, flush=True)
    if _file is not None:
        time = datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
        with contextlib.suppress(OSError, ValueError):
            print(time, printable(text), file=_file, flush=True)


def say(text: str, at: int = NORMAL) -> None:
    """Print a line to stderr when the verbosity is at least `at`."""
    line(text, shown=level >= at)


def status(text: str) -> None:
    """Show how far a step is: as a line on stderr when verbose, else on a terminal as a line that the next replaces."""
    say(f"    {text}", at=VERBOSE)
    if level == NORMAL and sys.stderr.isatty():
        with contextlib.suppress(OSError, ValueError):
            print(f"\r\033[K  {printable(text)}", end="\r", file=sys.stderr, flush=True)


def progress(iterable: Iterable, total: int | None = None, label: str = "") -> Iterator:
    """Iterate with a bar on stderr; silent when quiet or when stderr is not a terminal."""
    from tqdm import tqdm

    return iter(tqdm(iterable, total=total, desc=label, disable=True if level == QUIET else None, leave=False))
