"""Write atlas, surface and views folders of a torus, as stages would, for tests of bake."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gdtool.cameras import rays, rig
from gdtool.core.folder import open_folder
from gdtool.core.kinds import AtlasContent
from gdtool.core.manifest import MANIFEST, InputEntry, Manifest, encode, list_files
from gdtool.core.sources import digest
from gdtool.core.stage import Output
from gdtool.folders.mesh import write_mesh
from gdtool.folders.surface import Surface, write_surface
from gdtool.folders.views import Views, write_views
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.rays import RayCaster
from tests.bake.shapes import albedo_of, torus, triangles_of, unwrapped


def finish(path: Path, kind: str, content, inputs: dict[str, Path]) -> Path:
    """Write the manifest of a folder made from inputs (role to folder or file)."""
    sources = {role: open_folder(p) if p.is_dir() else p for role, p in inputs.items()}
    entries = tuple(
        InputEntry(role, os.path.relpath(inputs[role], path), digest(source)) for role, source in sources.items()
    )
    manifest = Manifest(
        kind=kind,
        name=path.parent.name.removesuffix(".asset"),
        stage="test",
        content=content,
        inputs=entries,
        files=list_files(path),
    )
    (path / MANIFEST).write_bytes(encode(manifest))
    return path


def fresh(path: Path) -> Output:
    """Make an Output that writes into path."""
    path.mkdir(parents=True)
    return Output(path, path.with_name("work"), 1, "cpu")


def torus_views(size: int = 96) -> Views:
    """Render six true views of the torus: albedo, roughness, metallic, normal."""
    vertices, quads, normals = torus(160, 90)
    faces = triangles_of(quads)
    caster = RayCaster(TriMesh(vertices, faces))
    cameras = rig("six", size)
    stacks: dict[str, list] = {"albedo": [], "roughness": [], "metallic": [], "normal": []}
    masks = []
    for camera in cameras:
        origins, directions = rays(camera)
        hits = caster.first_hit(origins.reshape(-1, 3), directions.reshape(-1, 3))
        seen = hits.is_hit.reshape(size, size)
        at = np.einsum("nk,nkc->nc", hits.barycentric, vertices[faces[hits.face_idx]])
        normal = np.einsum("nk,nkc->nc", hits.barycentric, normals[faces[hits.face_idx]])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        for name, value in (
            ("albedo", albedo_of(at)),
            ("roughness", 0.5 + 0.4 * at[:, 0]),
            ("metallic", 0 * at[:, 0]),
            ("normal", normal),
        ):
            stacks[name].append(np.where(seen[..., None], value.reshape(size, size, -1), 0).squeeze())
        masks.append(seen)
    return Views(cameras, {k: np.array(v, np.float32) for k, v in stacks.items()}, np.array(masks, np.float32))


def make_chain(root: Path, *, with_views: bool = True, gray_vertices: bool = False) -> Path:
    """Write root/views, surface and atlas, each made from the one before; returns the atlas folder.

    gray_vertices: only the views have color.
    """
    made_from: dict[str, Path] = {}
    if with_views:
        out = fresh(root / "views")
        write_views(out, torus_views())
        made_from = {"source": finish(root / "views", "views", out.content, {})}
    vertices, quads, normals = torus(160, 90)
    albedo = np.full((len(vertices), 3), 0.5) if gray_vertices else albedo_of(vertices)
    fill = lambda value: np.full(len(vertices), value, np.float32)  # noqa: E731
    out = fresh(root / "surface")
    write_surface(
        out,
        Surface(vertices, triangles_of(quads), albedo, 0.5 + 0.4 * vertices[:, 0], fill(0), fill(1), normals),
        watertight=True,
    )
    finish(root / "surface", "surface", out.content, made_from)
    write_atlas(root / "atlas", {"source": root / "surface"})
    return root / "atlas"


def torus_atlas() -> QuadMesh:
    """Make a coarse torus of quads with xatlas charts."""
    vertices, quads, _ = torus(36, 18, minor=0.141)
    uv, face_uvs = unwrapped(vertices, triangles_of(quads), 256)
    corners = face_uvs.reshape(-1, 2, 3)
    # xatlas may cut a quad along its diagonal; such a quad stays two triangles.
    whole = (corners[:, 0, 0] == corners[:, 1, 0]) & (corners[:, 0, 2] == corners[:, 1, 1])
    none = np.full((2 * (~whole).sum(), 1), -1)
    faces = np.concatenate([quads[whole], np.concatenate([triangles_of(quads[~whole]), none], 1)])
    uvs = np.concatenate(
        [
            np.concatenate([corners[whole, 0], corners[whole, 1, 2:]], 1),
            np.concatenate([corners[~whole].reshape(-1, 3), none], 1),
        ]
    )
    return QuadMesh(vertices, faces.astype(np.int32), uv, uvs.astype(np.int32))


def write_atlas(path: Path, inputs: dict[str, Path], mesh: QuadMesh | None = None) -> Path:
    """Write an atlas folder."""
    mesh = mesh or torus_atlas()
    out = fresh(path)
    write_mesh(out, mesh)
    quads = int(mesh.is_quad.sum())
    content = AtlasContent(
        vertices=len(mesh.vertices),
        quads=quads,
        triangles=len(mesh.faces) - quads,
        charts=1,
        size=256,
        padding=4,
        coverage=0.5,
        watertight=True,
    )
    return finish(path, "atlas", content, inputs)
