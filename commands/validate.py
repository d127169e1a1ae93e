"""`gdtool validate`: check folders and .glb files against the format."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import click

from gdtool.core import sources
from gdtool.core.errors import InputError, ResourceError
from gdtool.stages import validate as stage

from ._common import help_of, report, report_text, set_verbosity, verbosity_options

SHOWN = 10  # the first faults are enough to start mending


@click.command("validate", help=help_of(stage.__doc__))
@click.argument("paths", metavar="[SOURCES]...", nargs=-1)
@verbosity_options
def command(paths, as_json, quiet, verbose, debug):
    set_verbosity(quiet, verbose)
    code = 0
    for text in sources.incoming(paths):
        try:
            found = list(stage.faults(Path(text)))
        except ResourceError as error:
            report(error)
            code = error.exit_code
            continue
        if found and not code:
            code = InputError.exit_code
        if as_json:
            print(json.dumps({"path": text, "valid": not found, "faults": found}), flush=True)
            continue
        for fault in found[:SHOWN]:
            report_text(fault)
        if len(found) > SHOWN:
            report_text(f"{text}: {len(found) - SHOWN} more faults (--json lists all)")
        if not found:
            sys.stdout.buffer.write(b"valid: " + os.fsencode(text) + b"\n")
            sys.stdout.buffer.flush()
    return code
