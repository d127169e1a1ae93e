"""What bakes are measured on: textured models, each with the quad mesh that its material is baked for.

The first is a marching-cubes solid of 166,000 triangles with 1024² textures that were
rasterised from a closed-form material. The others are public models with their own textures. All are in a unit box, and
kept in a folder as NAME.glb and NAME_VERSIONS.npz (vertices, faces (f, 4), uv with (0, 0) at the top left, face_uvs),
for remeshing takes longer than baking."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.fine_meshes import marched, part, unit
from gdtool.geometry.meshes import TriMesh

PART_TRIANGLES = 166_000
PART_TEXTURE = 1024
QUADS = 20_000


@dataclass(frozen=True)
class Case:
    """A model and its quad mesh, on disk and in the same frame."""

    name: str
    glb: Path
    low: Path


def material(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Base color (n, 3) linear, roughness (n,), metallic (n,) of a closed-form material at (n, 3) in a
    unit box."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = (
        sum(
            np.sin(k * (points @ np.array(axis)) + k) / k**0.5
            for k, axis in ((7, (1, 0.3, 0.5)), (13, (-0.4, 1, 0.6)), (23, (0.7, -0.5, 1)), (41, (0.2, 0.9, -0.8)))
        )
        / 2
    )
    checks = np.floor(8 * points).sum(-1) % 2
    color = np.stack([0.45 + 0.3 * np.tanh(2 * waves), 0.35 + 0.25 * checks, 0.3 + 0.25 * np.sin(6 * y)], -1)
    return (
        np.clip(color, 0.02, 0.98),
        np.clip(0.45 + 0.3 * waves, 0.08, 0.95),
        (np.sin(9 * x + 2) + np.sin(7 * z) > 0.5) * 1.0,
    )


def textured_part():
    """The peers' bake case: the solid with 8-bit textures of its material, as a Scene."""
    import xatlas

    from gdtool.assets.scene import Material, Scene, Texture
    from gdtool.bake.padding import push_pull
    from gdtool.geometry.normals import vertex_normals
    from gdtool.geometry.uv_raster import rasterize_uv
    from gdtool.images.color import srgb_from_linear

    vertices, faces = marched(part, PART_TRIANGLES)
    vertices = unit(vertices)[0]
    normals = vertex_normals(TriMesh(vertices, faces))
    own, corners, uv = xatlas.parametrize(
        vertices.astype(np.float32), faces.astype(np.uint32), normals.astype(np.float32)
    )
    corners, uv = corners.astype(np.int32), np.asarray(uv, np.float64) * (1, -1) + (0, 1)
    vertices, normals = vertices[own], normals[own]
    owner, barycentric = rasterize_uv(uv, corners, PART_TEXTURE)
    mask = owner >= 0
    color, roughness, metallic = material(
        np.einsum("nk,nkc->nc", barycentric[mask].astype(np.float64), vertices[corners[owner[mask]]])
    )
    layers = np.zeros((PART_TEXTURE, PART_TEXTURE, 6), np.float32)
    layers[mask] = np.concatenate(
        [srgb_from_linear(color), np.ones_like(roughness)[:, None], roughness[:, None], metallic[:, None]], 1
    )
    stored = np.rint(push_pull(layers, mask) * 255).astype(np.uint8)
    one = Material(
        base_color_texture=Texture(np.ascontiguousarray(stored[..., :3]), "srgb"),
        metallic_roughness_texture=Texture(np.ascontiguousarray(stored[..., 3:]), "linear"),
    )
    return Scene(vertices, corners, (one,), normals=normals, uvs=(uv,), name="part")


def quads_for(scene, quads: int = QUADS) -> dict[str, np.ndarray]:
    """A quad mesh of a scene's shape with texture coordinates, by gdtool's own remesh and unwrap."""
    from gdtool.geometry import repair
    from gdtool.remesh.pipeline import remesh
    from gdtool.remesh.task import Request
    from gdtool.unwrap.pipeline import Request as Charts
    from gdtool.unwrap.pipeline import unwrap

    low, _ = remesh(repair.clean(TriMesh(scene.vertices, scene.faces)).mesh, Request(quads=quads))
    flat = unwrap(low, Charts(size=2048))
    return {"vertices": low.vertices, "faces": low.faces, "uv": flat.uv, "face_uvs": flat.face_uvs}


def case_of(source: str | Path, kept: Path) -> Case:
    """The part, or a model file in a unit box; made where it is not kept yet."""
    from gdtool.assets.gltf.write import write_glb
    from gdtool.assets.load import load_scene
    from gdtool.stages import remesh, unwrap

    part_asked = source == "part"
    name = "part" if part_asked else Path(source).stem
    stem = kept / (
        f"bake_{name}" if part_asked else f"bake_{name}_{hashlib.sha256(Path(source).read_bytes()).hexdigest()[:8]}"
    )
    # Another version makes other quads.
    made_by = "_".join(f"{stage.name}{stage.version}" for stage in (remesh.STAGE, unwrap.STAGE))
    case = Case(name, stem.with_suffix(".glb"), stem.with_name(f"{stem.name}_{made_by}.npz"))
    if not (case.glb.exists() and case.low.exists()):
        kept.mkdir(parents=True, exist_ok=True)
        scene = textured_part() if part_asked else load_scene(source)
        scene = replace(scene, vertices=unit(scene.vertices)[0])
        write_glb(case.glb, scene)
        np.savez(case.low, **quads_for(scene))
    return case


def read_low(case: Case):
    """The case's quad mesh."""
    from gdtool.geometry.meshes import QuadMesh

    with np.load(case.low) as found:
        return QuadMesh(found["vertices"], found["faces"], found["uv"], found["face_uvs"])
