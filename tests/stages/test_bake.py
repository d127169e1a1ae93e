"""Run gdtool bake on an atlas of a torus, with the surface and the views that it was made from."""

import json
from pathlib import Path

import numpy as np
import pytest

from gdtool.cameras import rig
from gdtool.core.folder import open_folder
from gdtool.folders.mesh import write_obj
from gdtool.folders.views import Views, write_views
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.images.io import read_image, write_png
from tests.bake.shapes import psnr
from tests.stages.bake_folders import finish, fresh, make_chain, torus_atlas, torus_views, write_atlas

FAST = ("--size", 128, "--ao-rays", 16)


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    """Write the folders of a torus once; each test bakes to a place of its own."""
    return make_chain(tmp_path_factory.mktemp("chain") / "ring.asset")


def rendered_albedo(asset: Path, views: Views | None = None, facing: float = 0.0) -> float:
    """Measure the PSNR of the base color, in sRGB, over the pixels of the views in which the surface faces them."""
    from gdtool.assets.load import load_scene
    from gdtool.cameras import rays
    from gdtool.geometry.rays import RayCaster
    from gdtool.images.color import srgb_from_linear
    from gdtool.shading.render.surface_points import SurfaceLookup

    scene, views = load_scene(asset / "asset.glb"), views or torus_views()
    lookup, caster = SurfaceLookup(scene), RayCaster(TriMesh(scene.vertices, scene.faces))
    ours, theirs = [], []
    for k, camera in enumerate(views.cameras):
        origins, directions = rays(camera)
        hits = caster.first_hit(origins.reshape(-1, 3), directions.reshape(-1, 3))
        both = (
            hits.is_hit
            & (views.mask[k].ravel() > 0)
            & (views.images["normal"][k].reshape(-1, 3) @ camera.backward >= facing)
        )
        ours.append(lookup.attributes(hits.face_idx[both], hits.barycentric[both])["albedo"])
        theirs.append(views.images["albedo"][k].reshape(-1, 3)[both])
    return psnr(srgb_from_linear(np.concatenate(ours)), srgb_from_linear(np.concatenate(theirs)))


def test_writes_a_folder_that_validates_and_skips_the_second_time(gdtool, chain, tmp_path):
    done = gdtool("bake", chain, *FAST, "-o", "out")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "out\n"
    check = gdtool("validate", "out")
    assert check.returncode == 0, check.stderr + check.stdout
    content = open_folder(tmp_path / "out").content
    assert content.maps == {"base_color": "base_color.png", "orm": "orm.png", "normal": "normal.png"}
    assert content.factors["metallic"] == (0.0,)
    assert content.factors["base_color"] == (1, 1, 1, 1)
    assert content.report["materials_from"].startswith("views: albedo")
    before = (tmp_path / "out" / "asset.glb").read_bytes()
    second_run = gdtool("bake", chain, *FAST, "-o", "out")
    assert second_run.returncode == 0
    assert "up to date" in second_run.stderr
    other = gdtool("bake", chain, *FAST, "-o", "twin")
    assert other.returncode == 0
    assert (tmp_path / "twin" / "asset.glb").read_bytes() == before
    assert rendered_albedo(tmp_path / "out") > 28


def test_materials_come_from_views_where_vertices_have_none(gdtool, tmp_path):
    atlas = make_chain(tmp_path / "gray.asset", gray_vertices=True)
    assert gdtool("bake", atlas, *FAST, "--no-ao", "-o", "with").returncode == 0
    assert gdtool("bake", atlas, *FAST, "--no-ao", "--no-project-views", "-o", "without").returncode == 0
    assert rendered_albedo(tmp_path / "with") > 26 > 20 > rendered_albedo(tmp_path / "without")
    skipped = {skip.what: skip.reason for skip in open_folder(tmp_path / "without").manifest.skipped}
    assert skipped["views"] == "left out by --no-project-views"
    assert "occlusion" in skipped


