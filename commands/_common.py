"""What all commands share: options derived from a stage's Options, exit codes, and what goes to stdout."""

from __future__ import annotations

import os
import signal
import sys
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import click
import msgspec

from gdtool.core import log
from gdtool.core.errors import GdtoolError, UsageError, from_os_error
from gdtool.core.stage import Stage

INTERRUPTED, TERMINATED, BROKEN_PIPE = 130, 143, 141


class _Terminated(BaseException):
    """SIGTERM, raised where the program is, so that it cleans up on its way out."""


def guarded(group: click.Command) -> None:
    """Run the group; every way out has its exit code, and none shows a traceback for what a user or a file did."""
    debug = "--debug" in sys.argv

    def terminate(*_):
        raise _Terminated

    signal.signal(signal.SIGTERM, terminate)
    try:
        # Not group.main(): click would turn a broken pipe into exit code 1.
        with group.make_context("gdtool", sys.argv[1:]) as context:
            code = group.invoke(context)
        code = code if isinstance(code, int) else 0
        sys.stdout.flush()
    except click.exceptions.Exit as error:
        code = error.exit_code
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = INTERRUPTED
    except _Terminated:
        code = TERMINATED
    except BrokenPipeError:
        # Nothing reads stdout any more; keep the interpreter from flushing it again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = BROKEN_PIPE
    except GdtoolError as error:
        if debug:
            raise
        report(error)
        code = error.exit_code
    except OSError as error:
        if debug:
            raise
        problem = from_os_error(error, "gdtool")
        report(problem)
        code = problem.exit_code
    except MemoryError:
        print("gdtool: out of memory; lower the resolution or free memory", file=sys.stderr)
        code = 5
    sys.exit(code)


def report(error: GdtoolError) -> None:
    """One line on stderr."""
    report_text(str(error))


def report_text(text: str) -> None:
    """A line on stderr; names that are not UTF-8 are shown with replacement characters."""
    print(f"gdtool: {text}".encode(errors="surrogateescape").decode(errors="replace"), file=sys.stderr, flush=True)


VERBOSITY = {
    ("-q", "--quiet"): "Tell only errors.",
    ("-v", "--verbose"): "Tell steps and skips.",
    ("--debug",): "Show tracebacks.",
}


def verbosity_options(function: Callable) -> Callable:
    """--json, -q, -v and --debug, for commands that print a report."""
    for flags, text in reversed(VERBOSITY.items()):
        function = click.option(*flags, is_flag=True, help=text)(function)
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")(function)


def set_verbosity(quiet: bool, verbose: bool) -> None:
    """Apply -q and -v."""
    log.level = log.QUIET if quiet else log.VERBOSE if verbose else log.NORMAL


def option_from_field(field: Any, hint: Any) -> click.Option:
    """The click option of one field of a msgspec Struct: name, type, bounds, default and help come from it."""
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
    common = {"default": None if optional and field.default is None else field.default, "show_default": not optional, "help": text}
    if inner is bool:
        return click.Option([f"--{name}/--no-{name}"], **common)
    if typing.get_origin(inner) is Literal:
        return click.Option([f"--{name}"], type=click.Choice([str(a) for a in typing.get_args(inner)]), **common)
    if typing.get_origin(inner) is tuple:
        common["default"] = ",".join(field.default or ())
        return click.Option([f"--{name}"], metavar="A,B,…", callback=lambda _c, _p, v: tuple(x for x in v.split(",") if x), **common)
    if inner in (int, float):
        bounds = {"min": meta.ge if meta.ge is not None else meta.gt, "max": meta.le if meta.le is not None else meta.lt,
                  "min_open": meta.gt is not None, "max_open": meta.lt is not None}
        kind = (click.IntRange if inner is int else click.FloatRange)
        if inner is int:
            return click.Option([f"--{name}"], type=kind(bounds["min"], bounds["max"]), **common)
        return click.Option([f"--{name}"], type=kind(**bounds), **common)
    return click.Option([f"--{name}"], type=str, **common)


