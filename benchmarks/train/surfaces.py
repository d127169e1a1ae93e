"""Measure the surfaces that reconstruct makes of sampled views, and the inflated silhouette as it is."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path

from benchmarks.common.measure import Failed, evaluate, gdtool
from benchmarks.train.inflate import inflated
from benchmarks.train.makers import BaselineMaker, Held, Maker, ModelMaker, picture_of
from gdtool.assets.gltf.write import write_glb

KEYS = ("surface_distance", "surface_f_score", "surface_iou", "surface_normal_degrees")


def chosen(objects: list[Held], count: int) -> list[Held]:
    """Choose `count` objects by their names' hashes: a larger number keeps those of a smaller one."""
    return sorted(objects, key=lambda held: hashlib.sha1(held.name.encode()).hexdigest())[:count]


def surface_row(maker: Maker, held: Held) -> dict | None:
    """Return the figures of an object's surface, or why there are none; None for a way that has no surface."""
    with tempfile.TemporaryDirectory() as work:
        try:
            if isinstance(maker, ModelMaker):
                surface = Path(work, "surface")
                gdtool("reconstruct", maker.views_folder(held), "-o", surface, "--quiet")
            elif isinstance(maker, BaselineMaker) and maker.kind == "inflated":
                surface = Path(work, "inflated.glb")
                write_glb(surface, inflated(picture_of(held.views())))
            else:
                return None
            # The result lies in the frame of the views, where the object fills the unit box.
            found = evaluate(
                surface, "--reference", held.folder.path, "--no-render", "--no-syncdreamer", "--frame", "box"
            )
            return {"figures": {key: found[key] for key in KEYS if key in found}}
        except Failed as error:
            return {"failed": str(error)}
