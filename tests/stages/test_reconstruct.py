"""Run gdtool reconstruct on views of analytic solids."""

import json

import numpy as np
import pytest

from gdtool.core.folder import open_folder
from gdtool.fields.grid.fusion import is_closed_manifold
from gdtool.folders.surface import read_surface
from tests.fields.shapes import material, torus, two_balls, views_folder, views_of

SIZE = 48


@pytest.fixture(scope="module")
def torus_views():
    return views_of(torus, SIZE)


@pytest.fixture
def folder(tmp_path, torus_views):
    return views_folder(tmp_path / "ring.asset" / "views", *torus_views)


def manifest(path):
    return json.loads((path / "manifest.json").read_text())


def test_writes_a_valid_surface_once(gdtool, folder, tmp_path):
    done = gdtool("reconstruct", folder)
    assert done.returncode == 0, done.stderr
    out = folder.parent / "surface"
    assert done.stdout == f"{out}\n"
    surface = read_surface(open_folder(out))
    content = manifest(out)["content"]
    assert content["watertight"]
    assert content["light"]
    assert is_closed_manifold(surface.faces)
    skipped = {s["what"]: s["reason"] for s in manifest(out)["skipped"]}
    assert skipped["surface by normals"] == "the views agree"
    assert skipped["growth of the surface"] == "no model made the views of a picture"
    assert content["report"]["grown"] == 0
    assert skipped["parts that the picture alone shows"] == "no model made the views of a picture"
    assert content["report"]["restored_share"] == 0
    assert np.abs(torus(surface.vertices)).mean() < 0.002
    albedo, roughness, metallic = material(surface.vertices)
    sure = surface.confidence > 0.5
    assert sure.mean() > 0.5
    assert np.abs(surface.albedo - albedo)[sure].mean() < 0.02
    assert np.abs(surface.roughness - roughness)[sure].mean() < 0.02
    # Six views around: none sees what the ring hides, none all of it; exact views agree.
    assert surface.views.min() == 0
    assert 2 <= surface.views.max() <= 5
    assert (surface.views[sure] > 0).all()
    assert surface.residual[surface.views == 0].max() == 0
    assert surface.residual.mean() < 0.02
    far = sure & (np.abs(surface.vertices[:, 0]) > 0.05)
    assert np.abs(surface.metallic - metallic)[far].mean() < 0.03
    assert gdtool("validate", out).returncode == 0
    second_run = gdtool("reconstruct", folder)
    assert second_run.returncode == 0
    assert "up to date" in second_run.stderr


def test_same_seed_gives_the_same_file(gdtool, folder, tmp_path):
    hashes = []
    for name in ("a", "b"):
        assert gdtool("reconstruct", folder, "-o", tmp_path / name, "--resolution", 48).returncode == 0
        hashes.append([f["sha256"] for f in manifest(tmp_path / name)["files"]])
    assert hashes[0] == hashes[1]


def test_color_alone_gives_the_visual_hull(gdtool, folder, tmp_path):
    out = tmp_path / "color"
    done = gdtool("reconstruct", folder, "--ignore", "normal,depth,albedo,roughness,metallic", "-o", out)
    assert done.returncode == 0, done.stderr
    surface = read_surface(open_folder(out))
    skipped = {s["what"]: s["reason"] for s in manifest(out)["skipped"]}
    assert "--ignore" in skipped["depth"]
    assert "--ignore" in skipped["albedo"]
    assert skipped["surface by normals"] == "there are none"
    assert manifest(out)["content"]["watertight"]
    # The hull holds the object, and is not much larger.
    assert np.abs(torus(surface.vertices)).mean() < 0.03
    assert surface.albedo.min() >= 0.02
    assert surface.albedo.max() <= 0.96
    # Color alone cannot be sure.
    assert surface.confidence.max() <= 0.5


