"""Features: creases are where the surface turns, not where simplifying folded a sliver over."""

import numpy as np
import pytest

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.sharpen import dihedral_degrees
from gdtool.remesh.fit.feature_curves import Features, _clean_arcs, find_features, trace_features
from tests.geometry.solids import cube

FACES = np.array([(0, 1, 4), (1, 2, 4), (0, 4, 2), (0, 2, 3)])


def square(turned_degrees: float) -> np.ndarray:
    """Make a square of two halves, one turned about the diagonal 0-2.

    Vertex 4 lies past the diagonal, so that (0, 4, 2) is a folded sliver.
    """
    angle = np.radians(turned_degrees)
    along, side = np.array([1, 1, 0]) / 2**0.5, np.array([-1, 1, 0]) / 2**0.5
    tip = along / 2**0.5 + (side * np.cos(angle) + np.array([0, 0, 1]) * np.sin(angle)) / 2**0.5
    middle = along / 2**0.5 + 0.01 * side
    return np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), tip, middle])


def test_a_folded_sliver_is_no_crease():
    vertices = square(0.0)
    assert dihedral_degrees(TriMesh(vertices, FACES))[2].max() > 170
    assert dihedral_degrees(TriMesh(vertices, FACES), 0.05)[2].max() < 1e-5
    boundary = find_features(TriMesh(vertices, FACES), 30.0, 0.1)
    on_rim = [tuple(sorted(np.round(boundary.points[s].sum(1), 6))) for s in boundary.segments]
    assert sorted(on_rim) == [(0, 1), (0, 1), (1, 2), (1, 2)]


def test_a_crease_beside_a_sliver_is_kept():
    ends, _, angle = dihedral_degrees(TriMesh(square(60.0), FACES), 0.05)
    at = {tuple(sorted(pair)): degrees for pair, degrees in zip(ends.tolist(), angle, strict=True)}
    assert at[0, 2] < 1e-5
    assert at[0, 4] == pytest.approx(60)
    assert at[2, 4] == pytest.approx(60)
    assert at[1, 4] < 1e-5


def test_corners_in_a_row_are_not_all_contracted_into_one():
    """A comb: teeth an edge apart stand on a spine of arcs that are all too short to follow."""
    teeth, length, short = 21, 10, 1.5
    points = np.array([(x, y, 0.0) for x in range(teeth) for y in range(length)])
    root = length * np.arange(teeth)
    segments = np.concatenate(
        [np.stack([root[:-1], root[1:]], -1)] + [np.stack([root + y, root + y + 1], -1) for y in range(length - 1)]
    )
    features = _clean_arcs(points, segments, short)
    ends = features.points[features.segments]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() <= 1 + short
    # No tooth is lost, and several corners remain on the spine.
    assert (features.points[:, 1] == length - 1).sum() == teeth
    assert 1 < len(np.unique(ends[ends[..., 1] == 0], axis=0)) < teeth


def plate(thickness: float) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = cube()
    return vertices * (1, 1, thickness), faces


@pytest.mark.parametrize("thickness", [0.005, 0.014])
def test_both_rims_of_a_thin_plate_are_kept(thickness):
    """Contracting the plate's short edges would bend its rims by as much."""
    vertices, faces = plate(thickness)
    features = find_features(TriMesh(vertices, faces), 30.0, 0.03)
    length = np.linalg.norm(features.points[features.segments[:, 0]] - features.points[features.segments[:, 1]], axis=1)
    assert len(features.corners) == 8
    assert length.sum() == pytest.approx(8 + 4 * thickness)
    assert features.share_in_strips(2 * thickness) == pytest.approx(8 / (8 + 4 * thickness))
    assert features.share_in_strips(thickness / 2) == 0


def test_a_curve_is_traced_even_if_another_corner_takes_its_vertex():
    """Two corners share their nearest vertex of the grid: both curves get a path, one from the vertex beside it."""
    side = 21
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    vertices = np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float)
    at = np.arange(side**2).reshape(side, side)
    faces = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    points = np.array([(3.0, 10.1, 0), (17.0, 10.0, 0), (3.0, 10.3, 0), (17.0, 11.0, 0)])
    features = Features(points, np.array([(0, 1), (2, 3)]), np.array([0, 1]), np.arange(4))
    _, constraints = trace_features(QuadMesh(vertices, faces), features, 1.0)
    for curve in (0, 1):
        path = vertices[constraints.path[constraints.path_curve == curve]].reshape(-1, 3)
        assert len(path)
        assert path[:, 0].min() <= 4
        assert path[:, 0].max() == 17
