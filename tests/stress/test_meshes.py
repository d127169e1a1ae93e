"""Remesh and unwrap meshes that break things: each is finished, or refused in one line, and nothing hangs or crashes.

GDTOOL_MESHES names a folder of public meshes to run as well; without it their tests are skipped.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from gdtool.core.folder import open_folder
from gdtool.folders.mesh import read_mesh
from gdtool.geometry import topology
from tests.geometry.solids import bored_box, cube, joined, sphere, write_obj

MESHES = os.environ.get("GDTOOL_MESHES", "")
PUBLIC = sorted(p for p in Path(MESHES).rglob("*") if p.suffix.lower() in (".obj", ".ply", ".stl")) if MESHES else []
slow = pytest.mark.slow


def slab(share: float):
    """A plate whose thickness is that share of its side."""
    vertices, faces = cube()
    return vertices * [1, share, 1], faces


def fan(count: int):
    """Many triangles around one edge: no surface at all."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    vertices = np.concatenate([[[0, 0, 0], [0, 1, 0]], np.stack([np.cos(turn), 0.5 + 0 * turn, np.sin(turn)], -1)])
    return vertices, np.stack([np.zeros(count, int), np.ones(count, int), np.arange(count) + 2], -1)


def crossing():
    """Two balls that pass through each other."""
    return joined(sphere(20, 0.5), sphere(20, 0.5, (0.4, 0.1, 0)))


def opened():
    vertices, faces = sphere(24)
    return vertices, faces[faces[:, 0] % 5 > 0]


def slivers():
    """A ball with faces of no area, repeated faces and a face turned over."""
    vertices, faces = sphere(16)
    flat = np.stack([faces[:9, 0], faces[:9, 1], faces[:9, 1]], -1)
    faces = np.concatenate([faces, flat, faces[:7]])
    faces[3] = faces[3][::-1]
    return vertices, faces


def soup():
    """Triangles at random, none beside another."""
    corners = np.random.default_rng(0).random((60, 3, 3))
    return corners.reshape(-1, 3), np.arange(180).reshape(-1, 3)


def scaled(mesh, factor: float, far: float = 0.0):
    return mesh[0] * factor + far, mesh[1]


def moved(mesh, x: float, y: float):
    return mesh[0] + [x, y, 0], mesh[1]


CASES = {
    "one face": lambda: (np.eye(3), np.array([[0, 1, 2]])),
    "slivers": slivers,
}
SLOW_CASES = {
    "wall of a thousandth": lambda: slab(1e-3),
    "fan": lambda: fan(7),
    "size 1e-6": lambda: scaled(sphere(16), 1e-6),
    "size 1e6, far off": lambda: scaled(sphere(16), 1e6, 3e6),
    "crossing": crossing,
    "open": opened,
    "soup": soup,
    "wall of a hundred-thousandth": lambda: slab(1e-5),
    "fan of 200": lambda: fan(200),
    "size 1e-6 with creases": lambda: scaled(bored_box(40), 1e-6),
    "size 1e6 with creases": lambda: scaled(bored_box(40), 1e6),
    "many pieces": lambda: joined(
        *(moved(scaled(sphere(8), 0.06), 0.15 * i, 0.15 * j) for i in range(-5, 6) for j in range(-5, 6))
    ),
    "two faces": lambda: (cube()[0], cube()[1][:2]),
    "a thousand slabs thin": lambda: joined(*(scaled(slab(1e-3), 1.0, 0.01 * i) for i in range(20))),
}


def survives(gdtool, source, faces: int = 200) -> None:
    """Remesh and unwrap succeed with a valid folder, or say in one line what is wrong; an older result is not lost."""
    run = gdtool("remesh", source, "--faces", faces, "-o", "made/mesh")
    last = run.stderr.strip().splitlines()[-1:]
    assert run.returncode in (0, 3), (run.returncode, run.stderr[-500:])
    assert "Traceback" not in run.stderr
    if run.returncode:
        assert last
        assert ": " in last[0]
        assert not Path(source).with_name("made").exists()
        return
    mesh = read_mesh(open_folder(Path(source).with_name("made") / "mesh"))
    assert np.isfinite(mesh.vertices).all()
    assert mesh.is_quad.all()
    assert topology.is_manifold(mesh.faces)
    small = "--size", 256, "--padding", 1
    for stage in (("unwrap", "made/mesh", *small), ("unwrap", source, "--redo", *small, "-o", "made/own")):
        run = gdtool(*stage)
        assert run.returncode in (0, 3), run.stderr[-500:]
        assert "Traceback" not in run.stderr, run.stderr[-500:]
        if run.returncode == 0:
            report = open_folder(Path(source).with_name("made") / ("own" if "-o" in stage else "atlas")).content
            assert report.report["mirrored"] == 0
            assert report.report["overlap"] == 0
    before = (Path(source).with_name("made") / "mesh" / "manifest.json").read_bytes()
    Path(source).write_bytes(b"v 0 0 0\nf 1 2 3\n" if str(source).endswith(".obj") else b"nothing")
    assert gdtool("remesh", source, "--faces", faces, "-o", "made/mesh").returncode == 3
    assert (Path(source).with_name("made") / "mesh" / "manifest.json").read_bytes() == before


@pytest.mark.parametrize("name", [*CASES, *(pytest.param(name, marks=slow) for name in SLOW_CASES)])
def test_generated(gdtool_here, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write_obj(tmp_path / "hard.obj", *(CASES | SLOW_CASES)[name]())
    survives(gdtool_here, tmp_path / "hard.obj")


@slow
@pytest.mark.parametrize("path", PUBLIC, ids=lambda p: p.name)
def test_public(gdtool, tmp_path, path):
    copy = tmp_path / path.name.lower()
    copy.write_bytes(path.read_bytes())
    survives(gdtool, copy, 2000)


@slow
def test_five_million_faces(gdtool, tmp_path):
    import igl
    import trimesh

    from gdtool.geometry.topology import is_watertight

    vertices, faces = igl.upsample(*sphere(72), 4)  # a grid of marching cubes as fine would take tens of gigabytes
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    assert len(faces) > 5e6

    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "big.ply")
    run = gdtool("remesh", "big.ply", "--faces", 5000)
    assert run.returncode == 0, run.stderr[-500:]
    mesh = read_mesh(open_folder(tmp_path / "big.asset/mesh"))
    assert abs(len(mesh.faces) / 5000 - 1) <= 0.03
    assert is_watertight(mesh.faces)
