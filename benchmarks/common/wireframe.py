"""Draw quad meshes with their edges."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.geometry.meshes import QuadMesh, TriMesh

ZOOMED = 1.2  # half widths of the model: the middle only, since with more of it the quads cannot be told apart


def wireframe(vertices: np.ndarray, faces: np.ndarray, size: int = 420, half_widths: float = ZOOMED) -> np.ndarray:
    """Draw a mesh with its edges, seen from front right and above; returns (size, size, 3) in [0, 1].

    vertices (v, 3), faces (f, 4), -1 as a triangle's fourth corner. half_widths: width of the picture, in half widths
    of the model.
    """
    from gdtool.geometry.mesh_quality import polygon_normals
    from gdtool.geometry.rays import RayCaster
    from gdtool.geometry.topology import triangulated

    centre, diagonal = (vertices.max(0) + vertices.min(0)) / 2, float(np.linalg.norm(np.ptp(vertices, 0)))
    back = np.array([0.5, 0.45, 0.75])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    middle, size = size, 2 * size  # four rays a pixel
    scale = half_widths * max(np.abs((vertices - centre) @ right).max(), np.abs((vertices - centre) @ up).max())
    line = ((np.arange(size) + 0.5) / size - 0.5) * scale
    origins = centre + back * diagonal + (line[None, :, None] * right - line[:, None, None] * up)
    triangles, face_idx = triangulated(faces)
    hits = RayCaster(TriMesh(vertices, triangles.astype(np.int64))).first_hit(
        origins.reshape(-1, 3), np.broadcast_to(-back, (size * size, 3)).copy()
    )
    hit_idx = np.flatnonzero(hits.face_idx >= 0)
    face = face_idx[hits.face_idx[hit_idx]]
    point = origins.reshape(-1, 3)[hit_idx] - back * hits.distance[hit_idx][:, None]
    corners = vertices[np.where(faces[face] < 0, faces[face][:, :1], faces[face])]
    after = np.roll(corners, -1, 1)
    along = after - corners
    share = np.clip(((point[:, None] - corners) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-300), 0, 1)
    far = np.linalg.norm(corners + share[..., None] * along - point[:, None], axis=-1).min(1)
    light = 0.35 + 0.6 * np.clip(polygon_normals(QuadMesh(vertices, faces))[0][face] @ np.array([0.2, 0.7, 0.68]), 0, 1)
    ink = far > 0.9 * scale / size
    out = np.ones((size * size, 3))
    out[hit_idx] = (light * (0.25 + 0.75 * ink))[:, None] * [0.95, 0.97, 1.0]
    return out.reshape(middle, 2, middle, 2, 3).mean((1, 3))


def sheet(pictures: Path, models: list[str], ways: list[str], target: Path) -> None:
    """Write the pictures <model>_<way>.png of a folder as one table: models down, methods ("ways") across.

    It has 48 colours, for a third of the bytes.
    """
    from PIL import Image

    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import read_image

    def picture(model: str, way: str):
        path = pictures / file_name(model, way)
        return read_image(path)[..., :3].astype(np.float32) / 255 if path.exists() else None

    rows = [[picture(model, way) for way in ways] for model in models]
    used = [i for i, row in enumerate(rows) if any(image is not None for image in row)]
    if used:
        table = contact_sheet([rows[i] for i in used], ways, [models[i] for i in used])
        Image.fromarray(table).quantize(48).save(target, optimize=True)


def file_name(model: str, way: str) -> str:
    """Return the file name of the picture of a model by a method, without spaces, commas and apostrophes."""
    return f"{model}_{way}".replace(" ", "-").replace(",", "").replace("'", "") + ".png"
