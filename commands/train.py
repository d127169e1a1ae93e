"""Define `gdtool train`; its options and help come from the stage.

It adds --plan. Started by torchrun, the first process runs the command and the others follow it.
"""

import os

import click

from gdtool.stages import train as stage

from ._options import build_options
from ._stage_command import help_of, stage_command

command = stage_command(stage.STAGE, help=help_of(stage))
command.params.append(
    click.Option(
        ["--plan"],
        is_flag=True,
        help="Print the memory, FLOPs and time that the training needs, computed from its structure; reads no data.",
    )
)
assert command.callback is not None
_train = command.callback


def _invoke(*, plan: bool, **values):
    """Plan the training, run it, or take part in it as a later process of torchrun."""
    if plan:
        click.echo(stage.plan(build_options(stage.Options, values), values["as_json"]))
        return 0
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return _train(**values)
    if os.environ.get("RANK", "0") != "0":
        stage.follow(values["threads"])
        return 0
    code = _train(**values)
    if code == 0:  # after a failure torchrun ends the others
        stage.dismiss()
    return code


command.callback = _invoke
