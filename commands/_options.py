"""Define the options of the command line: their types, those derived from a stage's Options, and those of every
command.
"""

from __future__ import annotations

import math
import re
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import click
import msgspec

from gdtool.core import log
from gdtool.core.errors import UsageError
from gdtool.core.names import quoted, text_fault

LOG_FILE_HELP = "Append all messages, with times, to a file."
VERBOSITY = {
    ("-q", "--quiet"): "Show only errors.",
    ("-v", "--verbose"): "Show the steps, and what is skipped.",
    ("--debug",): "Show tracebacks.",
}


class IntegerRange(click.IntRange):
    """Parse an integer between bounds; the help shows INTEGER."""

    name = "integer"


class FiniteRange(click.FloatRange):
    """Parse a finite float between bounds; click's own range lets NaN pass."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; fail for NaN and infinities."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is not a finite number.", param, ctx)
        return number


class Text(click.ParamType):
    """Parse a string without control characters: a name with a line break would be two lines in a pipe."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the string; fail for one with a control character."""
        fault = text_fault(value, byte_escapes=True)
        if fault:
            self.fail(f"{quoted(value)} {fault}", param, ctx)
        return value


TEXT = Text()


def verbosity_options(function: Callable) -> Callable:
    """Add --json, --log-file, -q, -v and --debug to a command that prints a report."""
    function = click.option("--log-file", type=TEXT, metavar="PATH", help=LOG_FILE_HELP)(function)
    for flags, text in reversed(VERBOSITY.items()):
        function = click.option(*flags, is_flag=True, help=text)(function)
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")(function)


def set_verbosity(quiet: bool, verbose: bool, log_file: str | None) -> None:
    """Apply -q, -v and --log-file. Raises OutputError where the file cannot be written."""
    log.level = log.QUIET if quiet else log.VERBOSE if verbose else log.NORMAL
    if log_file:
        log.append_to(Path(log_file))


def option_from_field(field: Any, hint: Any) -> click.Option:
    """Make the click option of a field of a msgspec Struct: name, type, bounds, default and help come from the field.

    hint: the field's type with its annotations.
    """
    inner, meta, optional = _unwrapped(hint)
    name = field.name.replace("_", "-")
    common: dict[str, Any] = {
        "default": None if optional and field.default is None else field.default,
        "show_default": not optional,
        "help": meta.description or "",
    }
    if inner is bool:
        return click.Option([f"--{name}/--no-{name}"], **common)
    if typing.get_origin(inner) is Literal:
        return click.Option([f"--{name}"], type=click.Choice([str(a) for a in typing.get_args(inner)]), **common)
    if typing.get_origin(inner) is tuple:
        common |= {"default": ",".join(field.default or ()), "metavar": "A,B,…", "callback": _split_at_commas}
        return click.Option([f"--{name}"], type=TEXT, **common)
    if inner in (int, float):
        return click.Option([f"--{name}"], type=_number_type(inner, meta), **common)
    return click.Option([f"--{name}"], type=TEXT, **common)


def _unwrapped(hint: Any) -> tuple[Any, msgspec.Meta, bool]:
    """Take Annotated and `| None` off a type hint; returns the type, its Meta, and whether it may be None."""
    meta, optional = msgspec.Meta(), False
    if typing.get_origin(hint) is typing.Annotated:
        hint, meta = typing.get_args(hint)[:2]
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
        optional = True
        if typing.get_origin(hint) is typing.Annotated:
            hint, meta = typing.get_args(hint)[:2]
    return hint, meta, optional


def _split_at_commas(_context: click.Context, _param: click.Parameter, value: str) -> tuple[str, ...]:
    """Split A,B,… into its parts, without empty ones."""
    return tuple(part for part in value.split(",") if part)


def _number_type(number: type, meta: msgspec.Meta) -> click.ParamType:
    """Make the click type of an int or a float within the bounds of its Meta."""
    bounds: dict[str, Any] = {
        "min": next((x for x in (meta.ge, meta.gt) if x is not None), None),
        "max": next((x for x in (meta.le, meta.lt) if x is not None), None),
        "min_open": meta.gt is not None,
        "max_open": meta.lt is not None,
    }
    return (IntegerRange if number is int else FiniteRange)(**bounds)


def options_from(struct: type) -> list[click.Option]:
    """Make the click options of all fields of a msgspec Struct."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return [option_from_field(field, hints[field.name]) for field in msgspec.structs.fields(struct)]


def build_options(struct: type, values: dict[str, Any]) -> Any:
    """Make the Struct from the values of its options, and check its constraints. Raises UsageError."""
    try:
        return msgspec.convert({field.name: values[field.name] for field in msgspec.structs.fields(struct)}, struct)
    except msgspec.ValidationError as error:
        raise UsageError("options", str(error), "give the option a value that --help names") from None


_SHARD = re.compile(r"([0-9]{1,9})/([0-9]{1,9})")


def shard_of(text: str | None) -> tuple[int, int]:
    """Parse I/N, with 1/1 for None. Raises UsageError."""
    if text is None:
        return 1, 1
    match = _SHARD.fullmatch(text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"--shard {text}", "is not I/N with I from 1 to N", "give 1/N to N/N, one to each job")
    return int(match[1]), int(match[2])
