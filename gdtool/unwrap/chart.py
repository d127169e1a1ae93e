"""The flat chart that segmenting, flattening and packing pass on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Chart(NamedTuple):
    """Faces of a mesh, flattened together.

    faces_idx (k,): the faces of the mesh. corners (k, 4): their corners as rows of uv, -1 as a triangle's fourth
    corner. uv (c, 2): coordinates at the scale of the surface, v up. triangles (t, 3): the faces cut into triangles of
    uv.
    """

    faces_idx: np.ndarray
    corners: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray
