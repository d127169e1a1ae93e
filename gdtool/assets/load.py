"""Read a model of any format that gdtool knows, and check it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.core.errors import InputError
from gdtool.core.memory import require_memory
from gdtool.core.reading import require_regular_file
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.vectors import cross, dot

_CHUNK = 2**14  # faces checked at once: their temporary arrays fit the processor's cache
_MAX_SEED_DIGITS = 19  # of a 64-bit integer
_MAX_EXTENT = 1e100  # in the file's units; products of larger coordinates overflow float64
_MIN_AREA_SQUARED = 1e-32  # of (twice a face's area)², in a unit box: below it the area is rounding error
# Peak bytes of reading for each byte of the file, arrays included: measured on grids of 90,000 vertices, as text where
# that takes more. glTF and OBJ are predicted by their own readers (gltf/geometry_size.py, obj/lines.py).
_HELD_PER_BYTE = {".ply": 17, ".stl": 8}
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")


def load_scene(source: str | Path) -> Scene:
    """Read a model: .glb, .gltf, .obj (with .mtl), .ply or .stl, or generate the object of "procedural:SEED".

    The scene has at least one face with an area, finite coordinates, and indices in range. Raises InputError,
    OutputError, ResourceError.
    """
    if isinstance(source, str) and source.startswith("procedural:"):
        from gdtool.assets.procedural import generate

        seed = source.removeprefix("procedural:")
        if not (seed.isascii() and seed.isdigit() and len(seed) <= _MAX_SEED_DIGITS):
            raise InputError(
                source,
                f"is not procedural:SEED, a number of at most {_MAX_SEED_DIGITS} digits",
                "name it like procedural:7",
            )
        return replace(generate(int(seed)), name="procedural-" + seed.zfill(6))
    path = Path(source)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES and not path.is_dir():
        raise InputError(path, f"is not a model that gdtool reads ({', '.join(SUFFIXES)})", "export it as .glb")
    require_regular_file(path)
    require_memory(
        path.stat().st_size * _HELD_PER_BYTE.get(suffix, 1),
        path,
        "its content",
        "simplify it or split it into several files",
    )
    if suffix in (".glb", ".gltf"):
        from gdtool.assets.gltf.read import read_gltf as read
    elif suffix == ".obj":
        from gdtool.assets.obj.read import read_obj as read
    else:
        from gdtool.assets.ply_stl.read import read_ply_or_stl as read
    return _checked(read(path), path)


def _checked(scene: Scene, path: Path) -> Scene:
    """Remove faces with two coincident corners, and mend normals. Raises InputError for what no stage can work on.

    Faces whose three distinct corners lie on a line stay: they close the mesh where edges meet in a T.
    """
    if not len(scene.faces):
        raise InputError(path, "has no faces", "export the model with its faces")
    if scene.faces.min() < 0 or scene.faces.max() >= len(scene.vertices):
        raise InputError(
            path,
            f"a face refers to a vertex out of range (there are {len(scene.vertices)})",
            "export it again with all its vertices",
        )
    is_used = np.zeros(len(scene.vertices), bool)
    is_used[scene.faces] = True
    used = scene.vertices[is_used]
    if not np.isfinite(used).all():
        raise InputError(
            path,
            f"vertex {int(np.argwhere(~np.isfinite(scene.vertices))[0][0])} is not finite",
            "remove that vertex or move it to a finite place",
        )
    low, high = used.min(0), used.max(0)
    extent = float((high - low).max())
    if not np.isfinite(extent) or extent > _MAX_EXTENT:
        raise InputError(path, f"is {extent:.3g} units large", "scale it down")
    if extent == 0:
        raise InputError(
            path, "has all its vertices in one point", "export it at a scale that its file format can hold"
        )
    empty, has_area = _degenerate((scene.vertices - low) / extent, scene.faces)
    if not has_area:
        raise InputError(path, "has only faces without area", "export it with faces that have an area")
    if empty.any():
        scene = replace(
            scene,
            faces=scene.faces[~empty],
            material_idx=scene.face_materials[~empty],
            notes=(*scene.notes, f"{int(empty.sum())} faces with two corners in one place are left out"),
        )
    return _with_sound_normals(scene)


def _degenerate(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, bool]:
    """Find the faces (f,) with two corners in one place, and whether any face has an area.

    vertices (v, 3) fill a unit box.
    """
    rows = np.ascontiguousarray(vertices.T)  # several times faster than an array of corners (f, 3, 3)
    empty, has_area = np.empty(len(faces), bool), False
    for i in range(0, len(faces), _CHUNK):
        a, b, c = (rows.take(corner, 1) for corner in np.ascontiguousarray(faces[i : i + _CHUNK].T))
        empty[i : i + _CHUNK] = (a == b).all(0) | (b == c).all(0) | (c == a).all(0)
        if not has_area:
            normal = cross(b - a, c - a)
            has_area = bool((dot(normal, normal) > _MIN_AREA_SQUARED).any())
    return empty, has_area


def _with_sound_normals(scene: Scene) -> Scene:
    """Replace vertex normals shorter than 0.5, which should be unit vectors, by those of the faces."""
    if scene.normals is None:
        return scene
    bad = np.linalg.norm(scene.normals, axis=1) < 0.5
    bad[np.setdiff1d(np.arange(len(bad)), scene.faces)] = False
    if not bad.any():
        return scene
    from gdtool.geometry.normals import vertex_normals

    normals = scene.normals.copy()
    normals[bad] = vertex_normals(TriMesh(scene.vertices, scene.faces))[bad]
    return replace(
        scene,
        normals=normals,
        notes=(*scene.notes, f"{int(bad.sum())} normals without a direction are replaced by the faces'"),
    )
