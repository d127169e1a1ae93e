"""PLY and STL into a Scene, through trimesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.scene import DEFAULT_MATERIAL, Scene
from gdtool.core.errors import InputError, from_os_error


def read_scan(path: str | Path) -> Scene:
    """Read a .ply or .stl: vertices, faces, and of PLY normals and vertex colours (taken as sRGB).

    The material is DEFAULT_MATERIAL (a dielectric of roughness 0.5), white under vertex colours. STL's vertices, which
    repeat for each face, are welded where they are equal. Raises InputError.
    """
    path = Path(path)
    kind = path.suffix.lower()[1:]
    try:
        with open(path, "rb") as file:
            mesh = _load(file, kind, path)
    except FileNotFoundError:
        raise InputError(path, "does not exist") from None
    except OSError as error:
        raise from_os_error(error, path) from None
    faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
    if not len(faces):
        raise InputError(path, "has no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(path, f"a face refers to a vertex out of range (there are {len(vertices)})")
    notes = ["has no material: a dielectric of roughness 0.5"]
    if kind == "stl":
        if not np.isfinite(vertices).all():
            raise InputError(path, "has a vertex that is not finite")
        vertices, index = np.unique(vertices + 0.0, axis=0, return_inverse=True)  # + 0.0: -0 is 0
        return Scene(vertices, index.reshape(-1)[faces].astype(np.int32), name=path.stem, notes=tuple(notes))
    material, colors = DEFAULT_MATERIAL, None
    if mesh.visual.kind == "vertex":
        from gdtool.images.color import linear_from_srgb, unit_range

        stored = unit_range(np.asarray(mesh.visual.vertex_colors)).astype(np.float64)
        colors = np.concatenate([linear_from_srgb(stored[:, :3]), stored[:, 3:]], 1)
        material = replace(material, base_color=(1.0, 1.0, 1.0, 1.0))
    elif mesh.visual.kind == "face":
        notes.append("colors of faces are ignored")
    stored = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    normals = None
    names = getattr(getattr(stored, "dtype", None), "names", None) or (stored if isinstance(stored, dict) else ())
    if all(key in names for key in ("nx", "ny", "nz")):
        given = np.stack([np.asarray(stored[key], np.float64).reshape(-1) for key in ("nx", "ny", "nz")], 1)
        length = np.linalg.norm(given, axis=1, keepdims=True)
        if len(given) == len(vertices) and np.isfinite(given).all() and (length > 1e-6).all():
            normals = given / length
        else:
            notes.append("normals without a direction are ignored")
    return Scene(vertices, faces.astype(np.int32), (material,), normals=normals, colors=colors, name=path.stem, notes=tuple(notes))


def _load(file, kind: str, path: Path):
    import trimesh

    try:
        mesh = trimesh.load(file, file_type=kind, process=False, force="mesh")
    except OSError:
        raise
    except Exception as error:  # the parsers raise whatever the malformed bytes lead to
        raise InputError(path, f"is not a {kind.upper()} file that can be read ({type(error).__name__}: {str(error)[:60]})") from None
    if not hasattr(mesh, "faces"):
        raise InputError(path, "has no faces")
    return mesh
