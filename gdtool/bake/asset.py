"""Write the finished asset: glTF, Wavefront and OpenUSD files of a baked target and its maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gdtool.assets.scene import Material, Scene, Texture
from gdtool.bake.maps import Maps
from gdtool.bake.target import CornerNormals, SurfaceModes, Target
from gdtool.geometry.frames import transform_points
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.tangents import number_distinct_rows


@dataclass(frozen=True)
class AssetMeshes:
    """The meshes of an asset.

    target: the triangles that were baked. mesh: the quads that were cut into these triangles. face_idx (t,): the quad
    of each triangle. levels: coarser levels of detail, finest first.
    """

    target: Target
    mesh: QuadMesh
    face_idx: np.ndarray
    levels: tuple[Target, ...] = ()


@dataclass(frozen=True)
class AssetOptions:
    """Options for writing an asset's files.

    name: the object's name. convention: "opengl" or "directx", the direction of the green channel of normal.png. usd:
    file name of the OpenUSD file; empty to write none. threads: the number that the PNG encoder uses.
    """

    name: str
    convention: str = "opengl"
    usd: str = ""
    threads: int = 1


def in_source_frame(meshes: AssetMeshes, matrix: np.ndarray) -> AssetMeshes:
    """Transform meshes from the normalised frame to the source's by a similarity (4, 4).

    Vertices, normals and tangents are transformed, those of the levels of detail too.
    """
    turn = matrix[:3, :3] / (matrix[:3, 0] ** 2).sum() ** 0.5

    def moved(target: Target) -> Target:
        tangents = target.tangents.copy()
        tangents[..., :3] = tangents[..., :3] @ turn.T
        return replace(
            target,
            mesh=TriMesh(transform_points(matrix, target.mesh.vertices), target.mesh.faces),
            normals=target.normals @ turn.T,
            tangents=tangents,
        )

    target = moved(meshes.target)
    mesh = replace(meshes.mesh, vertices=target.mesh.vertices)
    return AssetMeshes(target, mesh, meshes.face_idx, tuple(moved(level) for level in meshes.levels))


def material_of(
    maps: Maps, name: str, alpha_mode: str = "OPAQUE", alpha_cutoff: float = 0.5, double_sided: bool = False
) -> Material:
    """Make a glTF material that uses the maps; every factor is written out, also where it has glTF's default."""

    def texture(image: np.ndarray | None, encoding: Literal["srgb", "linear"]) -> Texture | None:
        """Make a texture that clamps, so that a chart at the map's edge does not read the opposite edge."""
        return None if image is None else Texture(image, encoding, wrap_u="clamp", wrap_v="clamp")

    orm = texture(maps.orm, "linear")
    return Material(
        name=name,
        base_color=maps.factors["base_color"],
        metallic=maps.factors["metallic"][0],
        roughness=maps.factors["roughness"][0],
        alpha_mode=alpha_mode,
        alpha_cutoff=alpha_cutoff,
        double_sided=double_sided,
        base_color_texture=texture(maps.base_color, "srgb"),
        metallic_roughness_texture=orm if maps.has_roughness_metallic else None,
        normal_texture=texture(maps.normal, "linear"),
        occlusion_texture=orm if maps.has_occlusion else None,
        emissive=maps.factors.get("emissive", (0.0, 0.0, 0.0)),
        emissive_texture=texture(maps.emissive, "srgb"),
    )


def scene_of(target: Target, maps: Maps, material: Material, name: str) -> Scene:
    """Make a scene of the target's triangles.

    Corners with equal position, texture coordinates and normal (and tangent, where there is a normal map) share a
    vertex. Tangents are written only where there is a normal map.
    """
    corner = np.arange(len(target.mesh.faces) * 3)
    position_idx, uv_idx = target.mesh.faces.ravel(), target.face_uvs.ravel()
    normals, tangents = target.normals.reshape(-1, 3), target.tangents.reshape(-1, 4)
    columns = [position_idx[:, None], uv_idx[:, None], normals]
    if maps.normal is not None:
        columns.append(tangents)
    vertex = number_distinct_rows(*columns)
    first = np.full(vertex.max(initial=-1) + 1, len(corner), np.int64)
    np.minimum.at(first, vertex, corner)
    # Vertices are numbered in order of first use, so that neighbours in the file are neighbours on the mesh.
    order = np.argsort(first, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    corner_of_vertex = first[order]
    return Scene(
        vertices=target.mesh.vertices[position_idx[corner_of_vertex]],
        faces=place[vertex].reshape(-1, 3).astype(np.int32),
        materials=(material,),
        normals=normals[corner_of_vertex],
        tangents=tangents[corner_of_vertex] if maps.normal is not None else None,
        uvs=(np.asarray(target.uv, np.float64)[uv_idx[corner_of_vertex]],),
        name=name,
    )


def write_obj(
    path: Path,
    mesh: QuadMesh,
    corners: CornerNormals,
    maps: Maps,
    files: dict[str, str],
    name: str,
) -> None:
    """Write the quads as an .obj, and its .mtl beside it under the same stem.

    files: the file name of each map, by the map's name.
    """
    library, (uv, face_uvs) = path.with_suffix(".mtl"), mesh.texture_coordinates()
    lines = [f"mtllib {library.name}", f"o {_object_name(name)}"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in uv.tolist()]
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in corners.normals.tolist()]
    lines.append("usemtl material")
    for face, uvs, ns in zip(mesh.faces.tolist(), face_uvs.tolist(), corners.idx.tolist(), strict=True):
        lines.append(
            "f " + " ".join(f"{v + 1}/{t + 1}/{n + 1}" for v, t, n in zip(face, uvs, ns, strict=True) if v >= 0)
        )
    path.write_text("\n".join(lines) + "\n")
    library.write_text(material_library(maps, files))


