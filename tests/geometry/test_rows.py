"""Equal rows found by hashes are those that np.unique finds."""

import numpy as np
import pytest

from gdtool.geometry import rows


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32, np.int64])
@pytest.mark.parametrize("count, width", [(0, 3), (1, 3), (7, 1), (5000, 3)])
@pytest.mark.parametrize("mix", [rows._MIX, (np.uint64(0), np.uint64(0))], ids=["hashed", "all of one hash"])
def test_unique_rows_are_those_of_numpy(kind, count, width, mix, monkeypatch):
    monkeypatch.setattr(rows, "_MIX", mix)
    given = (
        np.random.default_rng(count).integers(-6, 6, (count, width)) / (3 if np.issubdtype(kind, np.floating) else 1)
    ).astype(kind)
    given[given == 0] *= -1  # -0 where there is one
    given[: count // 3] = abs(given[: count // 3])
    distinct, first, which = rows.unique_rows(given)
    true, true_first, true_which = np.unique(given + kind(0), axis=0, return_index=True, return_inverse=True)
    assert distinct.dtype == kind and np.array_equal(distinct, true) and not np.signbit(distinct[distinct == 0]).any()
    assert np.array_equal(first, true_first) and np.array_equal(which, true_which.reshape(-1))
    assert np.array_equal(rows.first_rows(given), np.sort(true_first))
    assert np.array_equal(rows.first_equal(given), true_first[true_which.reshape(-1)])
    some = given[np.sort(true_first)]
    assert np.array_equal(rows.first_rows(some), np.arange(len(some)))
