"""Find equal rows of an array by sorting a hash of each row.

np.unique(axis=0) sorts the rows themselves, which takes ten times as long.
"""

from __future__ import annotations

import numpy as np

# Odd multipliers of SplitMix64 (geometry.hashing): its increment, and the first of its finalizer.
_MIX = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9)


def unique_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the distinct rows, as np.unique(rows, axis=0, return_index=True, return_inverse=True) does.

    rows (n, k): integers, or floating point without NaN; 0 and -0 are equal. Returns the distinct rows (u, k) in
    rising order, the index (u,) of the first row equal to each, and for every row (n,) which distinct row it is.
    """
    rows = np.asarray(rows)
    words = _words(rows)
    first, group = _group_equal(words)
    rising = np.lexsort(words.take(first, 0).T[::-1])
    rank = np.empty(len(first), np.int64)
    rank[rising] = np.arange(len(first))
    return words.take(first.take(rising), 0).astype(rows.dtype), first.take(rising), rank.take(group)


def index_of_first_equal(rows: np.ndarray) -> np.ndarray:
    """Return for each of rows (n, k) the index (n,) of the first row equal to it.

    The same as the second result of unique_rows() taken at the third, in half the time.
    """
    first, group = _group_equal(_words(np.asarray(rows)))
    return first.take(group)


def indices_of_distinct(rows: np.ndarray) -> np.ndarray:
    """Return the index (u,), rising, of the first of each set of equal rows (n, k).

    The second result of unique_rows(), sorted; quicker where all rows differ.
    """
    words = _words(rows)
    key = np.sort(_hashes(words))
    return np.sort(_group_equal(words)[0]) if (key[1:] == key[:-1]).any() else np.arange(len(rows))


def _group_equal(words: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Group equal rows (n, k) of 64-bit words.

    Returns the index (u,) of the first row of each group, in no order, and the group (n,) of each row.
    """
    key = _hashes(words)
    order = np.argsort(key)
    sorted_key = key.take(order)
    start = np.flatnonzero(np.concatenate([np.ones(min(len(words), 1), bool), sorted_key[1:] != sorted_key[:-1]]))
    first = np.minimum.reduceat(order, start) if len(words) else order
    group = np.empty(len(words), np.int64)
    group[order] = np.repeat(np.arange(len(start)), np.diff(start, append=len(words)))
    if np.array_equal(words.take(first, 0).take(group, 0), words):
        return first, group
    _, first, group = np.unique(words, axis=0, return_index=True, return_inverse=True)  # two rows have one hash
    return first, group.reshape(-1)


def _words(rows: np.ndarray) -> np.ndarray:
    """Convert rows to 64-bit words that are equal where the rows are."""
    # + 0.0 turns -0 into 0.
    return rows.astype(np.int64) if np.issubdtype(rows.dtype, np.integer) else rows.astype(np.float64) + 0.0


def _hashes(words: np.ndarray) -> np.ndarray:
    """Return a hash (n,) uint64 of each row (n, k) of 64-bit words, with the multipliers of SplitMix64."""
    key = np.zeros(len(words), np.uint64)
    for column in np.ascontiguousarray(words.T).view(np.uint64):
        key = (key ^ column) * _MIX[0]
        key = (key ^ key >> np.uint64(29)) * _MIX[1]
    return key ^ key >> np.uint64(32)
