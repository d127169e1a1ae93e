"""Read the input of remesh and unwrap: a folder, or a mesh file, brought into the unit box."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.sources import Source
from gdtool.core.stage import Inputs, Output

if TYPE_CHECKING:
    from gdtool.assets.scene import Scene

# Bounds of a mesh's longest side, in its own units: its square and cube are still finite float64 numbers, not 0.
_MIN_EXTENT, _MAX_EXTENT = 1e-150, 1e150


def source_path(inputs: Inputs) -> Path | str:
    """Return the path that messages name the source by."""
    return inputs.main.path if isinstance(inputs.main, Folder) else inputs.main


def read_triangles(inputs: Inputs, out: Output):
    """Read a surface folder or a mesh file as triangles in the unit box.

    Returns vertices (v, 3), triangles (t, 3), source_from_world (4, 4), and quads (q, 4) of a source that is all quads,
    else None.
    """
    import numpy as np

    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
    from gdtool.geometry.meshes import QuadMesh, TriMesh
    from gdtool.geometry.repair import check
    from gdtool.geometry.topology import compact

    main, quads = inputs.main, None
    if isinstance(main, Folder):
        from gdtool.folders.surface import read_surface

        surface = read_surface(main)
        matrix = np.array(main.content.source_from_world).reshape(4, 4)
        return surface.vertices, surface.faces.astype(np.int64), matrix, None
    if _is_obj(main):
        from gdtool.folders.mesh import read_obj
        from gdtool.geometry.topology import triangulated

        mesh = read_obj(main)
        vertices, faces = mesh.vertices, triangulated(mesh.faces)[0].astype(np.int64)
        if (mesh.faces >= 0).all():
            quads = mesh.faces.astype(np.int64)
    else:
        scene = _load_scene(inputs, out)
        vertices, faces = scene.vertices, scene.faces.astype(np.int64)
    check(TriMesh(vertices, faces), source_path(inputs))
    compacted = compact(TriMesh(vertices, faces))
    _require_extent(float(np.ptp(compacted.vertices, 0).max()), inputs)
    matrix = unit_box(compacted.vertices)
    if quads is not None:
        quads = compact(QuadMesh(vertices, quads)).faces
    return transform_points(invert_similarity(matrix), compacted.vertices), compacted.faces, matrix, quads


def read_quad_mesh(inputs: Inputs, out: Output):
    """Read a mesh folder or a mesh file, with its texture coordinates where it has some.

    Returns the QuadMesh in the unit box, without faces that have no area or a repeated corner, and source_from_world
    (4, 4).
    """
    import numpy as np

    from gdtool.folders.mesh import read_mesh, read_obj
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
    from gdtool.geometry.meshes import QuadMesh

    main = inputs.main
    if isinstance(main, Folder):
        mesh, matrix = read_mesh(main), np.array(main.content.source_from_world).reshape(4, 4)
    else:
        mesh, matrix = read_obj(main) if _is_obj(main) else _scene_as_mesh(inputs, out), None
    if not np.isfinite(mesh.vertices).all():
        raise InputError(
            source_path(inputs),
            f"vertex {int(np.argmin(np.isfinite(mesh.vertices).all(1)))} is not finite",
            "run gdtool remesh on the model it was made from",
        )
    used = np.unique(mesh.faces[mesh.faces >= 0])
    _require_extent(float(np.ptp(mesh.vertices[used], 0).max()) if len(used) else 0.0, inputs)
    if matrix is None:
        matrix = unit_box(mesh.vertices[used])
        mesh = QuadMesh(transform_points(invert_similarity(matrix), mesh.vertices), mesh.faces, mesh.uv, mesh.face_uvs)
    return _without_degenerate(mesh, inputs, out), matrix


def _is_obj(source: Source) -> TypeGuard[Path]:
    """Tell whether a source is an OBJ file, whose quads are kept."""
    return isinstance(source, Path) and source.suffix.lower() == ".obj"


def _load_scene(inputs: Inputs, out: Output) -> Scene:
    """Load any mesh file or generated object, with the warnings of its reader."""
    from gdtool.assets.load import load_scene

    assert not isinstance(inputs.main, Folder)
    scene = load_scene(inputs.main)
    for text in scene.notes:
        out.warn(f"{inputs.name}: {text}")
    return scene


def _require_extent(extent: float, inputs: Inputs) -> None:
    """Raise InputError for a mesh too small or too large to compute with."""
    if not _MIN_EXTENT < extent < _MAX_EXTENT:
        raise InputError(
            source_path(inputs), f"its longest side is {extent:g}, which cannot be computed with", "scale it to about 1"
        )


def _scene_as_mesh(inputs: Inputs, out: Output):
    """Read the triangles of any mesh file, and merge the vertices that differ in their texture coordinates only."""
    import numpy as np

    from gdtool.geometry.meshes import QuadMesh
    from gdtool.geometry.unique_rows import unique_rows

    scene = _load_scene(inputs, out)
    if not len(scene.faces):
        raise InputError(source_path(inputs), "has no faces", "name a file with a mesh, not points or lines")
    vertices, _, merged = unique_rows(scene.vertices)
    filler = np.full((len(scene.faces), 1), -1, np.int32)
    corners = np.concatenate([scene.faces, filler], 1).astype(np.int32)
    uv = scene.uvs[0] if scene.uvs else None
    return QuadMesh(
        vertices, np.concatenate([merged[scene.faces], filler], 1).astype(np.int32), uv, None if uv is None else corners
    )


def _without_degenerate(mesh, inputs: Inputs, out: Output):
    """Remove faces that have no area or a repeated corner, and warn about them."""
    import numpy as np

    from gdtool.geometry.mesh_quality import polygon_normals
    from gdtool.geometry.meshes import QuadMesh

    corners = np.where(mesh.faces < 0, -1 - np.arange(4), mesh.faces)
    ordered = np.sort(corners, 1)
    good = (ordered[:, 1:] != ordered[:, :-1]).all(1) & (polygon_normals(mesh)[1] > 0)
    if not good.any():
        raise InputError(source_path(inputs), "no face has an area", "name a mesh whose faces span a surface")
    if good.all():
        return mesh
    out.warn(f"{inputs.name}: left out {int((~good).sum())} faces without area")
    return QuadMesh(mesh.vertices, mesh.faces[good], mesh.uv, None if mesh.face_uvs is None else mesh.face_uvs[good])