def options_from(struct: type) -> list[click.Option]:
    """click options for all fields of a msgspec Struct."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return [option_from_field(field, hints[field.name]) for field in msgspec.structs.fields(struct)]


def build_options(struct: type, values: dict[str, Any]) -> Any:
    """The Struct from parsed values, checked against its constraints. Raises UsageError."""
    try:
        return msgspec.convert({field.name: values[field.name] for field in msgspec.structs.fields(struct)}, struct)
    except msgspec.ValidationError as error:
        raise UsageError("options", str(error)) from None


def shard_of(text: str | None) -> tuple[int, int]:
    """The I and N of I/N. Raises UsageError."""
    if text is None:
        return 1, 1
    part, _, parts = text.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise UsageError(f"--shard {text}", "is not I/N with I from 1 to N")
    return int(part), int(parts)


def help_of(text: str) -> str:
    """A module docstring as click help: pasted examples keep their line breaks."""
    return text.replace("Example:\n", "\b\nExample:\n").replace("Examples:\n", "\b\nExamples:\n")


def stage_command(stage: Stage, help: str) -> click.Command:
    """The command line of a stage."""

    def invoke(**values: Any) -> int:
        import json

        from gdtool.core.runner import Settings, run_all

        set_verbosity(values["quiet"], values["verbose"])
        arguments = values["sources"]
        shard = shard_of(values.get("shard"))
        settings = Settings(
            output=Path(values["output"]) if values["output"] else None, several=len(arguments) > 1 or shard[1] > 1, dry_run=values["dry_run"],
            force=values["force"], threads=values["threads"], device=values["device"], shard=shard, ray=values.get("ray"),
        )
        flags = {flag: values["second_" + flag] for flag in stage.second_inputs}
        options = build_options(stage.Options, values)
        failed: list[GdtoolError] = []
        done = 0
        for result in run_all(stage, arguments, options, flags, settings):
            if isinstance(result, GdtoolError):
                if values["debug"]:
                    raise result
                report(result)
                failed.append(result)
                continue
            done += 1
            if values["as_json"]:
                print(json.dumps({"folder": str(result.path), "kind": result.kind, "status": result.status,
                                  "seconds": round(result.seconds, 3), "skipped": list(result.skipped)}), flush=True)
            else:
                sys.stdout.buffer.write(os.fsencode(result.path) + b"\n")
                sys.stdout.buffer.flush()
        if not failed:
            return 0
        codes = {error.exit_code for error in failed}
        return codes.pop() if not done and len(codes) == 1 else 1

    params: list[click.Parameter] = [click.Argument(["sources"], nargs=-1, type=str)]
    params += options_from(stage.Options)
    for flag in stage.second_inputs:
        second = stage.second(flag)
        text = second.help or f"The {second.kind} to use" + ("; found along the provenance chain without it." if second.search else ".")
        params.append(click.Option([f"--{flag}", f"second_{flag}"], metavar="PATH", help=text))
    if stage.dataset:
        text = "Only every Nth source from the Ith on, for job arrays that share -o: 1/N to N/N."
        params.append(click.Option(["--shard"], metavar="I/N", help=text))
        text = "Fan out on the Ray cluster at ADDRESS, a source a task; local: on this machine's cores. Nodes share the folders. Needs gdtool[ray]."
        params.append(click.Option(["--ray"], metavar="ADDRESS", help=text))
    params += [
        click.Option(["-o", "--output"], metavar="DIR", help="Output folder; for several sources the parent of NAME.asset/KIND."),
        click.Option(["-n", "--dry-run"], is_flag=True, help="Print what would be made."),
        click.Option(["-f", "--force"], is_flag=True, help="Run even when up to date."),
        click.Option(["--json", "as_json"], is_flag=True, help="Print one JSON object per source."),
        click.Option(["--threads"], type=click.IntRange(0), default=0, help="Threads; 0: all cores."),
        click.Option(["--device"], type=click.Choice(["cpu", "cuda"]), default="cpu", show_default=True, help="Where networks run."),
    ]
    params += [click.Option(list(flags), is_flag=True, help=text) for flags, text in VERBOSITY.items()]
    return click.Command(stage.name, callback=invoke, params=params, help=help_of(help))
