"""Run the gdtool command line. Before main() listens to signals, only signals and the list of commands are imported."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import click

# Subcommand: what --help says of it. The module is the name with underscores.
COMMANDS = {
    "render-dataset": "Render ground-truth views of PBR models.",
    "train": "Train the multi-view PBR diffusion model.",
    "sample-views": "Sample six views in six domains from one image.",
    "import-views": "Turn another program's pictures into views.",
    "reconstruct": "Turn views into a closed surface with materials.",
    "remesh": "Turn a surface into quads.",
    "unwrap": "Give a mesh texture coordinates.",
    "bake": "Bake materials into maps; write glTF and OBJ.",
    "relight": "Render an asset under another light.",
    "evaluate": "Measure a result against a reference.",
    "validate": "Check a folder or .glb against its format.",
}


# The variable through which a shell asks for completions, as click names it.
COMPLETION = "_GDTOOL_COMPLETE"


def _cli() -> click.Command:
    """Import the group of all commands."""
    from ._group import cli

    return cli


def main(load: Callable[[], click.Command] = _cli) -> None:
    """Run the click command that load() returns, and exit with one of the documented codes.

    load() may import anything.
    """
    _open_streams()
    # Files that a umask would close to their own user could not be finished, nor removed.
    os.umask(os.umask(0o077) & 0o077)
    # Threads that wait for one another by spinning take ten times as long where something else has one of the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from gdtool.core import ending

    ending.listen()  # before click and all else: Ctrl-C is quiet from the start
    try:
        from ._exit import guarded

        command = load()
        if COMPLETION in os.environ:
            from click.shell_completion import shell_complete

            sys.exit(shell_complete(command, {}, "gdtool", COMPLETION, os.environ[COMPLETION]))
    except BaseException as error:
        if ending.received is not None:
            sys.exit(128 + ending.received)
        if not isinstance(error, Exception) or "--debug" in sys.argv:
            raise
        from gdtool.core import errors, log

        problem = errors.from_exception(error, "gdtool")
        log.line(str(problem))
        sys.exit(problem.exit_code)
    guarded(command)


def _open_streams() -> None:
    """Open /dev/null in place of standard streams that the caller closed.

    Otherwise the next file that is opened gets the number of a standard stream, and output could be written into it.
    """
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
        if number and getattr(sys, name) is None:
            setattr(sys, name, open(number, "w", encoding="utf-8", errors="backslashreplace", closefd=False))  # noqa: SIM115 - for the whole run
