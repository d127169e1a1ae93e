"""Check that each texel has one owner, also where a vertex or an edge lies on its centre.

The expected owners are computed in rational arithmetic.
"""

from fractions import Fraction

import numpy as np
import pytest

from gdtool.geometry.uv_raster import (
    SUBTEXEL_BITS,
    Barycentrics,
    between_centres,
    extend_owners,
    owner_count,
    owners_of,
    rasterize_uv,
)


def grid(n: int, low: float, high: float, jitter: float = 0.0, seed: int = 0):
    """Make triangles over [low, high]² with n x n vertices; jitter moves inner vertices only."""
    rng = np.random.default_rng(seed)
    axis = np.linspace(low, high, n)
    uv = np.stack(np.meshgrid(axis, axis), -1)
    uv[1:-1, 1:-1] += rng.uniform(-jitter, jitter, (n - 2, n - 2, 2))
    idx = np.arange(n * n).reshape(n, n)
    quads = np.stack([idx[:-1, :-1], idx[:-1, 1:], idx[1:, 1:], idx[1:, :-1]], -1).reshape(-1, 4)
    return uv.reshape(-1, 2), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def exact_owner(uv, faces, size):
    """Compute owners in rational arithmetic, one texel and one triangle at a time."""
    owner = np.full((size, size), -1)
    snapped = [[Fraction(round(float(c) * size * 2**SUBTEXEL_BITS), 2**SUBTEXEL_BITS) for c in p] for p in uv]
    for k, face in enumerate(faces):
        corners = [snapped[i] for i in face]
        area = sum(corners[i - 1][0] * corners[i][1] - corners[i][0] * corners[i - 1][1] for i in range(3))
        if area == 0:
            continue
        if area < 0:
            corners = corners[::-1]
        for row in range(size):
            for column in range(size):
                p = (Fraction(2 * column + 1, 2), Fraction(2 * row + 1, 2))
                inside = True
                for i in range(3):
                    a, b = corners[i], corners[(i + 1) % 3]
                    dx, dy = b[0] - a[0], b[1] - a[1]
                    side = dx * (p[1] - a[1]) - dy * (p[0] - a[0])
                    top_left = dy < 0 or (dy == 0 and dx > 0)
                    inside &= side > 0 or (side == 0 and top_left)
                if inside and owner[row, column] < 0:
                    owner[row, column] = k
    return owner


def test_owners_agree_with_rational_arithmetic_on_degenerate_triangles():
    rng = np.random.default_rng(1)
    size = 12
    centres = (np.array([[0, 0], [5, 0], [5, 7], [11, 11], [3, 9]]) + 0.5) / size  # vertices on texel centres
    others = rng.uniform(-0.3, 1.3, (9, 2))
    uv = np.concatenate([centres, others, [[0.25, 0.25], [0.25 + 1e-5, 0.25], [0.25, 0.25 + 1e-5]]])
    faces = np.array(
        [[0, 1, 2], [0, 2, 3], [0, 3, 4], [2, 1, 0], [1, 1, 2], [0, 2, 2]]  # mirrored and degenerate ones
        + [[14, 15, 16]]
        + rng.integers(0, len(uv), (12, 3)).tolist()
    )
    owner, _ = rasterize_uv(uv, faces, size)
    np.testing.assert_array_equal(owner, exact_owner(uv, faces, size))


@pytest.mark.parametrize("size, n", [(64, 17), (64, 33), (96, 40)])
def test_shared_edges_and_vertices_on_texel_centres_are_owned_once(size, n):
    # 0.5/size … is a texel centre; with 64 texels and 33 vertices most vertices and edges pass through centres.
    uv, faces = grid(n, 0.5 / size, (size - 0.5) / size)
    count = owner_count(uv, faces, size)
    assert count.max() == 1
    # The square covers centres 0 … size-1; its right and lower rim belong to whoever would come next.
    assert (count[:-1, :-1] == 1).all()
    assert not count[-1].any()
    assert not count[:, -1].any()


def test_jittered_grid_leaves_no_hole_and_no_overlap():
    uv, faces = grid(30, 0.1, 0.9, jitter=0.01)
    count = owner_count(uv, faces, 200)
    inside = (np.arange(200) + 0.5) / 200
    inside = (inside > 0.1) & (inside < 0.9)
    np.testing.assert_array_equal(count, np.outer(inside, inside))