def test_paper_method_writes_its_networks(gdtool, folder, tmp_path):
    out = tmp_path / "paper"
    done = gdtool("reconstruct", folder, "--method", "paper", "--steps", 30, "--resolution", 32, "-o", out, "-v")
    assert done.returncode == 0, done.stderr
    content = manifest(out)["content"]
    assert content["watertight"]
    surface = read_surface(open_folder(out))
    assert np.abs(torus(surface.vertices)).mean() < 0.06
    assert content["field"] == (out / "field.safetensors").exists()
    assert gdtool("validate", out).returncode == 0


def test_paper_method_without_depth_uses_depth_from_normals(gdtool, folder, tmp_path):
    out = tmp_path / "paper"
    done = gdtool(
        "reconstruct", folder, "--method", "paper", "--steps", 30, "--resolution", 32, "--ignore", "depth", "-o", out
    )
    assert done.returncode == 0, done.stderr
    skipped = {entry["what"]: entry["reason"] for entry in manifest(out)["skipped"]}
    assert skipped["volume start"] == "normal views say where the surface is"
    assert "matching of views" not in skipped
    assert manifest(out)["content"]["watertight"]
    assert np.abs(torus(read_surface(open_folder(out)).vertices)).mean() < 0.06


@pytest.mark.parametrize("method", ["grid", "paper"])
def test_normals_that_contradict_one_another_leave_the_silhouettes(gdtool, tmp_path, torus_views, method):
    """Normals are random: no matched depth is confirmed by another view."""
    cameras, images, mask = torus_views
    lies = np.random.default_rng(0).standard_normal(images["normal"].shape)
    lies = np.where(mask[..., None] > 0, lies / np.linalg.norm(lies, axis=-1, keepdims=True), 0)
    path = views_folder(tmp_path / "lies.asset" / "views", cameras, {"normal": lies.astype(np.float32)}, mask)
    done = gdtool("reconstruct", path, "--method", method, "--steps", 20, "--resolution", 32)
    assert done.returncode == 0, done.stderr
    out = path.parent / "surface"
    record = manifest(out)
    assert record["content"]["watertight"]
    assert any("do not fit together" in warning for warning in record["warnings"])
    assert {s["what"]: s["reason"] for s in record["skipped"]}[
        "surface by normals"
    ] == "the silhouettes alone give the shape"
    assert method == "grid" or "volume start" not in {entry["what"] for entry in record["skipped"]}
    assert np.abs(read_surface(open_folder(out)).vertices).max() < 0.6


def test_unknown_domain_is_a_usage_error(gdtool, folder):
    done = gdtool("reconstruct", folder, "--ignore", "dept")
    assert done.returncode == 2
    assert "dept" in done.stderr
    assert done.stdout == ""


def test_empty_masks_are_bad_input(gdtool, tmp_path):
    cameras, images, mask = views_of(two_balls, 48, 1)
    empty = views_folder(tmp_path / "nothing.asset" / "views", cameras, images, np.zeros_like(mask))
    done = gdtool("reconstruct", empty)
    assert done.returncode == 3
    assert "mask" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (empty.parent / "surface").exists()


def test_one_empty_view_is_left_out_with_a_warning(gdtool, tmp_path):
    cameras, images, mask = views_of(two_balls, 48, 1)
    mask = mask.copy()
    mask[4] = 0
    path = views_folder(tmp_path / "two.asset" / "views", cameras, images, mask)
    done = gdtool("reconstruct", path)
    assert done.returncode == 0
    assert "left: its mask is empty" in done.stderr


def test_wrong_kind_of_folder_is_bad_input(gdtool, folder):
    assert gdtool("reconstruct", folder).returncode == 0
    done = gdtool("reconstruct", folder.parent / "surface")
    assert done.returncode == 3
    assert "views" in done.stderr


def test_works_in_a_pipe(gdtool, folder):
    done = gdtool("reconstruct", "--json", "--resolution", 32, stdin=f"{folder}\n")
    assert done.returncode == 0
    assert json.loads(done.stdout)["folder"].endswith("surface")
