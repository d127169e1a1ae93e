"""What all commands share: options derived from a stage's Options, exit codes, and what goes to stdout."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import sys
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import click
import msgspec

from gdtool.core import ending, log
from gdtool.core.errors import GdtoolError, UsageError, from_exception, from_os_error
from gdtool.core.names import shown, text_fault
from gdtool.core.stage import Stage

BROKEN_PIPE = 141  # as a shell reports SIGPIPE


def guarded(group: click.Command) -> None:
    """Run the group and exit: every way out has its exit code, and only --debug shows tracebacks."""
    undo = ending.listen()
    try:
        sys.exit(_code_of(group))
    finally:
        undo()


def _code_of(group: click.Command) -> int:
    """Run the group; the exit code of whatever it returns or raises."""
    try:
        # Not group.main(): click would turn a broken pipe into exit code 1.
        with group.make_context("gdtool", sys.argv[1:]) as context:
            code = group.invoke(context)
        sys.stdout.flush()
        code = code if isinstance(code, int) else 0
    except click.exceptions.Exit as error:
        code = error.exit_code
    except click.Abort:
        code = 128 + signal.SIGINT
    except click.ClickException as error:
        code = _usage(error)
    except KeyboardInterrupt as error:
        code = 128 + getattr(error, "number", signal.SIGINT)
    except BrokenPipeError:
        code = BROKEN_PIPE
    except Exception as error:
        code = tell(error, "gdtool").exit_code if ending.received is None else 0
    if ending.received:  # whatever a library made of it on the way
        code = 128 + ending.received
        if ending.received == getattr(signal, "SIGXCPU", None):
            log.line("gdtool: the limit of processor time is reached; raise it (ulimit -t)")
    ending.ignore()
    _close_stdout()
    return code


def _usage(error: click.ClickException) -> int:
    """Tell what is wrong with the command line in one line; without any arguments the help, as click does."""
    if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):
        error.show()
        return error.exit_code
    context = getattr(error, "ctx", None)
    place = context.command_path if context is not None else "gdtool"
    text = " ".join(error.format_message().split()).rstrip(".")
    log.line(f"{place}: {text[:1].lower() + text[1:]}; see {place} --help")
    return error.exit_code


def _close_stdout() -> None:
    """Where stdout cannot be written (its reader has left, its disk is full), keep the interpreter from flushing it
    again."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def tell(error: Exception, subject: object) -> GdtoolError:
    """Report an exception that was raised while working on subject, with its traceback under --debug; what it counts
    as."""
    problem = from_exception(error, subject)
    if debugging():
        import traceback

        traceback.print_exception(problem.__cause__ or error)
    report(problem)
    return problem


def debugging() -> bool:
    """Whether --debug is among the arguments."""
    return "--debug" in sys.argv


def report(error: GdtoolError) -> None:
    """Write an error as one line to stderr."""
    report_text(str(error).removeprefix("gdtool: "))


def report_text(text: str) -> None:
    """Write one of gdtool's lines to stderr."""
    log.line(f"gdtool: {text}")


def emit(content: bytes) -> None:
    """Write a result to stdout at once. Raises OutputError where it cannot be written, BrokenPipeError where nobody
    reads it."""
    try:
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise from_os_error(error, "stdout") from None


def exit_code(failed: list[GdtoolError], done: int) -> int:
    """0 where nothing failed, the code that all failures share where nothing was done, else 1."""
    codes = {error.exit_code for error in failed}
    return 0 if not failed else codes.pop() if not done and len(codes) == 1 else 1


LOG_FILE_HELP = "Append all that is told, with times, to a file."
VERBOSITY = {
    ("-q", "--quiet"): "Tell only errors.",
    ("-v", "--verbose"): "Tell steps and skips.",
    ("--debug",): "Show tracebacks.",
}


class IntegerRange(click.IntRange):
    """An integer between bounds."""

    name = "integer"


