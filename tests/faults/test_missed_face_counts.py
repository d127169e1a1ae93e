"""Say why a mesh has another face count than asked for, and what is hidden inside it."""

import json

import numpy as np
import pytest

from gdtool.remesh.task import count_reason
from tests.geometry.solids import cube, joined, lattice, sphere, torus, write_obj


def warnings_of(folder):
    """Return the warnings of a manifest."""
    return json.loads((folder / "manifest.json").read_text())["warnings"]


def scattered(count):
    """Make a mesh of separate small spheres."""
    rng = np.random.default_rng(0)
    vertices, faces = sphere(8)
    return joined(*[(0.05 * vertices + rng.uniform(-1, 1, 3), faces) for _ in range(count)])


@pytest.mark.parametrize(
    "mesh, options, reason",
    [
        (
            scattered(20),
            ["--faces", 60],
            "it has 20 separate pieces, and each takes at least 12 faces or so (engines: not tried, 20 pieces of so "
            "few quads)",
        ),
        (torus(24), ["--faces", 16, "--engine", "split"], "fewer would close some of its 1 handles"),
        (scattered(40), ["--triangles", 100], "it has 40 separate pieces, and each takes at least 4 faces or so"),
    ],
    ids=["pieces", "handle", "triangles"],
)
def test_a_warning_says_why_a_face_count_was_missed(gdtool_here, tmp_path, mesh, options, reason):
    write_obj(tmp_path / "x.obj", *mesh)
    done = gdtool_here("remesh", "x.obj", *options, "-o", "out")
    assert done.returncode == 0, done.stderr
    warnings = [line for line in warnings_of(tmp_path / "out") if "asked for: " in line]
    assert len(warnings) == 1, done.stderr
    assert reason in warnings[0], done.stderr
    assert warnings[0] in done.stderr, done.stderr


def test_the_reason_for_a_missed_count_follows_from_the_topology():
    assert "40 separate pieces" in count_reason(scattered(40)[1], 480, 100, [])
    assert "28 handles" in count_reason(lattice()[1], 588, 200, [])
    assert (
        count_reason(cube()[1], 40, 16, ["simplify: it died"])
        == "fewer would change its shape, or its topology (simplify: it died)"
    )
    assert count_reason(cube()[1], 12, 16, []) == "no method that was tried came nearer to the count"


@pytest.mark.parametrize(
    "arguments",
    [["remesh", "x.obj", "--triangles", 200], ["render-dataset", "x.obj", "--size", 16, "--domains", "normal"]],
    ids=["remesh", "render-dataset"],
)
def test_a_warning_tells_the_share_of_faces_of_internal_shells(gdtool_here, tmp_path, arguments):
    (outer, faces), (inner, others) = sphere(16), sphere(16)
    write_obj(tmp_path / "x.obj", *joined((outer, faces), (0.4 * inner, others)))
    done = gdtool_here(*arguments, "-o", "out")
    assert done.returncode == 0, done.stderr
    warnings = [line for line in warnings_of(tmp_path / "out") if "inside another" in line]
    assert len(warnings) == 1
    assert "1 closed body lies inside another, with 50.0% of the faces" in warnings[0]


def test_a_single_body_gives_no_warning_of_internal_shells(gdtool_here, tmp_path):
    write_obj(tmp_path / "x.obj", *sphere(16))
    assert gdtool_here("remesh", "x.obj", "--triangles", 200, "-o", "out").returncode == 0
    assert not [line for line in warnings_of(tmp_path / "out") if "inside another" in line]
