"""Tell which objects have roughness and metallic that somebody measured or chose."""

from __future__ import annotations

import numpy as np

from gdtool.core.folder import Folder
from gdtool.evaluation.references import find_truth
from gdtool.folders.models import load_model
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals

AUTHORED_AREA = 0.5  # share of the area with a metallic-roughness texture from which both count as authored


def is_authored(folder: Folder) -> bool:
    """Tell whether roughness and metallic of an object are somebody's measurement or choice, and not a constant.

    So they are where the source has a metallic-roughness texture on at least half of its area, and where the generator
    made it. Factors do not count: in most files they are an exporter's, one pair for a whole pack.
    """
    source = find_truth(folder)
    if isinstance(source, str) and source.startswith("procedural:"):
        return True
    if source is None:
        return False
    scene = load_model(source)
    area = face_normals(TriMesh(scene.vertices, scene.faces))[1]
    textured = np.array([material.metallic_roughness_texture is not None for material in scene.materials])
    return float(area[textured[scene.face_materials]].sum()) >= AUTHORED_AREA * float(area.sum())
