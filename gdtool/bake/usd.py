"""Write the finished asset as OpenUSD: its quads, a UsdPreviewSurface, and references to the maps beside the file.

Needs the package usd-core (extra `usd`). UsdPreviewSurface: https://openusd.org/release/spec_usdpreviewsurface.html
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gdtool.bake.maps import Maps
from gdtool.bake.target import CornerNormals, SurfaceModes
from gdtool.core.errors import OutputError, ResourceError
from gdtool.core.native import imported_if_installed
from gdtool.geometry.meshes import QuadMesh

YEAR_2000 = 946_684_800  # seconds
MESH, MATERIAL = "/asset/mesh", "/asset/material"


def require() -> None:
    """Raise ResourceError where usd-core is not installed or cannot be loaded."""
    if imported_if_installed("pxr.Usd") is None:
        raise ResourceError("usd-core", "is not installed, and --usd needs it", "pip install 'gdtool[usd]'")


def write_usd(
    path: Path,
    mesh: QuadMesh,
    corners: CornerNormals,
    maps: Maps,
    files: dict[str, str],
    convention: str,
    surface: SurfaceModes,
) -> None:
    """Write a .usda, or a .usdz that packs it with its maps.

    files: file name, beside path, by map name. convention: "opengl" or "directx", the direction of the green channel of
    normal.png. Units and axes are glTF's: metres, Y up, right-handed. Raises OutputError when the package cannot be
    written.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

    text = path.with_suffix(".usda")
    stage = Usd.Stage.CreateNew(str(text))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/asset").GetPrim())

    corner = mesh.faces.ravel() >= 0
    prim = UsdGeom.Mesh.Define(stage, MESH)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(mesh.vertices, np.float32)))
    prim.CreateExtentAttr([Gf.Vec3f(*map(float, mesh.vertices.min(0))), Gf.Vec3f(*map(float, mesh.vertices.max(0)))])
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy((mesh.faces >= 0).sum(1).astype(np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel()[corner].astype(np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    prim.CreateDoubleSidedAttr(surface.double_sided)
    primvars = UsdGeom.PrimvarsAPI(prim)
    uv, face_uvs = mesh.texture_coordinates()
    uv = np.stack([uv[:, 0], 1 - uv[:, 1]], 1).astype(np.float32)  # (0, 0) is the image's bottom left
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(uv))
    st.SetIndices(Vt.IntArray.FromNumpy(face_uvs.ravel()[corner].astype(np.int32)))
    shading = primvars.CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying)
    shading.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(corners.normals, np.float32)))
    shading.SetIndices(Vt.IntArray.FromNumpy(corners.idx.ravel()[corner].astype(np.int32)))

    material = _material(stage, maps, files, convention, surface)
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()
    if path.suffix == ".usdz":
        for file in (text, *(path.parent / name for name in files.values())):
            os.utime(file, (YEAR_2000, YEAR_2000))  # a package holds its files' times: equal inputs give equal bytes
        packed = UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(text)), str(path))
        text.unlink()
        if not packed:
            raise OutputError(path, "could not be packed", "free some space or write --usd usda")


def _material(stage, maps: Maps, files: dict[str, str], convention: str, modes: SurfaceModes):
    """Define a UsdPreviewSurface with a texture for each map, and with plain values where a map is constant."""
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, MATERIAL)
    surface = UsdShade.Shader.Define(stage, f"{MATERIAL}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    coordinates = UsdShade.Shader.Define(stage, f"{MATERIAL}/coordinates")
    coordinates.CreateIdAttr("UsdPrimvarReader_float2")
    coordinates.CreateInput("varname", types.String).Set("st")

    def texture(name: str, space: str, scale, bias=None):
        """Define a texture of a map's file; values are scale * texel + bias."""
        shader = UsdShade.Shader.Define(stage, f"{MATERIAL}/{name}")
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateInput("file", types.Asset).Set(f"./{files[name]}")
        shader.CreateInput("sourceColorSpace", types.Token).Set(space)
        for axis in ("wrapS", "wrapT"):
            shader.CreateInput(axis, types.Token).Set("clamp")
        shader.CreateInput("scale", types.Float4).Set(Gf.Vec4f(*scale))
        if bias is not None:
            shader.CreateInput("bias", types.Float4).Set(Gf.Vec4f(*bias))
        shader.CreateInput("st", types.Float2).ConnectToSource(coordinates.ConnectableAPI(), "result")
        return shader

    def feed(name: str, kind, shader, output: str, value=None):
        """Connect an input of the surface to a texture's output, or set it to a value where there is no texture."""
        entry = surface.CreateInput(name, kind)
        if shader is None:
            entry.Set(value)
        else:
            shader.CreateOutput(output, types.Float3 if output == "rgb" else types.Float)
            entry.ConnectToSource(shader.ConnectableAPI(), output)

    color = maps.factors["base_color"]
    roughness, metallic = maps.factors["roughness"][0], maps.factors["metallic"][0]
    base = texture("base_color", "sRGB", color) if "base_color" in files else None
    orm = (
        texture(
            "orm",
            "raw",
            (
                1.0,
                roughness if maps.has_roughness_metallic else 1.0,
                metallic if maps.has_roughness_metallic else 1.0,
                1.0,
            ),
        )
        if "orm" in files
        else None
    )
    feed("diffuseColor", types.Color3f, base, "rgb", Gf.Vec3f(*color[:3]))
    feed("roughness", types.Float, orm if maps.has_roughness_metallic else None, "g", roughness)
    feed("metallic", types.Float, orm if maps.has_roughness_metallic else None, "b", metallic)
    surface.CreateInput("useSpecularWorkflow", types.Int).Set(0)
    if "emissive" in maps.factors:
        shine = texture("emissive", "sRGB", (*maps.factors["emissive"], 1.0)) if "emissive" in files else None
        feed("emissiveColor", types.Color3f, shine, "rgb", Gf.Vec3f(*maps.factors["emissive"]))
    if maps.has_occlusion and orm is not None:
        feed("occlusion", types.Float, orm, "r")
    if "normal" in files:
        up = 2.0 if convention == "opengl" else -2.0  # of the green channel
        feed("normal", types.Normal3f, texture("normal", "raw", (2.0, up, 2.0, 1.0), (-1.0, -up / 2, -1.0, 0.0)), "rgb")
    if modes.alpha_mode != "OPAQUE":
        has_alpha = base is not None and maps.base_color.shape[2] == 4
        feed("opacity", types.Float, base if has_alpha else None, "a", color[3])
        if modes.alpha_mode == "MASK":
            surface.CreateInput("opacityThreshold", types.Float).Set(modes.alpha_cutoff)
    return material