def _object_name(name: str) -> str:
    """Replace the characters that an .obj object name cannot contain by underscores."""
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name) or "object"


def material_library(maps: Maps, files: dict[str, str]) -> str:
    """Compose the text of the .mtl: the classic fields, and the physically based ones (Pr, Pm, norm) of newer readers.

    The normal map is named twice: Blender's importer ignores norm, and takes map_Bump for a normal map of strength -bm.
    Roughness and metallic are channels of the packed map, chosen by -imfchan (Wavefront MTL 4.2). files: the file name
    of each map, by the map's name.
    """
    r, g, b, a = maps.factors["base_color"]
    lines = [
        "newmtl material",
        f"Kd {r:.6g} {g:.6g} {b:.6g}",
        "Ks 0.04 0.04 0.04",
        f"d {a:.6g}",
        "illum 2",
        f"Pr {maps.factors['roughness'][0]:.6g}",
        f"Pm {maps.factors['metallic'][0]:.6g}",
    ]
    if "base_color" in files:
        lines.append(f"map_Kd {files['base_color']}")
        if maps.base_color.shape[2] == 4:
            lines.append(f"map_d -imfchan m {files['base_color']}")
    if "orm" in files and maps.has_roughness_metallic:
        lines += [f"map_Pr -imfchan g {files['orm']}", f"map_Pm -imfchan b {files['orm']}"]
    if "normal" in files:
        lines += [f"norm {files['normal']}", f"map_Bump -bm 1 {files['normal']}"]
    if "emissive" in maps.factors:
        lines.append("Ke " + " ".join(f"{x:.6g}" for x in maps.factors["emissive"]))
    if "emissive" in files:
        lines.append(f"map_Ke {files['emissive']}")
    return "\n".join(lines) + "\n"


def corner_normals_of_quads(meshes: AssetMeshes) -> CornerNormals:
    """Collect the normals of the quads' corners from their triangles.

    The first triangle of a quad has its corners 0, 1, 2, the second 0, 2, 3.
    """
    mesh, target, face_idx = meshes.mesh, meshes.target, meshes.face_idx
    first = np.searchsorted(face_idx, np.arange(len(mesh.faces)))
    second = np.minimum(first + 1, len(face_idx) - 1)
    corners = np.concatenate([target.normals[first], target.normals[second][:, 2:]], 1)
    idx = number_distinct_rows(corners.reshape(-1, 3))
    normals = np.zeros((idx.max() + 1, 3))
    normals[idx] = corners.reshape(-1, 3)
    return CornerNormals(np.where(mesh.is_quad[:, None] | (np.arange(4) < 3), idx.reshape(-1, 4), -1), normals)


def write_models(
    path: Callable[[str], Path], meshes: AssetMeshes, maps: Maps, surface: SurfaceModes, options: AssetOptions
) -> dict[str, str]:
    """Write the asset's models and maps: asset.glb, asset.obj, PNG files, levels of detail and, if asked for, OpenUSD.

    path: returns where to write a file, from its name. Levels are written as asset_lod1.glb, asset_lod2.glb …, which
    refer to the PNG files instead of containing them. Returns the file name of each map, by the map's name.
    """
    from gdtool.assets.gltf.write import write_glb
    from gdtool.bake.maps import contact_sheet_of
    from gdtool.images.io import encode_pngs, write_png

    material = material_of(maps, options.name, surface.alpha_mode, surface.alpha_cutoff, surface.double_sided)
    by_name = {"base_color": maps.base_color, "orm": maps.orm, "normal": maps.normal, "emissive": maps.emissive}
    images = {name: image for name, image in by_name.items() if image is not None}
    # Encoding a large map takes as long as baking it: once, for the .glb and for the file beside it.
    encoded = dict(zip(images, encode_pngs(list(images.values()), threads=options.threads), strict=True))
    write_glb(
        path("asset.glb"),
        scene_of(meshes.target, maps, material, options.name),
        pngs={id(images[name]): content for name, content in encoded.items()},
    )
    beside = _write_maps(path, maps, images, encoded, options.convention, bool(meshes.levels))
    for k, level in enumerate(meshes.levels, 1):
        write_glb(path(f"asset_lod{k}.glb"), scene_of(level, maps, material, options.name), pngs=beside)
    files = {name: f"{name}.png" for name in images}
    for name, image in maps.extra.items():
        files[name] = f"{name}.png"
        write_png(path(files[name]), image)
    corners = corner_normals_of_quads(meshes)
    write_obj(path("asset.obj"), meshes.mesh, corners, maps, files, options.name)
    if options.usd:
        from gdtool.bake.usd import write_usd

        write_usd(path(options.usd), meshes.mesh, corners, maps, files, options.convention, surface)
    write_png(path("contact_sheet.png"), contact_sheet_of(maps))
    return files


def _write_maps(
    path: Callable[[str], Path],
    maps: Maps,
    images: dict[str, np.ndarray],
    encoded: dict[str, bytes],
    convention: str,
    has_levels: bool,
) -> dict[int, str]:
    """Write the material's maps as PNG files; return the file name for glTF to refer to, by the id() of each image.

    With the "directx" convention, normal.png has its green channel inverted. glTF knows "opengl" only, so where there
    are levels of detail, normal_opengl.png is written for them as well.
    """
    from gdtool.bake.maps import directx
    from gdtool.images.io import write_png

    beside = {id(image): f"{name}.png" for name, image in images.items()}
    for name, content in encoded.items():
        if name == "normal" and convention == "directx":
            write_png(path("normal.png"), directx(maps.normal))
            if not has_levels:
                continue
            beside[id(maps.normal)] = "normal_opengl.png"
        path(beside[id(images[name])]).write_bytes(content)
    return beside
