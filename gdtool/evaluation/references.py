"""Find what a result can be measured against: a model file, a generated object, or a folder."""

from __future__ import annotations

from pathlib import Path

from gdtool.assets.load import SUFFIXES
from gdtool.core.folder import Folder
from gdtool.core.kinds import ViewsContent
from gdtool.core.provenance import ancestors, origins
from gdtool.core.sources import Source

MODEL = "model"  # the kind of a source that is a model file or procedural:SEED

CURE = "name what to measure against with --reference"


def kind_of(source: Source | None) -> str:
    """Return the kind of a folder, "model" for a model file or a generated object, and "" for None."""
    if isinstance(source, Folder):
        return source.kind
    return "" if source is None else MODEL


def path_of(source: Source) -> Path | str:
    """Return the path that messages name a source by."""
    return source.path if isinstance(source, Folder) else source


def has_material(source: Source) -> bool:
    """Tell whether a source has materials that views can be compared with; a mesh file may have none."""
    return kind_of(source) in ("asset", "surface", MODEL)


def holds_model(source: Source) -> bool:
    """Tell whether a source is a views folder that carries the model it shows."""
    return isinstance(source, Folder) and source.kind == "views" and source.content_as(ViewsContent).model


def find_truth(result: Source) -> Source | None:
    """Find the model that a result was made from, along its provenance chain.

    It is procedural:SEED, a model file, or a views folder that carries its model; None where there is none. Raises
    InputError where a file or a folder on the way was replaced since.
    """
    if not isinstance(result, Folder):
        return None
    chain = [result, *ancestors(result, CURE)]
    for folder in chain:
        generated = next((entry.path for entry in folder.manifest.inputs if entry.path.startswith("procedural:")), None)
        if generated:
            return generated
        for origin in origins(folder):
            if origin.path.suffix.lower() in SUFFIXES and origin.path.is_file():
                origin.require_same(CURE)
                return origin.path
    return next((folder for folder in chain if holds_model(folder)), None)


def source_of_shape(reference: Source) -> Source | None:
    """Return the source of the triangles that a shape is compared with; None where there is none.

    reference: a model, or a folder of views. Views have no triangles: their model is taken, which is either stored in
    the folder or the one that they were rendered from.
    """
    if kind_of(reference) == "renders":
        return None
    if kind_of(reference) != "views" or holds_model(reference):
        return reference
    return find_truth(reference)
