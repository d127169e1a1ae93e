"""Render previews of texture coordinates: the layout of the charts, and the mesh under a checkerboard."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.geometry.uv_raster import rasterize_uv
from gdtool.unwrap.pipeline import corner_triangles

_CHECKS = 32  # squares of the checkerboard along the side of the texture


def _colors(count: int) -> np.ndarray:
    """Make (count, 3) distinct light colours: hues a golden ratio apart."""
    hue = (np.arange(count) * 0.618034) % 1
    return 0.62 + 0.3 * np.cos(2 * np.pi * (hue[:, None] + np.array([0, 1 / 3, 2 / 3])))


def layout(faces: np.ndarray, uv: np.ndarray, face_uvs: np.ndarray, chart: np.ndarray, size: int = 1024) -> np.ndarray:
    """Render the charts (size, size, 3) in [0, 1]: a colour for each chart, a shade for each face, white elsewhere."""
    _, face_idx = triangulated(faces)
    owner, _ = rasterize_uv(uv, corner_triangles(face_uvs, face_idx), size)
    face = np.where(owner >= 0, face_idx[owner], -1)
    colors = _colors(int(chart.max()) + 1)
    shade = 0.9 + 0.1 * ((np.arange(len(faces)) * 2654435761 >> 9) % 5) / 4
    out = np.where((face >= 0)[..., None], colors[chart[face]] * shade[face][..., None], 1.0)
    label = np.where(face >= 0, chart[face], -1)
    rim = np.zeros(label.shape, bool)
    for axis in (0, 1):
        differ = np.diff(label, axis=axis) != 0
        rim[(slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))] |= differ
    out[rim] = 0.15
    return out


def checkerboard(mesh: QuadMesh, chart: np.ndarray, size: int = 512) -> np.ndarray:
    """Render the mesh (size, 2 size, 3) in [0, 1] under a checkerboard, seen from front right and from back left.

    mesh: with texture coordinates. chart (f,): the chart of each face, which tints it.
    """
    from gdtool.cameras import rays, rig
    from gdtool.geometry.normals import face_normals
    from gdtool.geometry.rays import RayCaster

    vertices, (triangles, face_idx) = mesh.vertices, mesh.triangulation
    uv, face_uvs = mesh.texture_coordinates()
    corners = corner_triangles(face_uvs, face_idx)
    middle, extent = (vertices.min(0) + vertices.max(0)) / 2, float(np.ptp(vertices, 0).max()) or 1.0
    centred = TriMesh((vertices - middle) / extent, triangles)
    caster, normals = RayCaster(centred), face_normals(centred)[0]
    colors = _colors(int(chart.max()) + 1)
    six = {camera.name: camera for camera in rig("six", size)}
    pictures = []
    for name in ("front_right", "left"):
        origins, directions = (x.reshape(-1, 3) for x in rays(six[name]))
        hits = caster.first_hit(origins, directions)
        seen = hits.face_idx >= 0
        face = hits.face_idx[seen]
        at = np.einsum("nc,ncd->nd", hits.barycentric[seen], uv[corners[face]])
        check = np.floor(at * _CHECKS).sum(1) % 2
        light = 0.35 + 0.65 * np.abs((normals[face] * directions[seen]).sum(1))
        picture = np.ones((size * size, 3))
        picture[seen] = colors[chart[face_idx[face]]] * (0.45 + 0.55 * check)[:, None] * light[:, None]
        pictures.append(picture.reshape(size, size, 3))
    return np.concatenate(pictures, 1)
