"""Run gdtool remesh on files and folders: a valid folder, up to date the second time, one error line for bad input."""

import json
from pathlib import Path

import numpy as np
import pytest

from gdtool.core.folder import open_folder
from gdtool.folders.mesh import read_mesh
from gdtool.geometry import topology
from tests.geometry.solids import bored_box, cube, joined, sphere, write_obj


def content(path):
    return json.loads(Path(path, "manifest.json").read_text())["content"]


def test_obj_to_quads_in_its_normalised_frame(gdtool, tmp_path):
    vertices, faces = sphere(32)
    write_obj(tmp_path / "ball.obj", vertices * 100 + [5, 0, 0], faces)
    run = gdtool("remesh", "ball.obj", "--faces", 600)
    assert run.returncode == 0, run.stderr
    assert run.stdout == "ball.asset/mesh\n"
    folder = open_folder(tmp_path / "ball.asset/mesh")
    mesh = read_mesh(folder)
    assert abs(len(mesh.faces) / 600 - 1) <= 0.03
    assert mesh.is_quad.all()
    assert topology.is_watertight(mesh.faces)
    assert np.ptp(mesh.vertices, 0).max() == pytest.approx(1, abs=0.02)
    assert folder.content.watertight
    assert folder.content.triangles == 0
    matrix = np.array(folder.content.source_from_world).reshape(4, 4)
    assert matrix[:3, 3] == pytest.approx([5, 0, 0], abs=0.1)
    assert matrix[0, 0] == pytest.approx(160, rel=0.01)
    assert folder.content.report["distance_mean"] < 0.01
    second_run = gdtool("remesh", "ball.obj", "--faces", 600)
    assert second_run.stdout == run.stdout
    assert "up to date" in second_run.stderr
    stale = gdtool("remesh", "ball.obj", "--faces", 700)
    assert "600" in stale.stderr
    assert "700" in stale.stderr
    assert gdtool("validate", "ball.asset/mesh").returncode == 0


def test_triangles_only_decimates(gdtool, tmp_path):
    write_obj(tmp_path / "ball.obj", *sphere(24))
    assert gdtool("remesh", "ball.obj", "--triangles", 300).returncode == 0
    mesh_content = content(tmp_path / "ball.asset/mesh")
    assert mesh_content["quads"] == 0
    assert 250 <= mesh_content["triangles"] <= 300
    assert mesh_content["watertight"]


def test_a_mesh_that_meets_the_request_is_passed_through(gdtool, tmp_path):
    from tests.bake.shapes import torus

    vertices, quads, _ = torus(40, 20)
    write_obj(tmp_path / "ring.obj", vertices, quads)
    run = gdtool("remesh", "ring.obj", "--faces", 800, "-v")
    assert run.returncode == 0
    assert "already is 800 quads" in run.stderr
    mesh_content = content(tmp_path / "ring.asset/mesh")
    assert mesh_content["engine"] == "passed through"
    assert mesh_content["quads"] == 800


def test_broken_mesh_is_repaired_and_says_so(gdtool, tmp_path):
    left, right = sphere(20, 0.4, (-0.5, 0, 0)), sphere(20, 0.4, (0.5, 0, 0))
    vertices, faces = joined(left, right)
    faces = np.concatenate([faces, faces[:3], [[7, 7, 8]]])
    faces[10] = faces[10][::-1]
    write_obj(tmp_path / "two.obj", vertices, faces)
    run = gdtool("remesh", "two.obj", "--faces", 500)
    assert run.returncode == 0
    assert "duplicate faces" in run.stderr
    mesh_content = content(tmp_path / "two.asset/mesh")
    assert mesh_content["watertight"]
    assert mesh_content["report"]["pieces"] == 2


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_huge_and_tiny_coordinates_are_normalised(gdtool, tmp_path, scale):
    vertices, faces = cube(scale)
    write_obj(tmp_path / "cube.obj", vertices, faces)
    run = gdtool("remesh", "cube.obj", "--faces", 200)
    assert run.returncode == 0, run.stderr
    assert content(tmp_path / "cube.asset/mesh")["watertight"]


@pytest.mark.parametrize(
    "text, fact",
    [
        ("v 0 0 0\n", "no faces"),
        ("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "out of range"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has an area"),
    ],
)
def test_bad_mesh_is_refused(gdtool, tmp_path, text, fact):
    (tmp_path / "bad.obj").write_text(text)
    run = gdtool("remesh", "bad.obj")
    assert run.returncode == 3
    assert fact in run.stderr
    assert run.stdout == ""
    assert "Traceback" not in run.stderr
    assert not [p for p in (tmp_path / "bad.asset").rglob("*") if p.is_file()]


def test_count_by_the_size_of_quads_or_by_their_distance(gdtool, tmp_path):
    write_obj(tmp_path / "ball.obj", *sphere(32))
    run = gdtool("remesh", "ball.obj", "--quad-size", 0.06, "-o", "sized")
    assert run.returncode == 0, run.stderr
    # The sphere of diameter 1 has area pi.
    assert abs(content(tmp_path / "sized")["quads"] * 0.06**2 / np.pi - 1) < 0.06
    run = gdtool("remesh", "ball.obj", "--faces", 3000, "--max-deviation", 0.008, "-o", "near")
    assert run.returncode == 0, run.stderr
    assert "farther" not in run.stderr, run.stderr
    near = content(tmp_path / "near")
    assert near["quads"] < 1500
    assert near["watertight"]
    assert near["report"]["hausdorff"] < 0.012
    run = gdtool("remesh", "ball.obj", "--faces", 100, "--max-deviation", 0.0001, "-o", "far")
    assert run.returncode == 0
    assert "farther than --max-deviation" in run.stderr


def test_symmetry_is_kept_when_asked(gdtool, tmp_path):
    vertices, faces = bored_box(48)
    write_obj(tmp_path / "box.obj", vertices, faces)
    assert gdtool("remesh", "box.obj", "--faces", 1500, "--symmetry", "z").returncode == 0
    mesh, mesh_content = read_mesh(open_folder(tmp_path / "box.asset/mesh")), content(tmp_path / "box.asset/mesh")
    assert mesh_content["report"]["symmetry"] == "z"
    assert mesh_content["watertight"]
    assert abs(len(mesh.faces) / 1500 - 1) <= 0.03
    place = {tuple(point): i for i, point in enumerate(np.round(mesh.vertices, 6).tolist())}
    other = np.array([place[x, y, -z if z else 0.0] for x, y, z in np.round(mesh.vertices, 6).tolist()])
    corners = {frozenset(face) for face in mesh.faces.tolist()}
    assert {frozenset(face) for face in other[mesh.faces].tolist()} == corners
    assert 0 < (other == np.arange(len(other))).sum() < 200


def test_a_missing_symmetry_is_ignored_with_a_message(gdtool, tmp_path):
    vertices, faces = sphere(24)
    vertices[vertices[:, 0] > 0.3] *= [1.3, 1, 1]
    write_obj(tmp_path / "egg.obj", vertices, faces)
    assert gdtool("remesh", "egg.obj", "--faces", 400, "--symmetry", "x").returncode == 0
    manifest = json.loads((tmp_path / "egg.asset/mesh/manifest.json").read_text())
    assert any(skip["what"] == "symmetry" and "apart across x" in skip["reason"] for skip in manifest["skipped"])
    assert manifest["content"]["report"]["symmetry"] == "none"
    assert gdtool("remesh", "egg.obj", "--faces", 400, "--symmetry", "auto").returncode == 0
    assert content(tmp_path / "egg.asset/mesh")["report"]["symmetry"] in ("y", "z")