class FiniteRange(click.FloatRange):
    """A float between bounds; not NaN, which is never outside of them."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is not a finite number.", param, ctx)
        return number


class Text(click.ParamType):
    """A string without control characters: names with line breaks would be two lines in a pipe."""

    name = "text"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        fault = text_fault(value, byte_escapes=True)
        if fault:
            self.fail(f"{shown(value)} {fault}", param, ctx)
        return value


TEXT = Text()


def verbosity_options(function: Callable) -> Callable:
    """Add --json, --log-file, -q, -v and --debug, for commands that print a report."""
    function = click.option("--log-file", type=TEXT, metavar="PATH", help=LOG_FILE_HELP)(function)
    for flags, text in reversed(VERBOSITY.items()):
        function = click.option(*flags, is_flag=True, help=text)(function)
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")(function)


def set_verbosity(quiet: bool, verbose: bool, log_file: str | None) -> None:
    """Apply -q, -v and --log-file. Raises OutputError where the file cannot be written."""
    log.level = log.QUIET if quiet else log.VERBOSE if verbose else log.NORMAL
    if log_file:
        log.keep_in(Path(log_file))


def option_from_field(field: Any, hint: Any) -> click.Option:
    """Return the click option of one field of a msgspec Struct: name, type, bounds, default and help come from it."""
    meta, inner, optional = msgspec.Meta(), hint, False
    if typing.get_origin(inner) is typing.Annotated:
        inner, meta = typing.get_args(inner)[0], typing.get_args(inner)[1]
    if typing.get_origin(inner) in (types.UnionType, typing.Union):
        inner = next(a for a in typing.get_args(inner) if a is not type(None))
        optional = True
        if typing.get_origin(inner) is typing.Annotated:
            inner, meta = typing.get_args(inner)[0], typing.get_args(inner)[1]
    name = field.name.replace("_", "-")
    text = meta.description or ""
    common: dict[str, Any] = {
        "default": None if optional and field.default is None else field.default,
        "show_default": not optional,
        "help": text,
    }
    if inner is bool:
        return click.Option([f"--{name}/--no-{name}"], **common)
    if typing.get_origin(inner) is Literal:
        return click.Option([f"--{name}"], type=click.Choice([str(a) for a in typing.get_args(inner)]), **common)
    if typing.get_origin(inner) is tuple:
        common["default"] = ",".join(field.default or ())
        return click.Option(
            [f"--{name}"],
            type=TEXT,
            metavar="A,B,…",
            callback=lambda _c, _p, v: tuple(x for x in v.split(",") if x),
            **common,
        )
    if inner in (int, float):
        lowest, highest = (meta.ge, meta.gt), (meta.le, meta.lt)
        bounds: dict[str, Any] = {
            "min": next((x for x in lowest if x is not None), None),
            "max": next((x for x in highest if x is not None), None),
            "min_open": meta.gt is not None,
            "max_open": meta.lt is not None,
        }
        return click.Option([f"--{name}"], type=(IntegerRange if inner is int else FiniteRange)(**bounds), **common)
    return click.Option([f"--{name}"], type=TEXT, **common)


def options_from(struct: type) -> list[click.Option]:
    """click options for all fields of a msgspec Struct."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return [option_from_field(field, hints[field.name]) for field in msgspec.structs.fields(struct)]


def build_options(struct: type, values: dict[str, Any]) -> Any:
    """Return the Struct from parsed values, checked against its constraints. Raises UsageError."""
    try:
        return msgspec.convert({field.name: values[field.name] for field in msgspec.structs.fields(struct)}, struct)
    except msgspec.ValidationError as error:
        raise UsageError("options", str(error), "give the option a value that --help names") from None


_SHARD = re.compile(r"([0-9]{1,9})/([0-9]{1,9})")


