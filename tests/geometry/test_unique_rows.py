"""Group rows by their hashes as np.unique groups them."""

import numpy as np
import pytest

from gdtool.geometry import unique_rows


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32, np.int64])
@pytest.mark.parametrize("count, width", [(0, 3), (1, 3), (7, 1), (5000, 3)])
@pytest.mark.parametrize("mix", [unique_rows._MIX, (np.uint64(0), np.uint64(0))], ids=["hashed", "all with one hash"])
def test_rows_are_grouped_as_numpy_does(kind, count, width, mix, monkeypatch):
    monkeypatch.setattr(unique_rows, "_MIX", mix)
    array = (
        np.random.default_rng(count).integers(-6, 6, (count, width)) / (3 if np.issubdtype(kind, np.floating) else 1)
    ).astype(kind)
    array[array == 0] *= -1  # some zeros become -0
    array[: count // 3] = abs(array[: count // 3])
    distinct, first, which = unique_rows.unique_rows(array)
    true, true_first, true_which = np.unique(array + kind(0), axis=0, return_index=True, return_inverse=True)
    assert distinct.dtype == kind
    assert np.array_equal(distinct, true)
    assert not np.signbit(distinct[distinct == 0]).any()
    assert np.array_equal(first, true_first)
    assert np.array_equal(which, true_which.reshape(-1))
    assert np.array_equal(unique_rows.indices_of_distinct(array), np.sort(true_first))
    assert np.array_equal(unique_rows.index_of_first_equal(array), true_first[true_which.reshape(-1)])
    distinct_rows = array[np.sort(true_first)]
    assert np.array_equal(unique_rows.indices_of_distinct(distinct_rows), np.arange(len(distinct_rows)))
