"""Define `gdtool sample-views`; its options and help come from the stage.

The source may also be named by its view, as in --front a.png --back b.png.
"""

from collections.abc import Callable
from typing import Any

from gdtool.core.kinds import VIEW_NAMES
from gdtool.stages import sample_views as stage

from ._stage_command import help_of, stage_command

command = stage_command(stage.STAGE, help=help_of(stage))
_run: Callable[..., Any] | None = command.callback


def run_with_first_picture(**values: Any) -> int:
    """Take the first of the pictures that are named by their view as the source, where no source is given."""
    named = [name for name in VIEW_NAMES if values.get(name) is not None]
    if not values["sources"] and named:
        values |= {"sources": (values[named[0]],), "view": named[0], named[0]: None}
    assert _run is not None  # stage_command gives it one
    return _run(**values)


command.callback = run_with_first_picture