def test_a_picture_finer_than_its_view_is_baked(gdtool, tmp_path):
    """Views are blurred, their picture is sharp: the asset is sharp where the front view sees it."""
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.metrics import resized_views

    atlas = make_chain(tmp_path / "gray.asset", gray_vertices=True)
    fine = torus_views(384)
    striped = (
        np.where(np.arange(384) // 6 % 2, 0.9, 0.15).astype(np.float32)[None, None, :, None]
        * fine.mask[..., None]
        * np.float32([1, 0.8, 0.6])
    )
    images, mask = resized_views({**fine.images, "albedo": striped}, fine.mask, 96, 96)
    for atlas_kind in ("plain", "pictured"):
        folder = tmp_path / atlas_kind
        out = fresh(folder)
        if atlas_kind == "pictured":
            write_png(
                out.path("picture.png"), np.concatenate([srgb_from_linear(striped[0]), fine.mask[0][..., None]], -1)
            )
        write_views(out, Views(rig("six", 96), images, mask), picture="front" if atlas_kind == "pictured" else "")
        finish(folder, "views", out.content, {})
        done = gdtool("bake", atlas, "--size", 512, "--no-ao", "--views", folder, "-o", f"from_{atlas_kind}")
        assert done.returncode == 0, done.stderr
    assert gdtool("validate", tmp_path / "pictured").returncode == 0
    front = Views(fine.cameras[:1], {"albedo": striped[:1], "normal": fine.images["normal"][:1]}, fine.mask[:1])
    plain, pictured = (
        rendered_albedo(tmp_path / f"from_{atlas_kind}", front, facing=0.8) for atlas_kind in ("plain", "pictured")
    )
    assert pictured > plain + 3
    report = [
        open_folder(tmp_path / f"from_{atlas_kind}").content.report["materials_from"]
        for atlas_kind in ("plain", "pictured")
    ]
    assert ["picture" in text for text in report] == [False, True]
    skipped = {skip.what: skip.reason for skip in open_folder(tmp_path / "from_plain").manifest.skipped}
    assert skipped["picture"] == "the views' folder holds none"
    write_png(tmp_path / "pictured" / "picture.png", np.ones((100, 100, 4)))
    wrong = gdtool("bake", atlas, *FAST, "--views", tmp_path / "pictured", "-o", "never")
    assert wrong.returncode == 3
    assert "picture.png" in wrong.stderr


def test_without_views_materials_come_from_vertices_with_a_message(gdtool, tmp_path):
    atlas = make_chain(tmp_path / "ring.asset", with_views=False)
    done = gdtool("bake", *FAST, "--json", stdin=f"{atlas}\n")
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["kind"] == "asset"
    assert Path(record["folder"]) == atlas.parent / "asset"
    assert any("none along the provenance chain" in skip for skip in record["skipped"])
    base = read_image(atlas.parent / "asset" / "base_color.png")
    assert base.shape == (128, 128, 3)
    assert base.min() > 40  # no black, gutters included; albedo's darkest is 0.1


def test_quads_stay_quads_and_options_change_the_files(gdtool, chain, tmp_path):
    done = gdtool("bake", chain, *FAST, "--bits", 16, "--normal-convention", "directx", "-o", "dx")
    assert done.returncode == 0, done.stderr
    assert gdtool("bake", chain, *FAST, "--bits", 16, "-o", "gl").returncode == 0
    dx, gl = (read_image(tmp_path / one / "normal.png") for one in ("dx", "gl"))
    assert dx.dtype == np.uint16
    np.testing.assert_array_equal(dx[..., 1], 65535 - gl[..., 1])
    np.testing.assert_array_equal(dx[..., 0], gl[..., 0])
    obj, library = (tmp_path / "gl" / "asset.obj").read_text().splitlines(), (tmp_path / "gl" / "asset.mtl").read_text()
    mesh = torus_atlas()
    assert sum(line.startswith("f ") and len(line.split()) == 5 for line in obj) == mesh.is_quad.sum() > 500
    for line in ("map_Kd base_color.png", "map_Pr -imfchan g orm.png", "norm normal.png"):
        assert line in library.splitlines()


def test_source_frame_undoes_the_normalisation(gdtool, tmp_path):
    from gdtool.assets.load import load_scene

    atlas = make_chain(tmp_path / "ring.asset", with_views=False)
    manifest = json.loads((atlas / "manifest.json").read_text())
    turn = [[0, 0, 10, 3], [0, 10, 0, 4], [-10, 0, 0, 5], [0, 0, 0, 1]]
    manifest["content"]["source_from_world"] = [float(x) for row in turn for x in row]
    (atlas / "manifest.json").write_text(json.dumps(manifest))
    assert gdtool("bake", atlas, *FAST, "--no-ao", "-o", "own").returncode == 0
    done = gdtool("bake", atlas, *FAST, "--no-ao", "--source-frame", "-o", "source")
    assert done.returncode == 0, done.stderr
    normalised, source = (load_scene(tmp_path / one / "asset.glb") for one in ("own", "source"))
    matrix = np.array(turn, float)
    np.testing.assert_allclose(source.vertices, normalised.vertices @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-4)
    np.testing.assert_allclose(source.normals, normalised.normals @ matrix[:3, :3].T / 10, atol=1e-5)
    assert open_folder(tmp_path / "source").content.frame == "source"


def test_bakes_a_textured_model_that_was_remeshed(gdtool, chain, tmp_path):
    # What bake writes is itself a model with textures: bake it again into another atlas.
    assert gdtool("bake", chain, "--size", 256, "--no-ao", "-o", "first").returncode == 0
    write_atlas(tmp_path / "again", {})
    done = gdtool("bake", "again", *FAST, "--model", "first/asset.glb", "-o", "second")
    assert done.returncode == 0, done.stderr
    assert rendered_albedo(tmp_path / "second") > 26
    assert open_folder(tmp_path / "second").content.report["materials_from"] == "model"
    # Remeshed from a model file, an atlas has that file at the start of its chain.
    write_atlas(tmp_path / "remeshed", {"source": tmp_path / "first" / "asset.glb"})
    done = gdtool("bake", "remeshed", *FAST, "-o", "third")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "third" / "asset.glb").read_bytes() == (tmp_path / "second" / "asset.glb").read_bytes()


