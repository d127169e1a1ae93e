"""`gdtool evaluate`: measure results against a reference; reports go to stdout."""

from __future__ import annotations

import json

import click

from gdtool.core import sources
from gdtool.core.errors import GdtoolError, from_os_error
from gdtool.stages import evaluate as stage

from ._common import build_options, help_of, options_from, report, set_verbosity, verbosity_options


def _one(text, reference, views, options):
    found = sources.resolve(text, stage.READS, "evaluate")
    against = sources.resolve(reference, stage.READS, "--reference of evaluate") if reference else None
    rig = sources.resolve(views, ("views",), "--views of evaluate") if views else None
    return stage.evaluate(found, against, options, rig)


@click.command("evaluate", help=help_of(stage.__doc__))
@click.argument("results", metavar="[RESULTS]...", nargs=-1)
@click.option("--reference", metavar="PATH", help="What to measure against: a folder, a model file or procedural:SEED; found along the provenance chain without it.")
@click.option("--views", "--cameras", "views", metavar="VIEWS", help="Views that the result was made from; found along the provenance chain without it.")
@verbosity_options
def command(results, reference, views, as_json, quiet, verbose, debug, **values):
    set_verbosity(quiet, verbose)
    options = build_options(stage.Options, values)
    failed, done = [], 0
    for text in sources.incoming(results):
        try:
            found = _one(text, reference, views, options)
        except (GdtoolError, OSError) as error:
            if debug:
                raise
            failed.append(error if isinstance(error, GdtoolError) else from_os_error(error, text))
            report(failed[-1])
            continue
        done += 1
        line = json.dumps({"path": text, **found}, allow_nan=False) if as_json else stage.table(found)
        click.echo(line.encode(errors="surrogateescape"))
    codes = {error.exit_code for error in failed}
    return 0 if not failed else codes.pop() if not done and len(codes) == 1 else 1


command.params[2:2] = options_from(stage.Options)
