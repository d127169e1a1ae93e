"""Run render-dataset on a local Ray cluster of two nodes (make extras-test)."""

from __future__ import annotations

import json
import os

import pytest

from gdtool.core import cluster
from gdtool.core.errors import GdtoolError
from tests.stages.test_render_dataset import BOX, FAST

pytest.importorskip("ray", reason="the extra ray is not installed")
# Ray's own threads and sockets warn as they please.
pytestmark = pytest.mark.filterwarnings("default")


@pytest.fixture(scope="module")
def address():
    """Start two nodes of one core each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    nodes = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 1, "object_store_memory": 100 * 2**20, "include_dashboard": False},
    )
    nodes.add_node(num_cpus=1, object_store_memory=100 * 2**20)
    yield nodes.address
    nodes.shutdown()


def test_sources_fan_out_and_bad_ones_are_reported(gdtool_here, address, tmp_path):
    for name in "abcdef":
        (tmp_path / f"{name}.obj").write_text(BOX if name != "c" else "v 0 0 0\n")
    fast = ("--domains", "normal", "-o", "data", *FAST)
    sources = [f"{name}.obj" for name in "abcdef"]  # relative: meant from here, wherever the workers stand
    done = gdtool_here("render-dataset", *sources, *fast, "--ray", address)
    assert done.returncode == 1, done.stderr
    assert "c.obj" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    wanted = [f"data/{name}.asset/views" for name in "abdef"]
    assert sorted(done.stdout.splitlines()) == wanted
    assert [
        entry["path"] for entry in json.loads((tmp_path / "data/manifest.json").read_text())["content"]["objects"]
    ] == [p[5:] for p in wanted]
    # The same as without: the folders' digests do not know who made them.
    second_run = gdtool_here("render-dataset", *sources, *fast)
    assert second_run.returncode == 1
    assert second_run.stderr.count("up to date") == 5
    assert gdtool_here("render-dataset", "a.obj", *FAST, "--domains", "normal", "-o", "alone").returncode == 0
    alone, there = (
        json.loads((tmp_path / p / "manifest.json").read_text())["files"] for p in ("alone", "data/a.asset/views")
    )
    assert alone == there


@pytest.fixture
def where():
    """Return the node that works on a text; "crash" kills its worker, "fault" raises.

    It is a local function, so that workers need not import this file.
    """

    def work(text: str) -> str:
        import os
        import time

        import ray

        if text == "crash":
            os.kill(os.getpid(), 9)
        if text == "fault":
            raise ValueError("no such thing")
        time.sleep(0.3)
        return ray.get_runtime_context().get_node_id()

    return work


def test_both_nodes_work_and_a_dead_worker_is_an_error_of_its_source(address, where):
    results = list(cluster.each(address, where, iter(["1", "2", "3", "crash", "4", "fault", "5", "6"]), 1))
    errors = [r for r in results if isinstance(r, GdtoolError)]
    assert len(results) == 8
    assert {error.subject for error in errors} == {"crash", "fault"}
    assert all("\n" not in str(error) for error in errors)
    assert any("no such thing" in str(error) for error in errors)
    assert len({r for r in results if isinstance(r, str)}) == 2


def test_few_sources_are_taken_ahead(address, where):
    """Sources are read when a core is free, not all at once."""
    taken = []

    def texts():
        for k in range(40):
            taken.append(k)
            yield str(k)

    results = cluster.each(address, where, texts(), 1)
    next(results)
    assert len(taken) <= 2 + cluster.AHEAD + 1
    results.close()


def test_no_cluster_at_the_address(gdtool_here, tmp_path):
    (tmp_path / "a.obj").write_text(BOX)
    done = gdtool_here("render-dataset", "a.obj", *FAST, "--ray", "127.0.0.1:1")
    assert done.returncode == 5
    assert "no cluster answers" in done.stderr
