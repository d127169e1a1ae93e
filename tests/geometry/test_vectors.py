"""Compare products of vectors stored coordinate by coordinate with numpy's."""

import numpy as np

from gdtool.geometry.vectors import cross, dot


def test_products_agree_with_numpy_and_keep_the_dtype():
    rng = np.random.default_rng(0)
    for kind in (np.float32, np.float64):
        a, b = rng.normal(size=(2, 3, 50)).astype(kind)
        assert cross(a, b).dtype == dot(a, b).dtype == kind
        assert np.allclose(cross(a, b).T, np.cross(a.T, b.T), atol=1e-6 if kind == np.float32 else 1e-15)
        assert np.allclose(dot(a, b), (a * b).sum(0), atol=1e-6 if kind == np.float32 else 1e-15)


def test_three_arrays_work_like_one_and_a_single_vector_broadcasts():
    a, b = np.random.default_rng(1).normal(size=(2, 3, 4, 50))
    assert (cross(list(a), tuple(b)) == cross(a, b)).all()
    assert (dot(list(a), tuple(b)) == dot(a, b)).all()
    one = b[:, :1, :1]
    assert cross(a, one).shape == a.shape
    assert (cross(a, one)[:, 2, 3] == cross(a[:, 2, 3:4], one[:, 0, :])[:, 0]).all()
    assert dot(a, b[:, 0]).shape == (4, 50)
