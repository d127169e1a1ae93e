"""Load the scene of a textured model: an asset folder, a model file, or a generated object."""

from __future__ import annotations

from gdtool.assets.load import load_scene
from gdtool.assets.scene import Scene
from gdtool.core.folder import Folder
from gdtool.core.sources import Source


def load_model(source: Source) -> Scene:
    """Load the .glb of an asset folder, a model file, or procedural:SEED. Raises InputError."""
    return load_scene(source.file("asset.glb") if isinstance(source, Folder) else source)