def test_a_mesh_file_in_either_frame_finds_the_surface(gdtool, tmp_path):
    from gdtool.assets.load import load_scene

    make_chain(tmp_path / "ring.asset", with_views=False)
    manifest = json.loads((tmp_path / "ring.asset/surface/manifest.json").read_text())
    manifest["content"]["source_from_world"] = [100.0, 0, 0, 7, 0, 100, 0, 0, 0, 0, 100, 0, 0, 0, 0, 1]
    (tmp_path / "ring.asset/surface/manifest.json").write_text(json.dumps(manifest))
    mesh = torus_atlas()
    write_obj(tmp_path / "normalised.obj", mesh)
    write_obj(tmp_path / "source.obj", QuadMesh(mesh.vertices * 100 + (7, 0, 0), mesh.faces, mesh.uv, mesh.face_uvs))
    maps = []
    for name in ("normalised", "source"):
        done = gdtool("bake", f"{name}.obj", "--surface", "ring.asset/surface", *FAST, "--no-ao", "-o", name)
        assert done.returncode == 0, done.stderr
        maps.append(read_image(tmp_path / name / "base_color.png").astype(int))
        assert np.abs(load_scene(tmp_path / name / "asset.glb").vertices).max() < 0.6
    assert np.abs(maps[0] - maps[1]).max() <= 1


def test_maps_that_do_not_fit_are_refused_with_the_figure(monkeypatch):
    from gdtool.bake.maps import require_map_memory
    from gdtool.core.errors import ResourceError

    monkeypatch.setattr(Path, "read_text", lambda self, *_: "MemTotal: 9 kB\nMemAvailable:   1048576 kB\n")
    require_map_memory("ring", 2048)
    with pytest.raises(ResourceError, match=r"4096 texels need about 2 GB of memory, 1 GB are free; lower --size"):
        require_map_memory("ring", 4096)


