"""gdtool: from one image to a PBR 3D asset, as independent subcommands over a documented folder format."""

__version__ = "0.1.0"
