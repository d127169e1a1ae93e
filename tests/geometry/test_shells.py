"""Bodies inside others, on solids whose places are known."""

import numpy as np
import pytest

from gdtool.geometry.shells import internal_shells
from tests.geometry.solids import cube, joined, sphere, torus


def ball(radius, centre=(0.0, 0.0, 0.0)):
    vertices, faces = sphere(20)
    return vertices * (radius / 0.8) + centre, faces


@pytest.mark.parametrize(
    "name, bodies, inside",
    [
        ("one", [ball(0.8)], []),
        ("apart", [ball(0.3, (-0.5, 0, 0)), ball(0.3, (0.5, 0, 0))], []),
        ("inside", [ball(0.9), ball(0.3)], [1]),
        ("nested", [ball(0.9), ball(0.5), ball(0.2)], [1, 2]),
        ("two in one", [ball(0.9), ball(0.2, (0.4, 0, 0)), ball(0.2, (-0.4, 0, 0))], [1, 2]),
        ("through the wall", [ball(0.6), ball(0.3, (0.6, 0, 0))], []),
        ("in the hole of a ring", [torus(40), ball(0.1)], []),
        ("in the ring itself", [torus(40), ball(0.1, (0.65, 0.0, 0.0))], [1]),
    ],
)
def test_bodies_inside_a_closed_one_are_counted_with_their_share(name, bodies, inside):
    vertices, faces = joined(*bodies)
    count, share = internal_shells(vertices, faces)
    assert count == len(inside)
    assert share == pytest.approx(sum(len(bodies[i][1]) for i in inside) / len(faces))


def test_which_way_a_body_faces_does_not_matter():
    (outer, faces), (inner, others) = ball(0.9), ball(0.3)
    for one, two in ((faces[:, ::-1], others), (faces, others[:, ::-1])):
        assert internal_shells(*joined((outer, one), (inner, two)))[0] == 1


def test_an_open_body_neither_holds_nor_counts():
    (outer, faces), (inner, others) = ball(0.9), ball(0.3)
    assert internal_shells(*joined((outer, faces[:-1]), (inner, others))) == (0, 0.0)
    assert internal_shells(*joined((outer, faces), (inner, others[:-1]))) == (0, 0.0)


def test_a_body_cut_at_its_seams_is_one_where_that_is_said():
    vertices, faces = joined(cube(2.0), cube(0.5))
    soup = vertices[faces.reshape(-1)], np.arange(faces.size).reshape(-1, 3)
    assert internal_shells(*soup) == (0, 0.0)
    assert internal_shells(*soup, welded=False) == (1, 0.5)
