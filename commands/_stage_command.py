"""Make the command line of a stage."""

from __future__ import annotations

import json
import os
import types
from pathlib import Path
from typing import Any

import click

from gdtool.core.errors import GdtoolError
from gdtool.core.stage import Stage

from ._exit import emit, exit_code, report_exception
from ._options import (
    LOG_FILE_HELP,
    TEXT,
    VERBOSITY,
    IntegerRange,
    build_options,
    options_from,
    set_verbosity,
    shard_of,
)

MOST_THREADS = 1024  # of --threads: more than any machine has

NETWORK_DEVICES = ("cpu", "cuda")


def help_of(module: types.ModuleType) -> str:
    """Return a module's docstring as click help, in which examples keep their line breaks.

    python -OO drops docstrings; then it is read from the source.
    """
    text = module.__doc__
    if text is None:
        import ast

        text = ast.get_docstring(ast.parse(Path(module.__file__ or "").read_text(encoding="utf-8")), clean=False) or ""
    return text.replace("Example:\n", "\b\nExample:\n").replace("Examples:\n", "\b\nExamples:\n")


def stage_command(stage: Stage, help: str) -> click.Command:
    """Make the command of a stage: its options and those that every stage has."""

    def invoke(**values: Any) -> int:
        return _run(stage, values)

    params: list[click.Parameter] = [click.Argument(["sources"], nargs=-1, type=TEXT)]
    params += options_from(stage.Options)
    params += _second_inputs(stage)
    if stage.dataset:
        params += _dataset_options()
    params += _run_options(stage)
    return click.Command(stage.name, callback=invoke, params=params, help=help)


def _run(stage: Stage, values: dict[str, Any]) -> int:
    """Run the stage on every source, write each result to stdout as it is done, and return the exit code."""
    from gdtool.core.runner import Result, Settings, run_all
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
        if isinstance(result, Result):
            done += 1
            emit((_json_of(result) if values["as_json"] else os.fsencode(result.path)) + b"\n")
        else:
            failed.append(report_exception(result, "gdtool"))
    return exit_code(failed, done)


def _json_of(result: Any) -> bytes:
    """Format a result (core.run.Result) as a JSON object."""
    record = {
        "folder": str(result.path),
        "kind": result.kind,
        "status": result.status,
        "seconds": round(result.seconds, 3),
        "skipped": list(result.skipped),
    }
    return json.dumps(record).encode()


def _second_inputs(stage: Stage) -> list[click.Option]:
    """Make the options that name the stage's other inputs."""
    options = []
    for flag in stage.second_inputs:
        second = stage.second(flag)
        where = "; found along the provenance chain without it." if second.search else "."
        text = second.help or f"The {second.kind} to use{where}"
        options.append(click.Option([f"--{flag}", f"second_{flag}"], type=TEXT, metavar="PATH", help=text))
    return options


def _dataset_options() -> list[click.Option]:
    """Make the options that spread many sources over jobs and machines."""
    return [
        click.Option(
            ["--shard"],
            type=TEXT,
            metavar="I/N",
            help="Only every Nth source from the Ith on, for job arrays that share -o: 1/N to N/N.",
        ),
        click.Option(
            ["--ray"],
            type=TEXT,
            metavar="ADDRESS",
            help="Run on the Ray cluster at ADDRESS, each source as a task; local: on this machine's cores. The nodes "
            "need to share the folders. Needs gdtool[ray].",
        ),
    ]


def _run_options(stage: Stage) -> list[click.Option]:
    """Make the options that say how to run, and where the result goes."""
    options = [
        click.Option(
            ["-o", "--output"],
            type=TEXT,
            metavar="DIR",
            help="Output folder; for several sources the parent of NAME.asset/KIND.",
        ),
        click.Option(["-n", "--dry-run"], is_flag=True, help="Print which folders would be made."),
        click.Option(["-f", "--force"], is_flag=True, help="Run even when the result is up to date."),
        click.Option(["--json", "as_json"], is_flag=True, help="Print one JSON object per source."),
        click.Option(["--threads"], type=IntegerRange(0, MOST_THREADS), default=0, help="Threads; 0: all cores."),
    ]
    if stage.networks:
        devices = click.Choice(NETWORK_DEVICES)
        text = "Device that runs the networks."
        options.append(click.Option(["--device"], type=devices, default="cpu", show_default=True, help=text))
    options.append(click.Option(["--log-file"], type=TEXT, metavar="PATH", help=LOG_FILE_HELP))
    return options + [click.Option(list(flags), is_flag=True, help=text) for flags, text in VERBOSITY.items()]
