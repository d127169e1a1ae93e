"""Define `gdtool evaluate`: measure results against a reference, and write the reports to stdout."""

from __future__ import annotations

import json
from typing import Any

import click

from gdtool.core import ending, sources
from gdtool.core.errors import GdtoolError
from gdtool.core.folder import Folder
from gdtool.stages import evaluate as stage

from ._exit import emit, exit_code, report_exception
from ._options import TEXT, build_options, options_from, set_verbosity, verbosity_options
from ._stage_command import help_of

# Groups of figures in the table on a terminal: title, and the beginnings of the names. docs/metrics.md defines each.
GROUPS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("surface protocol", ("surface_",)),
    ("surface protocol, the part that the views see", ("seen_",)),
    ("syncdreamer protocol", ("syncdreamer_",)),
    ("pictures", ("mask_", "color_", "albedo_", "closed_form_", "normal_", "depth_", "roughness_", "metallic_")),
)
UNITS = {"degrees": "°", "psnr": " dB"}  # by a part of a figure's name


def table(report: stage.Report) -> str:
    """Format a report for a reader: name and kind, then the figures in their groups."""
    grouped = {name for name in report for _, prefixes in GROUPS if name.startswith(prefixes)}
    lines = [f"{report['result']} ({report['kind']})"]
    lines += [_row(report, name, name) for name in report if name not in grouped | {"result", "kind"}]
    for title, prefixes in GROUPS:
        names = [name for name in report if name.startswith(prefixes)]
        if names:
            lines.append(title)
            # Under a title with a single prefix the labels go without it.
            lines += [
                _row(report, name, name.removeprefix(prefixes[0]) if len(prefixes) == 1 else name) for name in names
            ]
    return "\n".join(lines)


def _row(report: stage.Report, name: str, label: str) -> str:
    """Format one figure of a report with its label and its unit."""
    value = report[name]
    if isinstance(value, bool):
        text = "yes" if value else "no"
    else:
        text = f"{value:.5g}" if isinstance(value, float) else str(value)
    unit = next((unit for word, unit in UNITS.items() if word in name), "")
    return f"  {label.replace('_', ' '):<24}{text}{unit}"


def _measure(text: str, reference: str | None, views: str | None, options: stage.Options) -> stage.Report:
    """Resolve one result and what it is measured against, and measure it."""
    result = sources.resolve(text, stage.READS, "evaluate")
    truth = sources.resolve(reference, stage.READS, "--reference of evaluate") if reference else None
    views_folder = sources.resolve(views, ("views",), "--views of evaluate") if views else None
    assert views_folder is None or isinstance(views_folder, Folder)
    return stage.evaluate(result, truth, options, views_folder)


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
def command(results: tuple[str, ...], reference: str | None, views: str | None, as_json: bool, **values: Any) -> int:
    """Measure results against a reference and write the figures to stdout."""
    set_verbosity(values["quiet"], values["verbose"], values["log_file"])
    options = build_options(stage.Options, values)
    failed: list[GdtoolError] = []
    done = 0
    for text in sources.incoming(results):
        try:
            report = _measure(text, reference, views, options)
        except Exception as error:
            if ending.received is not None:
                raise
            failed.append(report_exception(error, text))
            continue
        done += 1
        line = json.dumps({"path": text, **report}, allow_nan=False) if as_json else table(report)
        emit(line.encode(errors="surrogateescape") + b"\n")
    return exit_code(failed, done)


command.params[2:2] = options_from(stage.Options)
