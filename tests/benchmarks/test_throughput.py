"""The throughput benchmark's arithmetic and what it would run; the runs are `make bench-throughput`."""

import pytest

from benchmarks.common.measure import Cost
from benchmarks.render_dataset import throughput


def test_rates_are_by_the_clock_and_by_processor_time():
    costs = [Cost(30.0, 400.0, "", 20.0), Cost(60.0, 300.0, "", 40.0)]  # two at once: the later one ends the run
    row = throughput.row_of("shards", 2, 24, costs)
    assert (row["seconds"], row["cpu"], row["peak_mb"]) == (60.0, 60.0, 400.0)
    assert row["per_core_minute"] == pytest.approx(12)
    assert row["per_cpu_minute"] == pytest.approx(24)
    # The workers' processor time is not the command's: no figure rather than a wrong one.
    assert throughput.row_of("ray", 2, 24, costs)["per_cpu_minute"] is None


@pytest.mark.parametrize("cores, steps", [(1, [1]), (2, [1, 2]), (6, [1, 2, 4, 6])])
def test_cores_grow_by_doubling_up_to_all(cores, steps):
    rows = throughput.plan(24, [10, 100], cores, ray=True)
    assert sorted({row[2] for row in rows if row[0] == "cores"}) == steps
    assert [row[3] for row in rows if row[0] == "objects"] == [10, 100]
    assert not [row for row in throughput.plan(24, [], cores, ray=False) if row[1] == "ray"]


def test_the_page_has_a_row_for_every_run():
    costs = [Cost(30.0, 400.0, "", 20.0)]
    rows = {
        f"{i}": {"table": name, **throughput.row_of(way, 1, count, costs)}
        for i, (name, way, count) in enumerate(
            [("cores", "threads", 24), ("cores", "ray", 24), ("objects", "threads", 1000)]
        )
    }
    page = throughput.report({"machine": "m", "busy": "", "ray": True, "rows": rows})
    assert page.count("\n| threads") == 2
    assert page.count("\n| ray") == 1
    assert "1000" in page
