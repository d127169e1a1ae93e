"""Run gdtool unwrap: a valid atlas of whole quads, up to date the second time, valid texture coordinates kept."""

import json
from pathlib import Path

import numpy as np
import pytest

from gdtool.core.folder import open_folder
from gdtool.folders.mesh import read_mesh, write_obj
from gdtool.geometry.meshes import QuadMesh
from tests.bake.shapes import torus


def content(path):
    return json.loads(Path(path, "manifest.json").read_text())["content"]


@pytest.fixture
def ring(tmp_path):
    vertices, quads, _ = torus(32, 16)
    write_obj(tmp_path / "ring.obj", QuadMesh(vertices, quads.astype(np.int32)))
    return vertices, quads


def test_atlas_of_quads(gdtool, tmp_path, ring):
    run = gdtool("unwrap", "ring.obj", "--size", 512, "--mip-safe", 128)
    assert run.returncode == 0, run.stderr
    assert run.stdout == "ring.asset/atlas\n"
    folder = open_folder(tmp_path / "ring.asset/atlas")
    mesh = read_mesh(folder)
    assert len(mesh.faces) == len(ring[1])
    assert mesh.is_quad.all()
    assert mesh.uv is not None
    atlas_content = folder.content
    assert atlas_content.padding == 4
    assert atlas_content.quads == 512
    assert atlas_content.watertight
    assert atlas_content.charts == atlas_content.report["charts"]
    assert atlas_content.report["overlap"] == 0
    assert atlas_content.report["mirrored"] == 0
    assert atlas_content.coverage > 0.3
    for picture in ("layout.png", "checkerboard.png"):
        assert folder.file(picture).stat().st_size > 1000
    assert "up to date" in gdtool("unwrap", "ring.obj", "--size", 512, "--mip-safe", 128).stderr
    assert gdtool("validate", "ring.asset/atlas").returncode == 0


def test_valid_texture_coordinates_are_kept_without_redo(gdtool, tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    uv = np.array([[0.1, 0.9], [0.4, 0.9], [0.4, 0.6], [0.1, 0.6]])
    quad = np.array([[0, 1, 2, 3]], np.int32)
    write_obj(tmp_path / "leaf.obj", QuadMesh(vertices, quad, uv, quad))
    assert gdtool("unwrap", "leaf.obj").returncode == 0
    assert read_mesh(open_folder(tmp_path / "leaf.asset/atlas")).uv == pytest.approx(uv)
    assert content(tmp_path / "leaf.asset/atlas")["report"]["kept"]
    assert gdtool("unwrap", "leaf.obj", "--redo").returncode == 0
    assert content(tmp_path / "leaf.asset/atlas")["coverage"] > 0.9


def test_mirrored_coordinates_are_kept_with_a_warning(gdtool, tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    uv = np.array([[0.4, 0.9], [0.1, 0.9], [0.1, 0.6], [0.4, 0.6]])
    quad = np.array([[0, 1, 2, 3]], np.int32)
    write_obj(tmp_path / "leaf.obj", QuadMesh(vertices, quad, uv, quad))
    run = gdtool("unwrap", "leaf.obj")
    assert run.returncode == 0
    assert "100% of the surface is mirrored" in run.stderr
    assert content(tmp_path / "leaf.asset/atlas")["report"]["mirrored"] == 1
    assert "mirrored" not in gdtool("unwrap", "leaf.obj", "--redo").stderr


@pytest.mark.slow  # after twice the limit and three seconds the run fails, which a busy machine may take
def test_a_short_time_limit_is_met_and_reported(gdtool, tmp_path, ring):
    run = gdtool("unwrap", "ring.obj", "--size", 512, "--seconds", 0.01)
    assert run.returncode == 0, run.stderr
    atlas_content = content(tmp_path / "ring.asset/atlas")
    assert atlas_content["tried"]
    assert atlas_content["report"]["overlap"] == 0
    assert atlas_content["report"]["mirrored"] == 0


def test_overlapping_coordinates_are_replaced(gdtool, tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2, 1, 0.0]])
    faces = np.array([[0, 1, 2, 3], [1, 4, 5, 2]], np.int32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]])
    write_obj(tmp_path / "twice.obj", QuadMesh(vertices, faces, uv, np.array([[0, 1, 2, 3], [0, 1, 2, 3]], np.int32)))
    run = gdtool("unwrap", "twice.obj")
    assert run.returncode == 0
    assert "overlap" in run.stderr
    assert content(tmp_path / "twice.asset/atlas")["report"]["overlap"] == 0


@pytest.mark.parametrize(
    "text, fact",
    [
        ("v 0 0 0\n", "no faces"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no face has an area"),
        ("v 0 0 0\nv 1 0 0\nv 0 inf 0\nf 1 2 3\n", "not finite"),
    ],
)
def test_bad_mesh_is_refused(gdtool, tmp_path, text, fact):
    (tmp_path / "bad.obj").write_text(text)
    run = gdtool("unwrap", "bad.obj")
    assert run.returncode == 3
    assert fact in run.stderr
    assert "Traceback" not in run.stderr


def test_wrong_kind_names_the_stage_that_makes_the_right_one(gdtool, tmp_path):
    (tmp_path / "leaf.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    assert gdtool("unwrap", "leaf.obj").returncode == 0
    run = gdtool("unwrap", "leaf.asset/atlas")
    assert run.returncode == 3
    assert "holds atlas" in run.stderr
    assert "gdtool remesh" in run.stderr


def test_symmetric_halves_share_their_texels(gdtool, tmp_path, ring):
    run = gdtool("unwrap", "ring.obj", "--size", 512, "--symmetry", "x")
    assert run.returncode == 0, run.stderr
    folder = open_folder(tmp_path / "ring.asset/atlas")
    report, mesh = folder.content.report, read_mesh(folder)
    assert report["shared"] == 0.5
    assert report["overlap"] == 0
    assert report["mirrored"] == 0

    # Each vertex' corners lie where those of its mirror image do.
    def corners_of(vertices):
        atlas_content = {}
        for vertex, corner in zip(mesh.faces.ravel(), mesh.face_uvs.ravel(), strict=True):
            atlas_content.setdefault(tuple(np.round(vertices[vertex], 6) + 0.0), set()).add(
                tuple(np.round(mesh.uv[corner], 6))
            )
        return atlas_content

    assert corners_of(mesh.vertices) == corners_of(mesh.vertices * (-1, 1, 1))
    assert gdtool("validate", "ring.asset/atlas").returncode == 0
    lopsided = ring[0] + (0.1 * ring[0][:, 1:2] ** 2 + 0.05 * ring[0][:, :1] ** 2) * (1, 0, 0)
    write_obj(tmp_path / "bent.obj", QuadMesh(lopsided, ring[1].astype(np.int32)))
    run = gdtool("unwrap", "bent.obj", "--size", 256, "--symmetry", "x")
    assert run.returncode == 0
    assert "no face mirrors another along x" in run.stderr
    assert content(tmp_path / "bent.asset/atlas")["report"]["shared"] == 0
