"""`gdtool evaluate`: measure results against a reference; reports go to stdout."""

from __future__ import annotations

import json

import click

from gdtool.core import ending, sources
from gdtool.core.folder import Folder
from gdtool.stages import evaluate as stage

from ._common import TEXT, build_options, emit, exit_code, help_of, options_from, set_verbosity, tell, verbosity_options


def _one(text, reference, views, options):
    found = sources.resolve(text, stage.READS, "evaluate")
    against = sources.resolve(reference, stage.READS, "--reference of evaluate") if reference else None
    rig = sources.resolve(views, ("views",), "--views of evaluate") if views else None
    assert rig is None or isinstance(rig, Folder)
    return stage.evaluate(found, against, options, rig)


@click.command("evaluate", help=help_of(stage))
@click.argument("results", metavar="[RESULTS]...", nargs=-1, type=TEXT)
@click.option(
    "--reference",
    type=TEXT,
    metavar="PATH",
    help=(
        "What to measure against: a folder, a model file or procedural:SEED; found along the provenance chain "
        "without it."
    ),
)
@click.option(
    "--views",
    "--cameras",
    "views",
    type=TEXT,
    metavar="VIEWS",
    help="Views that the result was made from; found along the provenance chain without it.",
)
@verbosity_options
def command(results, reference, views, as_json, log_file, quiet, verbose, debug, **values):
    """Measure results against a reference and write the figures to stdout."""
    set_verbosity(quiet, verbose, log_file)
    options = build_options(stage.Options, values)
    failed, done = [], 0
    for text in sources.incoming(results):
        try:
            found = _one(text, reference, views, options)
        except Exception as error:
            if ending.received is not None:
                raise
            failed.append(tell(error, text))
            continue
        done += 1
        line = json.dumps({"path": text, **found}, allow_nan=False) if as_json else stage.table(found)
        emit(line.encode(errors="surrogateescape") + b"\n")
    return exit_code(failed, done)


command.params[2:2] = options_from(stage.Options)
