"""Read and write `surface` folders (schemas/surface.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gdtool.assets.ply_stl.binary_ply import columns, read_binary_ply
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.kinds import IDENTITY, SurfaceContent
from gdtool.core.reading import bytes_of
from gdtool.core.stage import Output
from gdtool.folders.records import read_light, write_light
from gdtool.geometry.meshes import TriMesh

# albedo is 8-bit sRGB under the names that viewers show.
_VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("nx", "<f4"),
        ("ny", "<f4"),
        ("nz", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("roughness", "<f4"),
        ("metallic", "<f4"),
        ("confidence", "<f4"),
    ]
)
# What the confidence was made of, where it is known.
_EVIDENCE = [("views", "u1"), ("residual", "<f4")]
_AGAIN = "run gdtool reconstruct on the views again"
_FACE = np.dtype([("count", "u1"), ("idx", "<i4", 3)])


@dataclass(frozen=True)
class Surface:
    """Hold a triangle mesh in the normalised frame with a material at each vertex.

    vertices (v, 3) float, faces (f, 3) int32, normals (v, 3) unit or None, albedo (v, 3) linear in [0, 1], roughness,
    metallic and confidence (v,) in [0, 1]. views (v,): how many views see a vertex. residual (v,): mean difference
    between those views (linear albedo, else color) and the vertex's value. Both are None where not known.
    """

    vertices: np.ndarray
    faces: np.ndarray
    albedo: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    confidence: np.ndarray
    normals: np.ndarray | None = None
    light: dict[str, Any] | None = None
    views: np.ndarray | None = None
    residual: np.ndarray | None = None


def write_surface(
    out: Output, surface: Surface, *, watertight: bool, method: str = "", source_from_world=None, **extra: Any
) -> None:
    """Write surface.ply (and light.json) and set out.content; extra goes to SurfaceContent (report, field)."""
    write_surface_ply(out.path("surface.ply"), surface)
    if surface.light is not None:
        write_light(out.path("light.json"), surface.light)
    matrix = IDENTITY if source_from_world is None else tuple(float(x) for x in np.asarray(source_from_world).ravel())
    out.content = SurfaceContent(
        vertices=len(surface.vertices),
        faces=len(surface.faces),
        watertight=bool(watertight),
        light=surface.light is not None,
        method=method,
        source_from_world=matrix,
        **extra,
    )


def write_surface_ply(path: Path, surface: Surface) -> None:
    """Write surface.ply: binary little-endian, the properties that schemas/surface.md lists."""
    from gdtool.geometry.normals import vertex_normals
    from gdtool.images.color import srgb_from_linear

    known = surface.views is not None and surface.residual is not None
    layout = np.dtype(_VERTEX.descr + _EVIDENCE) if known else _VERTEX
    vertex = np.empty(len(surface.vertices), layout)
    normals = (
        surface.normals if surface.normals is not None else vertex_normals(TriMesh(surface.vertices, surface.faces))
    )
    albedo = np.clip(surface.albedo, 0, 1)
    encoded = np.round(srgb_from_linear(albedo) * 255)
    for axis, names in enumerate((("x", "nx", "red"), ("y", "ny", "green"), ("z", "nz", "blue"))):
        for name, values in zip(names, (surface.vertices, normals, encoded), strict=True):
            vertex[name] = values[:, axis]
    for name in ("roughness", "metallic", "confidence"):
        vertex[name] = np.clip(getattr(surface, name), 0, 1)
    if known and surface.views is not None:
        vertex["views"], vertex["residual"] = np.minimum(surface.views, 255), surface.residual
    face = np.empty(len(surface.faces), _FACE)
    face["count"], face["idx"] = 3, surface.faces
    kinds = {"<f4": "float", "|u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    lines += [f"property {kinds[layout[name].str]} {name}" for name in layout.names or ()]
    lines += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    with path.open("wb") as file:
        file.write("\n".join(lines).encode())
        file.write(vertex.tobytes())
        file.write(face.tobytes())


def read_surface(folder: Folder) -> Surface:
    """Read a surface folder. Materials that surface.ply does not hold get albedo 0.8, roughness 0.5, metallic 0.

    Raises InputError when there are no faces, an index is out of range or a coordinate is not finite.
    """
    from gdtool.images.color import linear_from_srgb

    path = folder.file("surface.ply")
    try:
        vertex, faces = read_binary_ply(bytes_of(path))
    except ValueError as error:
        raise InputError(path, str(error), "write it as schemas/surface.md says") from None
    names = vertex.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(path, "has no x, y, z", "write these properties for each vertex")
    if not len(faces):
        raise InputError(path, "has no faces", _AGAIN)
    if faces.min() < 0 or faces.max() >= len(vertex):
        raise InputError(path, f"a face refers to vertex {int(faces.max())} of {len(vertex)}", _AGAIN)
    vertices = columns(vertex, "x y z")
    if not np.isfinite(vertices).all():
        raise InputError(path, f"vertex {int(np.argwhere(~np.isfinite(vertices))[0][0])} is not finite", _AGAIN)

    def column(name: str, default: float) -> np.ndarray:
        return (
            np.clip(vertex[name], 0, 1).astype(np.float32)
            if name in names
            else np.full(len(vertex), default, np.float32)
        )

    if {"red", "green", "blue"} <= set(names):
        albedo = linear_from_srgb(np.stack([vertex[k] for k in ("red", "green", "blue")], -1).astype(np.float32) / 255)
    else:
        albedo = np.full((len(vertex), 3), 0.8, np.float32)
    normals = columns(vertex, "nx ny nz").astype(np.float32) if {"nx", "ny", "nz"} <= set(names) else None
    light = read_light(folder.file("light.json")) if folder.content_as(SurfaceContent).light else None
    return Surface(
        vertices,
        faces.astype(np.int32),
        albedo.astype(np.float32),
        column("roughness", 0.5),
        column("metallic", 0.0),
        column("confidence", 0.0),
        normals,
        light,
        *(np.asarray(vertex[name]) if name in names else None for name, _ in _EVIDENCE),
    )
