"""Count bodies inside other bodies, on solids whose positions are known."""

import numpy as np
import pytest

from gdtool.geometry.enclosed_bodies import enclosed_bodies, enclosed_bodies_warning
from gdtool.geometry.meshes import TriMesh
from tests.geometry.solids import cube, joined, sphere, torus


def ball(radius, centre=(0.0, 0.0, 0.0)):
    vertices, faces = sphere(20)
    return vertices * (radius / 0.8) + centre, faces


@pytest.mark.parametrize(
    "bodies, enclosed",
    [
        pytest.param([ball(0.8)], [], id="one body"),
        pytest.param([ball(0.3, (-0.5, 0, 0)), ball(0.3, (0.5, 0, 0))], [], id="two apart"),
        pytest.param([ball(0.9), ball(0.3)], [1], id="one inside"),
        pytest.param([ball(0.9), ball(0.5), ball(0.2)], [1, 2], id="nested"),
        pytest.param([ball(0.9), ball(0.2, (0.4, 0, 0)), ball(0.2, (-0.4, 0, 0))], [1, 2], id="two in one"),
        pytest.param([ball(0.6), ball(0.3, (0.6, 0, 0))], [], id="through the wall"),
        pytest.param([torus(40), ball(0.1)], [], id="in the hole of a torus"),
        pytest.param([torus(40), ball(0.1, (0.65, 0.0, 0.0))], [1], id="in the torus itself"),
    ],
)
def test_enclosed_bodies_are_counted_with_their_share_of_faces(bodies, enclosed):
    vertices, faces = joined(*bodies)
    result = enclosed_bodies(TriMesh(vertices, faces))
    assert result.bodies == len(enclosed)
    assert result.face_share == pytest.approx(sum(len(bodies[i][1]) for i in enclosed) / len(faces))


@pytest.mark.parametrize("turned", [0, 1], ids=["outer", "inner"])
def test_a_body_that_is_inside_out_counts_too(turned):
    bodies = [ball(0.9), ball(0.3)]
    bodies[turned] = bodies[turned][0], bodies[turned][1][:, ::-1]
    assert enclosed_bodies(TriMesh(*joined(*bodies))).bodies == 1


@pytest.mark.parametrize("opened", [0, 1], ids=["outer", "inner"])
def test_an_open_body_neither_encloses_nor_counts(opened):
    bodies = [ball(0.9), ball(0.3)]
    bodies[opened] = bodies[opened][0], bodies[opened][1][:-1]
    assert enclosed_bodies(TriMesh(*joined(*bodies))) == (0, 0.0)


def test_vertices_at_one_position_are_welded_on_request():
    vertices, faces = joined(cube(2.0), cube(0.5))
    soup = TriMesh(vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3))
    assert enclosed_bodies(soup) == (0, 0.0)
    assert enclosed_bodies(soup, welded=False) == (1, 0.5)


def test_the_warning_names_the_number_and_share():
    assert enclosed_bodies_warning(TriMesh(*cube())) is None
    warning = enclosed_bodies_warning(TriMesh(*joined(cube(2.0), cube(0.5))))
    assert warning.startswith("1 closed body lies inside another, with 50.0% of the faces")
