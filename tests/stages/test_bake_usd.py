"""Run gdtool bake --usd, and compare the OpenUSD file with the .glb (needs usd-core)."""

import json
import shutil
import zipfile

import numpy as np
import pytest

from gdtool.folders.mesh import read_obj
from tests.stages.bake_folders import make_chain

FAST = ("--size", 64, "--ao-rays", 4)


def test_without_its_package_it_says_what_to_install(gdtool, tmp_path):
    (tmp_path / "pxr").mkdir()
    (tmp_path / "pxr" / "__init__.py").write_text("raise ImportError\n")
    (tmp_path / "x.obj").write_text("v 0 0 0\n")
    done = gdtool("bake", "x.obj", "--usd", "usda", env={"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 5
    assert "gdtool[usd]" in done.stderr


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    pytest.importorskip("pxr", reason="needs pip install 'gdtool[usd]'")
    return make_chain(tmp_path_factory.mktemp("chain") / "ring.asset")


@pytest.mark.parametrize("convention", ["opengl", "directx"])
def test_geometry_and_material_are_the_assets(gdtool, chain, tmp_path, convention):
    from pxr import Usd, UsdGeom, UsdShade

    done = gdtool("bake", chain, *FAST, "--usd", "usda", "--normal-convention", convention, "-o", "out")
    assert done.returncode == 0, done.stderr
    assert gdtool("validate", "out").returncode == 0
    stage = Usd.Stage.Open(str(tmp_path / "out" / "asset.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetDefaultPrim().GetPath() == "/asset"
    mesh, obj = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh")), read_obj(tmp_path / "out" / "asset.obj")
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(), obj.vertices, atol=1e-6)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get())
    assert (counts == np.where(obj.is_quad, 4, 3)).all()
    assert (counts == 4).sum() > 500
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    obj_uv = obj.uv[obj.face_uvs[obj.face_uvs >= 0]]
    np.testing.assert_allclose(np.array(st.ComputeFlattened()) * [1, -1] + [0, 1], obj_uv, atol=1e-6)
    normals = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals").ComputeFlattened())
    points = np.array(mesh.GetPointsAttr().Get())[mesh.GetFaceVertexIndicesAttr().Get()]
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    outward = np.cross(points[first + 1] - points[first], points[first + 2] - points[first])
    assert ((outward * normals[first]).sum(1) > 0).mean() > 0.99

    material, _ = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"

    def source(name):
        shader, output, _ = surface.GetInput(name).GetConnectedSource()
        return UsdShade.Shader(shader), output

    for name, map_name, output, space in [
        ("diffuseColor", "base_color", "rgb", "sRGB"),
        ("roughness", "orm", "g", "raw"),
        ("occlusion", "orm", "r", "raw"),
        ("normal", "normal", "rgb", "raw"),
    ]:
        shader, channel = source(name)
        assert channel == output
        assert shader.GetInput("sourceColorSpace").Get() == space
        assert shader.GetInput("file").Get().path == f"./{map_name}.png"
        assert (tmp_path / "out" / f"{map_name}.png").is_file()
    normal = source("normal")[0]
    up = 1 if convention == "opengl" else -1
    np.testing.assert_allclose(
        np.array(normal.GetInput("scale").Get()) * 0.5 + np.array(normal.GetInput("bias").Get()),
        [0, 0, 0, 0.5],
        atol=1e-6,
    )
    assert normal.GetInput("scale").Get()[1] == 2 * up
    factors = json.loads((tmp_path / "out" / "manifest.json").read_text())["content"]["factors"]
    roughness = source("roughness")[0].GetInput("scale").Get()
    assert roughness[1:3] == pytest.approx((factors["roughness"][0], factors["metallic"][0]))


def test_a_package_holds_its_maps_and_repeats_exactly(gdtool, chain, tmp_path):
    for name in ("a", "b"):
        done = gdtool("bake", chain, *FAST, "--usd", "usdz", "-o", name)
        assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(tmp_path / "a" / "asset.usdz") as package:
        assert {name.rsplit("/")[-1] for name in package.namelist()} == {
            "asset.usda",
            "base_color.png",
            "orm.png",
            "normal.png",
        }
    assert not (tmp_path / "a" / "asset.usda").exists()
    assert (tmp_path / "a" / "asset.usdz").read_bytes() == (tmp_path / "b" / "asset.usdz").read_bytes()
    moved = shutil.copy(tmp_path / "a" / "asset.usdz", tmp_path / "alone.usdz")
    from pxr import Usd

    assert Usd.Stage.Open(str(moved)).GetPrimAtPath("/asset/mesh")
