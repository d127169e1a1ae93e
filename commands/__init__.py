"""The gdtool command line: a group that imports a command only when it is named."""

from __future__ import annotations

import importlib
import os

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


class LazyGroup(click.Group):
    """Commands of COMMANDS and of the entry point group gdtool.commands, each loaded when it is asked for."""

    def list_commands(self, ctx):
        return [*COMMANDS, *sorted(set(_plugins()) - set(COMMANDS))]

    def get_command(self, ctx, name):
        if name in COMMANDS:
            return importlib.import_module("." + name.replace("-", "_"), __name__).command
        plugin = _plugins().get(name)
        return plugin.load() if plugin else None

    def format_commands(self, ctx, formatter):
        plugins = {name: "(plugin)" for name in _plugins() if name not in COMMANDS}
        with formatter.section("Commands"):
            formatter.write_dl(list((COMMANDS | plugins).items()))


def _plugins():
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group="gdtool.commands")}


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="gdtool")
def cli():
    """One image, or one PBR model, to an engine-ready 3D asset.

    Each command reads folders and writes a folder, and prints its path: so commands form pipes.

    \b
    gdtool sample-views cat.png | gdtool reconstruct | gdtool remesh | gdtool unwrap | gdtool bake | gdtool relight
    """


def main():
    """Run the command line and exit with one of its documented codes."""
    from ._common import guarded

    # Threads that wait for one another by spinning take ten times as long where something else has one of the cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    guarded(cli)
