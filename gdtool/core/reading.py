"""Read files that a user names: regular files only, and JSON with bounded numbers, strings and nesting."""

from __future__ import annotations

import errno
import json
import math
import stat
from pathlib import Path
from typing import Any

from gdtool.core.errors import InputError, from_os_error
from gdtool.core.memory import require_memory
from gdtool.core.names import quoted, text_fault

MAX_INTEGER_DIGITS = 19  # of a 64-bit integer

_SPECIAL = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def require_regular_file(path: Path) -> None:
    """Raise InputError unless path is a regular file or a link to one: reading a FIFO or a device may never end.

    Raises OutputError where the system denies access to it.
    """
    try:
        mode = Path(path).stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(path, "does not exist", "check the path") from None
    except ValueError:  # a NUL in the name
        raise InputError(quoted(str(path)), "is not a file name", "check the path") from None
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
            raise InputError(
                quoted(str(path)),
                error.strerror.lower() if error.strerror else "is not a file name",
                "check the path",
            ) from None
        raise from_os_error(error, path) from None
    kind = next((name for test, name in _SPECIAL if test(mode)), None)
    if kind:
        raise InputError(path, f"is {kind}, not a file", "write its content to a file and name that")
    if stat.S_ISDIR(mode):
        raise InputError(path, "is a folder, not a file", "name a file inside it")


def bytes_of(path: Path) -> bytes:
    """Read the bytes of a file that the user named.

    Raises InputError where it is no regular file, ResourceError where it is larger than one input may be, OutputError
    where it cannot be read.
    """
    require_regular_file(path)
    require_memory(path.stat().st_size, path, "its content", "give a smaller file")
    try:
        return path.read_bytes()
    except OSError as error:
        raise from_os_error(error, path) from None


def read_json(path: Path) -> Any:
    """Parse a JSON file strictly, as parse_json does. Raises InputError, OutputError."""
    return parse_json(bytes_of(path), path)


def parse_json(content: bytes | str, subject: object) -> Any:
    """Parse JSON strictly: lists, dicts, strings, finite floats, 64-bit integers, booleans and None.

    Raises InputError that names subject and the place, for: text that is not JSON; a repeated key; NaN and infinities;
    numbers beyond float64 or 64 bits; nesting beyond Python's parser (some 1000 levels); strings with lone surrogates
    that stand for no byte of a file name.
    """
    try:
        text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
        value = json.loads(
            text, object_pairs_hook=_unique, parse_int=_integer, parse_float=_float, parse_constant=_constant
        )
    except _Refused as fault:
        raise InputError(subject, str(fault), "correct that entry") from None
    except RecursionError:
        raise InputError(subject, "is nested too deeply (some 1000 levels)", "write it flatter") from None
    except UnicodeDecodeError as error:
        raise InputError(subject, f"is not JSON (byte {error.start} is not UTF-8)", "save it as UTF-8") from None
    except json.JSONDecodeError as error:
        raise InputError(subject, f"is not JSON: {error.msg} in line {error.lineno}", "correct that line") from None
    string_fault = _unfit_string(value)
    if string_fault:
        raise InputError(subject, string_fault, "correct that entry")
    return value


class _Refused(Exception):
    """Report that a value of the JSON is not accepted; str() says which and why."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a dict of pairs. Raises _Refused for a repeated key."""
    out: dict[str, Any] = {}
    for key, value in pairs:
        if key in out:
            raise _Refused(f"key {quoted(key)} appears twice")
        out[key] = value
    return out


def _integer(text: str) -> int:
    """Parse a 64-bit integer. Raises _Refused."""
    if len(text.lstrip("-")) > MAX_INTEGER_DIGITS or not -(2**63) <= int(text) < 2**63:
        raise _Refused(f"holds the integer {text[:24]}{'…' if len(text) > 24 else ''}, beyond 64 bits")
    return int(text)


def _float(text: str) -> float:
    """Parse a finite float. Raises _Refused."""
    value = float(text)
    if not math.isfinite(value):
        raise _Refused(f"holds the number {text[:24]}{'…' if len(text) > 24 else ''}, beyond double precision")
    return value


def _constant(text: str) -> float:
    """Refuse NaN and infinities, which Python's parser accepts."""
    raise _Refused(f"holds {text}, which JSON has no word for")


def _unfit_string(value: Any) -> str | None:
    """Say where a string of a parsed JSON holds a lone surrogate, and which; None where none does."""
    waiting: list[tuple[str, Any]] = [("", value)]
    while waiting:
        place, part = waiting.pop()
        if isinstance(part, dict):
            waiting += [(f"{place}.{key}", inner) for key, inner in part.items()]
            waiting += [(f"key {quoted(key)} of {place or 'the whole'}", key) for key in part if not key.isascii()]
        elif isinstance(part, list):
            waiting += [
                (f"{place}[{i}]", inner) for i, inner in enumerate(part) if isinstance(inner, (str, dict, list))
            ]
        elif isinstance(part, str) and not part.isascii():
            surrogates = "".join(c for c in part if "\ud800" <= c <= "\udfff")
            fault = text_fault(surrogates, byte_escapes=True)
            if fault:
                return f"{place.lstrip('.')} {fault}"
    return None
