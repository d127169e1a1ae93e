"""Define the group of all commands, which imports a command only when it is named."""

from __future__ import annotations

import importlib

import click

from gdtool.core.errors import ResourceError, first_line

from . import COMMANDS

# Not the docstring of cli(): python -OO has none.
HELP = """One image, or one PBR model, to an engine-ready 3D asset.

    Each command reads folders and writes a folder, and prints its path: so commands form pipes.

    \b
    gdtool sample-views cat.png | gdtool reconstruct | gdtool remesh | gdtool unwrap | gdtool bake | gdtool relight
    """


class LazyGroup(click.Group):
    """Find commands in COMMANDS and in the entry point group gdtool.commands, and load them on demand."""

    def list_commands(self, ctx):
        """List gdtool's commands, then those of plugins."""
        return [*COMMANDS, *sorted(set(_plugins()) - set(COMMANDS))]

    def get_command(self, ctx, name):
        """Load a command; None for an unknown name."""
        if name in COMMANDS:
            return importlib.import_module("." + name.replace("-", "_"), __package__).command
        plugin = _plugins().get(name)
        return _loaded(plugin) if plugin else None

    def format_commands(self, ctx, formatter):
        """Write the section of the help that lists the commands, without loading them."""
        plugins = {name: "(plugin)" for name in _plugins() if name not in COMMANDS}
        with formatter.section("Commands"):
            formatter.write_dl(list((COMMANDS | plugins).items()))


def _plugins():
    """Find the entry points of plugins by name."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group="gdtool.commands")}


def _loaded(plugin) -> click.Command:
    """Load the command of an entry point. Raises ResourceError where it cannot be imported or is no command."""
    package = plugin.dist.name if plugin.dist is not None else plugin.module
    cure = f"pip uninstall {package}, or install a release of it that works with this gdtool"
    try:
        command = plugin.load()
    except (Exception, SystemExit) as error:  # a plugin's module may raise anything
        raise ResourceError(
            f"plugin {plugin.name}", f"cannot be loaded ({type(error).__name__}: {first_line(error)})", cure
        ) from error
    if not isinstance(command, click.Command):
        raise ResourceError(f"plugin {plugin.name}", f"{plugin.value} is no click command", cure)
    return command


@click.group(
    cls=LazyGroup, help=HELP, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}
)
@click.version_option(package_name="gdtool")
def cli():
    pass