def test_broken_faces_do_not_stop_the_bake(gdtool, chain, tmp_path):
    mesh = torus_atlas()
    faces, uvs = mesh.faces.copy(), mesh.face_uvs.copy()
    faces[3, 1] = faces[3, 0]  # two corners in one place
    faces[5, :3] = faces[5, 0]  # and three
    uvs[7] = uvs[7, 0]  # no area in the map
    faces[9], uvs[9] = faces[8], uvs[8]  # twice the same
    faces[11], uvs[11] = faces[11][[0, 3, 2, 1]], uvs[11][[0, 3, 2, 1]]  # inside out
    write_atlas(tmp_path / "atlas", {"source": chain.parent / "surface"}, QuadMesh(mesh.vertices, faces, mesh.uv, uvs))
    done = gdtool("bake", "atlas", *FAST, "-o", "out")
    assert done.returncode == 0, done.stderr
    assert gdtool("validate", "out").returncode == 0
    assert rendered_albedo(tmp_path / "out") > 25


@pytest.mark.parametrize(
    "fault, code, message",
    [
        ("no uv", 3, "has no texture coordinates; run gdtool unwrap"),
        ("no surface", 3, "has no surface to bake from along its provenance chain; name one with --surface or --model"),
        ("no texel", 3, "cover no texel; run gdtool unwrap"),
        ("not there", 3, "does not exist"),
        ("size", 2, "--size"),
    ],
)
def test_bad_input_exits_with_one_line(gdtool, chain, tmp_path, fault, code, message):
    mesh, surface, options = torus_atlas(), ("--surface", chain.parent / "surface"), ()
    if fault == "no uv":
        mesh = QuadMesh(mesh.vertices, mesh.faces)
    elif fault == "no surface":
        surface = ()
    elif fault == "no texel":
        mesh = QuadMesh(mesh.vertices, mesh.faces, mesh.uv * 1e-6, mesh.face_uvs)
    elif fault == "size":
        options = ("--size", 1)
    if fault != "not there":
        write_obj(tmp_path / "low.obj", mesh)
    done = gdtool("bake", "low.obj", *surface, *options)
    assert done.returncode == code, done.stderr
    assert message in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    if code == 3:
        assert len(done.stderr.strip().splitlines()[-1:]) == 1
    assert not (tmp_path / "low.asset" / "asset").exists()


def test_overlapping_texture_coordinates_are_reported(gdtool, chain, tmp_path):
    mesh = torus_atlas()
    half = len(mesh.faces) // 2
    folded = mesh.face_uvs.copy()
    folded[half : half * 2] = folded[:half]
    write_atlas(
        tmp_path / "atlas",
        {"source": chain.parent / "surface"},
        QuadMesh(mesh.vertices, mesh.faces[mesh.is_quad], mesh.uv, folded[mesh.is_quad]),
    )
    done = gdtool("bake", "atlas", *FAST, "--no-ao", "-o", "out")
    assert done.returncode == 0
    assert "texture coordinates overlap on" in done.stderr


def test_levels_of_detail_share_the_maps(gdtool, chain, tmp_path):
    from gdtool.assets.load import load_scene

    done = gdtool("bake", chain, *FAST, "--no-ao", "--lods", 3, "--normal-convention", "directx", "-o", "out")
    assert done.returncode == 0, done.stderr
    assert gdtool("validate", "out").returncode == 0
    content = open_folder(tmp_path / "out").content
    assert content.lods == ("asset_lod1.glb", "asset_lod2.glb")
    full = load_scene(tmp_path / "out" / "asset.glb")
    for k, name in enumerate(content.lods, 1):
        level = load_scene(tmp_path / "out" / name)
        assert abs(len(level.faces) - len(full.faces) / 2**k) < 0.02 * len(full.faces)
        assert (tmp_path / "out" / name).stat().st_size < 0.7 * (tmp_path / "out" / "asset.glb").stat().st_size
        # The same picture, and the normal map the way glTF has it, whatever lies beside it for others.
        for one, other in (
            (level.materials[0].base_color_texture, full.materials[0].base_color_texture),
            (level.materials[0].normal_texture, full.materials[0].normal_texture),
        ):
            np.testing.assert_array_equal(one.image, other.image)
        assert content.report[f"lod{k}_drift_mean"] < 0.008 * k
        assert content.report[f"lod{k}_outside"] < 0.01
    assert gdtool("bake", chain, *FAST, "--no-ao", "-o", "one").returncode == 0
    assert not list((tmp_path / "one").glob("*lod*"))
    assert open_folder(tmp_path / "one").content.lods == ()


