"""Memory that runs out, in this process and in children: exit code 5 with what was asked for, and nothing left
behind."""

import os
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest

from gdtool.bake import lods
from gdtool.core import child
from gdtool.core.child import ChildFailed, call
from gdtool.core.errors import ResourceError, from_exception
from gdtool.core.native import import_error, require_address_space
from tests.bake.test_lods import target

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits on the address space are Linux's")


def test_a_failed_allocation_of_numpy_says_how_much_it_asked_for():
    with pytest.raises(MemoryError) as refused:
        np.ones(2**44)
    assert str(from_exception(refused.value, "x")).startswith("x: ran out of memory (it asked for 128 TiB); ")


def test_a_failed_allocation_of_torch_says_how_much_it_asked_for():
    import torch

    with pytest.raises(RuntimeError) as refused:
        torch.empty(2**44)
    told = from_exception(refused.value, "x")
    assert isinstance(told, ResourceError) and str(told).startswith(
        "x: ran out of memory (it asked for 65536.00 GiB); "
    )


def test_a_library_that_finds_no_room_is_not_taken_for_one_that_is_missing():
    fault = ImportError("libembree4.so.4: failed to map segment from shared object", name="embreex")
    assert (
        str(from_exception(fault, "x"))
        == "x: ran out of memory while embreex was loaded; free memory or raise its limit (ulimit -v)"
    )
    # With a fallback in a child that has a limit of its own.
    assert isinstance(import_error(fault, "embreex"), MemoryError)


def limited(code, megabytes):
    """Run code in a Python of its own whose address space grows by no more than that."""
    before = (
        "import resource; used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize();"
        f"resource.setrlimit(resource.RLIMIT_AS, (used + {megabytes} * 2**20,) * 2)\n"
    )
    return subprocess.run(
        [
            sys.executable,
            "-c",
            "import numpy; import gdtool.geometry.rays; import embreex.rtcore_scene, embreex.mesh_construction\n"
            + before
            + code,
        ],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def test_embree_is_not_started_where_it_would_crash():
    """Without the question in front of it this is a segmentation fault."""
    code = (
        "from gdtool.geometry.meshes import TriMesh\nfrom gdtool.geometry.rays import RayCaster\n"
        "RayCaster(TriMesh(numpy.eye(3), numpy.array([[0, 1, 2]])))"
    )
    done = limited(code, 60)
    assert done.returncode == 1 and "MemoryError: unable to allocate 0.19 GiB for rays at 1 faces" in done.stderr, (
        done.stderr
    )
    assert limited(code, 1000).returncode == 0


def test_without_a_limit_there_is_nothing_to_ask():
    assert resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY
    require_address_space(2**60, "anything")


def grow_beyond_the_limit():
    """What a child runs: it allocates until it may not."""
    return [bytearray(2**24) for _ in range(10_000)][0]


def wait_in_a_folder(folder):
    """What a child runs: a temporary folder of its own, and no end."""
    with tempfile.TemporaryDirectory(dir=folder):
        time.sleep(60)


def test_a_child_that_meets_its_limit_says_so():
    with pytest.raises(ChildFailed, match="needs more than 200 MB"):
        call(grow_beyond_the_limit, seconds=30, memory_mb=200)


@pytest.fixture(scope="module")
def whole():
    """A mesh with texture coordinates."""
    return target()


@pytest.mark.parametrize(
    "fault, told",
    [
        ({"seconds": 0.01, "memory_mb": 8000}, "took longer than 0.01 s"),
        ({"seconds": 60, "memory_mb": 1}, "needs more than 1 MB"),
    ],
    ids=["time", "memory"],
)
def test_a_failed_collapse_leaves_no_temporary_folder(monkeypatch, tmp_path, whole, fault, told):
    """The child that makes coarser levels works on files; one that is killed cannot remove them itself."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(lods, "call", lambda *given, **_: call(*given, **fault))
    coarse, why = lods.coarser(whole, 6)
    assert coarse is None and told in why
    assert not list((tmp_path / "temporary").iterdir())


def test_children_that_fail_are_gone():
    running = child.begin(wait_in_a_folder, None, seconds=0.3)
    with pytest.raises(ChildFailed, match="took longer than 0.3 s"):
        running.result()
    assert running._process.returncode is not None and running._process.returncode < 0
