"""Read a few hundred damaged files, always the same, with every reader, and all that once crashed one.

`make fuzz` looks for more.
"""

import pytest

from tests.faults.fuzz import CRASHES, READERS, attempt, fuzz


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(name):
    outcome, file = fuzz(name, seed=1, seconds=60, rounds=300)
    assert file is None, outcome


@pytest.mark.parametrize("path", sorted(CRASHES.glob("*-*")), ids=lambda p: p.name)
def test_files_that_once_crashed_a_reader_are_read_or_refused(path):
    assert attempt(path.name.split("-")[0], path) in ("read", "refused")
