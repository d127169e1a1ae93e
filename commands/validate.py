"""Define `gdtool validate`: check folders and .glb files against the format."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click

from gdtool.core import ending, sources
from gdtool.core.errors import InputError
from gdtool.stages import validate as stage

from ._exit import emit, report_exception, report_text
from ._options import TEXT, set_verbosity, verbosity_options
from ._stage_command import help_of

SHOWN = 10  # the first faults are enough to start mending


@click.command("validate", help=help_of(stage))
@click.argument("paths", metavar="[SOURCES]...", nargs=-1, type=TEXT)
@verbosity_options
def command(paths, as_json, log_file, quiet, verbose, debug):
    """Check each source and return the exit code."""
    set_verbosity(quiet, verbose, log_file)
    code = 0
    for text in sources.incoming(paths):
        try:
            faults = list(stage.faults(Path(text)))
        except Exception as error:  # the path could not be checked, which says nothing of its validity
            if ending.received is not None:
                raise
            code = report_exception(error, text).exit_code
            continue
        if faults and not code:
            code = InputError.exit_code
        if as_json:
            emit(json.dumps({"path": text, "valid": not faults, "faults": faults}).encode() + b"\n")
            continue
        for fault in faults[:SHOWN]:
            report_text(fault)
        if len(faults) > SHOWN:
            report_text(f"{text}: {len(faults) - SHOWN} more faults (--json lists all)")
        if not faults:
            emit(b"valid: " + os.fsencode(text) + b"\n")
    return code