def shard_of(text: str | None) -> tuple[int, int]:
    """Return the I and N of I/N. Raises UsageError."""
    if text is None:
        return 1, 1
    match = _SHARD.fullmatch(text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise UsageError(f"--shard {text}", "is not I/N with I from 1 to N", "give 1/N to N/N, one to each job")
    return int(match[1]), int(match[2])


def help_of(module: types.ModuleType) -> str:
    """Return a module's docstring as click help: pasted examples keep their line breaks. Under python -OO it is read
    from the source."""
    text = module.__doc__
    if text is None:
        import ast

        text = ast.get_docstring(ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8")), clean=False) or ""
    return text.replace("Example:\n", "\b\nExample:\n").replace("Examples:\n", "\b\nExamples:\n")


# The most that --threads takes: more than any machine has.
MOST_THREADS = 1024


def stage_command(stage: Stage, help: str) -> click.Command:
    """Return the command line of a stage."""

    def invoke(**values: Any) -> int:
        from gdtool.core.runner import Settings, run_all
        from gdtool.stages.early import require_device

        set_verbosity(values["quiet"], values["verbose"], values["log_file"])
        arguments = values["sources"]
        shard = shard_of(values.get("shard"))
        settings = Settings(
            output=Path(values["output"]) if values["output"] else None,
            several=len(arguments) > 1 or shard[1] > 1,
            dry_run=values["dry_run"],
            force=values["force"],
            threads=values["threads"],
            device=values.get("device", "cpu"),
            shard=shard,
            ray=values.get("ray"),
        )
        flags = {flag: values["second_" + flag] for flag in stage.second_inputs}
        options = build_options(stage.Options, values)
        if not settings.ray:  # a node of the cluster may have a device that this machine has not
            require_device(settings.device)
        failed: list[GdtoolError] = []
        done = 0
        for result in run_all(stage, arguments, options, flags, settings):
            if isinstance(result, GdtoolError):
                failed.append(tell(result, "gdtool"))
                continue
            done += 1
            if values["as_json"]:
                record = {
                    "folder": str(result.path),
                    "kind": result.kind,
                    "status": result.status,
                    "seconds": round(result.seconds, 3),
                    "skipped": list(result.skipped),
                }
                emit(json.dumps(record).encode() + b"\n")
            else:
                emit(os.fsencode(result.path) + b"\n")
        return exit_code(failed, done)

    params: list[click.Parameter] = [click.Argument(["sources"], nargs=-1, type=TEXT)]
    params += options_from(stage.Options)
    for flag in stage.second_inputs:
        second = stage.second(flag)
        text = second.help or f"The {second.kind} to use" + (
            "; found along the provenance chain without it." if second.search else "."
        )
        params.append(click.Option([f"--{flag}", f"second_{flag}"], type=TEXT, metavar="PATH", help=text))
    if stage.dataset:
        text = "Only every Nth source from the Ith on, for job arrays that share -o: 1/N to N/N."
        params.append(click.Option(["--shard"], type=TEXT, metavar="I/N", help=text))
        text = (
            "Fan out on the Ray cluster at ADDRESS, a source a task; local: on this machine's cores. Nodes share the "
            "folders. Needs gdtool[ray]."
        )
        params.append(click.Option(["--ray"], type=TEXT, metavar="ADDRESS", help=text))
    params += [
        click.Option(
            ["-o", "--output"],
            type=TEXT,
            metavar="DIR",
            help="Output folder; for several sources the parent of NAME.asset/KIND.",
        ),
        click.Option(["-n", "--dry-run"], is_flag=True, help="Print what would be made."),
        click.Option(["-f", "--force"], is_flag=True, help="Run even when up to date."),
        click.Option(["--json", "as_json"], is_flag=True, help="Print one JSON object per source."),
        click.Option(["--threads"], type=IntegerRange(0, MOST_THREADS), default=0, help="Threads; 0: all cores."),
    ]
    if stage.networks:
        devices = click.Choice(["cpu", "cuda"])
        text = "Where networks run."
        params.append(click.Option(["--device"], type=devices, default="cpu", show_default=True, help=text))
    params.append(click.Option(["--log-file"], type=TEXT, metavar="PATH", help=LOG_FILE_HELP))
    params += [click.Option(list(flags), is_flag=True, help=text) for flags, text in VERBOSITY.items()]
    return click.Command(stage.name, callback=invoke, params=params, help=help)