def test_height_and_confidence_are_written_when_asked_for(gdtool, chain, tmp_path):
    assert gdtool("bake", chain, *FAST, "--no-ao", "--height", "--confidence", "-o", "out").returncode == 0
    assert gdtool("validate", "out").returncode == 0
    content = open_folder(tmp_path / "out").content
    height, confidence = read_image(tmp_path / "out/height.png"), read_image(tmp_path / "out/confidence.png")
    assert height.dtype == np.uint16
    assert height.shape == (128, 128, 1)
    assert confidence.shape == (128, 128, 1)
    # The mesh is a coarse torus about the fine one: what is cut off at its edges and corners is that of the chords.
    assert 0.0005 < content.factors["height"][0] < 0.02
    assert height.max() > 60000 or height.min() < 6000
    assert np.median(confidence) == 255


def test_size_follows_the_detail_of_the_source(gdtool, chain, tmp_path):
    assert gdtool("bake", chain, "--no-ao", "-o", "views").returncode == 0
    # Views of 96 pixels over 1.44, but vertices 0.013 apart: half of that on an atlas of this torus.
    content = open_folder(tmp_path / "views").content
    assert content.size == 512
    assert 0.005 < content.report["detail"] < 0.0075
    # A texel that is as wide as the detail needs one sample, one of eight times that width several.
    skipped = {skip.what: skip.reason for skip in open_folder(tmp_path / "views").manifest.skipped}
    assert content.report["samples"] == 1
    assert "times as wide as the source's detail" in skipped["more samples"]
    assert gdtool("bake", chain, "--size", 64, "--no-ao", "-o", "small").returncode == 0
    small = open_folder(tmp_path / "small")
    assert small.content.report["samples"] == 4
    assert small.content.report["supersampled_share"] > 0.2
    assert "more samples" not in {skip.what for skip in small.manifest.skipped}
    assert gdtool("bake", chain, "--size", 1024, "--no-ao", "-o", "large").returncode == 0
    write_atlas(tmp_path / "again", {})
    done = gdtool("bake", "again", "--model", "large/asset.glb", "--no-ao", "-o", "second")
    assert done.returncode == 0, done.stderr
    assert open_folder(tmp_path / "second").content.size == 1024


def test_emission_is_baked(gdtool, chain, tmp_path):
    from dataclasses import replace

    from gdtool.assets.gltf.write import write_glb
    from gdtool.assets.load import load_scene
    from gdtool.assets.scene import Texture

    assert gdtool("bake", chain, *FAST, "--no-ao", "-o", "first").returncode == 0
    scene = load_scene(tmp_path / "first/asset.glb")
    rows = np.broadcast_to(np.where(np.arange(128) < 64, 255, 0)[:, None, None], (128, 128, 3)).astype(np.uint8)
    write_atlas(tmp_path / "again", {})
    for name, texture, expected in (("map", Texture(rows, "srgb"), {"emissive": "emissive.png"}), ("factor", None, {})):
        shining = replace(scene.materials[0], emissive=(3.0, 3.0, 3.0), emissive_texture=texture)
        write_glb(tmp_path / f"{name}.glb", replace(scene, materials=(shining,)))
        done = gdtool("bake", "again", *FAST, "--no-ao", "--model", f"{name}.glb", "-o", name)
        assert done.returncode == 0, done.stderr
        content = open_folder(tmp_path / name).content
        assert {key: file for key, file in content.maps.items() if key == "emissive"} == expected
        assert content.factors["emissive"] == pytest.approx((3, 3, 3), rel=1e-3)
        material = load_scene(tmp_path / name / "asset.glb").materials[0]
        assert material.emissive == pytest.approx((3, 3, 3), rel=1e-3)
        assert (material.emissive_texture is None) == (texture is None)
        assert "Ke 3 3 3" in (tmp_path / name / "asset.mtl").read_text()