def test_barycentric_coordinates_reproduce_the_texel_centre():
    uv, faces = grid(9, 0.05, 0.95, jitter=0.03, seed=3)
    faces[::2] = faces[::2][:, [0, 2, 1]]  # half of them face the other way
    face_idx, barycentric = rasterize_uv(uv, faces, 128)
    row, column = np.nonzero(face_idx >= 0)
    back = (uv[faces[face_idx[row, column]]] * barycentric[row, column][..., None]).sum(1)
    np.testing.assert_allclose(back, np.stack([column + 0.5, row + 0.5], 1) / 128, atol=2e-6)
    assert barycentric.min() >= 0
    assert not barycentric[face_idx < 0].any()


def test_the_first_of_overlapping_triangles_owns_the_texel_and_all_are_counted():
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9]])
    face_idx, _ = rasterize_uv(uv, np.array([[0, 1, 2], [0, 1, 2], [0, 2, 1]]), 32)
    assert set(np.unique(face_idx)) == {-1, 0}
    assert owner_count(uv, np.array([[0, 1, 2], [0, 2, 1]]), 32).max() == 2


def test_triangles_without_area_own_nothing():
    uv = np.array([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5], [0.3, 0.3], [0.7, 0.7]])
    faces = np.array([[0, 1, 2], [0, 3, 4]])
    assert (rasterize_uv(uv, faces, 64)[0] == -1).all()
    assert np.isfinite(Barycentrics(uv, faces).at(np.array([0, 1]), np.array([0.5, 0.1]), np.array([0.5, 0.2]))).all()
    assert rasterize_uv(uv, np.empty((0, 3), int), 8)[0].max() == -1


def test_coordinates_beyond_the_map_are_clipped_and_invalid_ones_refused():
    uv = np.array([[-2.0, -2.0], [5.0, -2.0], [-2.0, 5.0]])
    assert (rasterize_uv(uv, np.array([[0, 1, 2]]), 16)[0] == 0).all()
    for bad in (np.nan, np.inf, 1e9):
        with pytest.raises(ValueError, match="finite"):
            rasterize_uv(np.array([[0, 0], [1, 0], [0, bad]]), np.array([[0, 1, 2]]), 16)


def test_owners_are_extended_linearly():
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    face_idx, _ = rasterize_uv(uv, faces, 32)
    texel, owner, barycentric = extend_owners(Barycentrics(uv, faces), face_idx, rings=2)
    inside = face_idx >= 0
    ring = np.zeros(32 * 32, bool)
    ring[texel] = True
    wide = np.zeros((32, 32), bool)
    wide[6:26, 6:26] = True
    np.testing.assert_array_equal(ring.reshape(32, 32), wide & ~inside)
    back = (uv[faces[owner]] * barycentric[..., None]).sum(1)
    np.testing.assert_allclose(back, np.stack([texel % 32 + 0.5, texel // 32 + 0.5], 1) / 32, atol=1e-9)


def test_charts_without_a_texel_centre_get_the_texels_that_they_pass_through():
    """A square, a triangle a third of a texel wide, and a sliver nine texels long and a tenth of a texel wide."""
    square = [[4, 4], [12, 4], [12, 12], [4, 12]]
    tiny = [[20.6, 6.6], [20.9, 6.6], [20.6, 6.9]]
    sliver = [[4.1, 20.05], [13.3, 20.05], [13.3, 20.15]]
    uv = np.array([*square, *tiny, *sliver]) / 32
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9]])
    owner = owners_of(uv, faces, 32).reshape(32, 32)
    assert set(np.unique(owner)) == {-1, 0, 1}
    texel, face = between_centres(uv, faces, owner)
    faces_of_texels = {(int(t) // 32, int(t) % 32): int(f) for t, f in zip(texel, face, strict=True)}
    assert faces_of_texels == {(6, 20): 2} | {(20, column): 3 for column in range(4, 14)}
    # A chart clipped by the map's border, and one next to texels that it owns, add nothing.
    assert len(between_centres(uv[:4] - 0.2, faces[:2], owners_of(uv[:4] - 0.2, faces[:2], 32).reshape(32, 32))[0]) == 0
