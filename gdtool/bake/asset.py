"""The finished asset: a glTF scene and Wavefront files of a baked target and its maps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from gdtool.assets.scene import Material, Scene, Texture
from gdtool.bake.maps import Maps
from gdtool.bake.target import Target
from gdtool.folders.mesh import QuadMesh
from gdtool.geometry.tangents import weld


class Drawn(Protocol):
    """How a surface is drawn, as texture.origin.Origin says."""

    alpha_mode: str
    alpha_cutoff: float
    double_sided: bool


def material_of(
    maps: Maps, name: str, alpha_mode: str = "OPAQUE", alpha_cutoff: float = 0.5, double_sided: bool = False
) -> Material:
    """The glTF material of maps; every factor is explicit."""

    # A texture repeats by default; clamped, a chart at the map's edge does not read the opposite edge.
    def texture(image: np.ndarray | None, encoding: str) -> Texture | None:
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
    """Triangles of the target, corners that agree in everything shared; tangents only when a normal map needs them."""
    corner = np.arange(len(target.faces) * 3)
    position_idx, uv_idx = target.faces.ravel(), target.face_uvs.ravel()
    normals, tangents = target.normals.reshape(-1, 3), target.tangents.reshape(-1, 4)
    columns = [position_idx[:, None], uv_idx[:, None], normals]
    if maps.normal is not None:
        columns.append(tangents)
    vertex = weld(*columns)
    first = np.full(vertex.max(initial=-1) + 1, len(corner), np.int64)
    np.minimum.at(first, vertex, corner)
    # Numbered as they come up, so that neighbours in the file are neighbours on the mesh.
    order = np.argsort(first, kind="stable")
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    kept = first[order]
    return Scene(
        vertices=target.vertices[position_idx[kept]],
        faces=place[vertex].reshape(-1, 3).astype(np.int32),
        materials=(material,),
        normals=normals[kept],
        tangents=tangents[kept] if maps.normal is not None else None,
        uvs=(np.asarray(target.uv, np.float64)[uv_idx[kept]],),
        name=name,
    )


def write_obj(
    path: Path,
    mesh: QuadMesh,
    face_normals_idx: np.ndarray,
    normals: np.ndarray,
    maps: Maps,
    files: dict[str, str],
    name: str,
) -> None:
    """Write path (.obj) with the quads as they are, and the .mtl beside it, named alike.

    face_normals_idx (f, 4) into normals (n, 3), -1 with a triangle's fourth corner. files: map name to file name.
    """
    library = path.with_suffix(".mtl")
    lines = [f"mtllib {library.name}", f"o {_word(name)}"]
    lines += ["v %.9g %.9g %.9g" % tuple(p) for p in mesh.vertices.tolist()]
    lines += ["vt %.9g %.9g" % (u, 1 - v) for u, v in mesh.uv.tolist()]
    lines += ["vn %.6g %.6g %.6g" % tuple(n) for n in normals.tolist()]
    lines.append("usemtl material")
    for face, uvs, ns in zip(mesh.faces.tolist(), mesh.face_uvs.tolist(), face_normals_idx.tolist(), strict=True):
        lines.append(
            "f " + " ".join(f"{v + 1}/{t + 1}/{n + 1}" for v, t, n in zip(face, uvs, ns, strict=True) if v >= 0)
        )
    path.write_text("\n".join(lines) + "\n")
    library.write_text(material_library(maps, files))


def _word(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name) or "object"


def material_library(maps: Maps, files: dict[str, str]) -> str:
    """Text of the .mtl: the classic fields, and the physically based ones (Pr, Pm, norm) that newer readers know.

    The normal map is named twice: Blender's importer leaves norm out, and takes map_Bump for a normal map of strength
    -bm.

    Scalar maps are channels of the packed map: -imfchan is the format's own way to say which (Wavefront MTL 4.2).
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


def corner_normals_of_quads(mesh: QuadMesh, target: Target, face_idx: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals of the quads' corners out of their triangles': face_normals_idx (f, 4), normals (n, 3).

    face_idx (t,) says which quad each triangle of the target came from; the first triangle of a quad has its corners
    0, 1, 2, the second 0, 2, 3.
    """
    first = np.searchsorted(face_idx, np.arange(len(mesh.faces)))
    second = np.minimum(first + 1, len(face_idx) - 1)
    corners = np.concatenate([target.normals[first], target.normals[second][:, 2:]], 1)
    idx = weld(corners.reshape(-1, 3))
    normals = np.zeros((idx.max() + 1, 3))
    normals[idx] = corners.reshape(-1, 3)
    return np.where(mesh.is_quad[:, None] | (np.arange(4) < 3), idx.reshape(-1, 4), -1), normals


def write_models(
    path: Callable[[str], Path],
    target: Target,
    mesh: QuadMesh,
    face_idx: np.ndarray,
    maps: Maps,
    surface: Drawn,
    name: str,
    convention: str,
    usd: str,
    levels: list[Target],
    threads: int = 1,
) -> dict[str, str]:
    """Write asset.glb, asset.obj, the maps, OpenUSD where usd names a suffix, and asset_lod1.glb and on; the maps'
    files.

    path(file name) says where. face_idx (t,) is the quad of each triangle. The coarser levels refer to the maps' files.
    """
    from gdtool.assets.gltf_write import write_glb
    from gdtool.bake.maps import contact_sheet_of, directx
    from gdtool.images.io import encode_pngs, write_png

    material = material_of(maps, name, surface.alpha_mode, surface.alpha_cutoff, surface.double_sided)
    shown = {
        key: image
        for key, image in (
            ("base_color", maps.base_color),
            ("orm", maps.orm),
            ("normal", maps.normal),
            ("emissive", maps.emissive),
        )
        if image is not None
    }
    # Encoding a large map takes as long as baking it: once, for the .glb and for the file beside it.
    encoded = dict(zip(shown, encode_pngs(list(shown.values()), threads=threads), strict=True))
    write_glb(
        path("asset.glb"),
        scene_of(target, maps, material, name),
        made={id(shown[key]): content for key, content in encoded.items()},
    )
    files, beside = {key: f"{key}.png" for key in shown}, {id(image): f"{key}.png" for key, image in shown.items()}
    for key, content in encoded.items():
        if key == "normal" and convention == "directx":
            write_png(path(files[key]), directx(maps.normal))
            if not levels:
                continue
            beside[id(maps.normal)] = "normal_opengl.png"
        path(beside[id(shown[key])]).write_bytes(content)
    for k, level in enumerate(levels, 1):
        write_glb(path(f"asset_lod{k}.glb"), scene_of(level, maps, material, name), made=beside)
    for key, image in maps.extra.items():
        files[key] = f"{key}.png"
        write_png(path(files[key]), image)
    normals_idx, normals = corner_normals_of_quads(mesh, target, face_idx)
    write_obj(path("asset.obj"), mesh, normals_idx, normals, maps, files, name)
    if usd:
        from gdtool.bake.usd import write_usd

        write_usd(
            path(usd),
            mesh,
            normals_idx,
            normals,
            maps,
            files,
            convention,
            surface.alpha_mode,
            surface.alpha_cutoff,
            surface.double_sided,
        )
    write_png(path("contact_sheet.png"), contact_sheet_of(maps))
    return files
