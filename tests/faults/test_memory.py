"""Run out of memory in this process and in children: exit code 5 with the size asked for, nothing left behind."""

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


def test_a_failed_numpy_allocation_reports_its_size():
    with pytest.raises(MemoryError) as refused:
        np.ones(2**44)
    assert str(from_exception(refused.value, "x")).startswith("x: ran out of memory (it asked for 128 TiB); ")


def test_a_failed_torch_allocation_reports_its_size():
    import torch

    with pytest.raises(RuntimeError) as refused:
        torch.empty(2**44)
    error = from_exception(refused.value, "x")
    assert isinstance(error, ResourceError)
    assert str(error).startswith("x: ran out of memory (it asked for 65536.00 GiB); ")


def test_a_library_that_does_not_fit_in_memory_is_not_reported_as_missing():
    fault = ImportError("libembree4.so.4: failed to map segment from shared object", name="embreex")
    assert (
        str(from_exception(fault, "x"))
        == "x: ran out of memory while embreex was loaded; free memory or raise its limit (ulimit -v)"
    )
    # With a fallback in a child that has a limit of its own.
    assert isinstance(import_error(fault, "embreex"), MemoryError)


def limited(code, megabytes):
    """Run code in a new Python whose address space may grow by only so many megabytes."""
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


def test_embree_is_not_started_under_a_limit_that_would_crash_it():
    """Embree would end the process with a segmentation fault."""
    code = (
        "from gdtool.geometry.meshes import TriMesh\nfrom gdtool.geometry.rays import RayCaster\n"
        "RayCaster(TriMesh(numpy.eye(3), numpy.array([[0, 1, 2]])))"
    )
    done = limited(code, 60)
    assert done.returncode == 1, done.stderr
    assert "MemoryError: unable to allocate 0.19 GiB for rays at 1 faces" in done.stderr, done.stderr
    assert limited(code, 1000).returncode == 0


def test_without_an_address_space_limit_any_size_passes():
    assert resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY
    require_address_space(2**60, "anything")


def grow_beyond_the_limit():
    """Allocate memory until that fails; run in a child."""
    return [bytearray(2**24) for _ in range(10_000)][0]


def wait_in_a_folder(folder):
    """Make a temporary folder and wait in it; run in a child."""
    with tempfile.TemporaryDirectory(dir=folder):
        time.sleep(60)


def test_a_child_process_beyond_its_memory_limit_is_reported():
    with pytest.raises(ChildFailed, match="needs more than 200 MB"):
        call(grow_beyond_the_limit, seconds=30, memory_mb=200)


@pytest.fixture(scope="module")
def whole():
    """Make a mesh with texture coordinates."""
    return target()


@pytest.mark.parametrize(
    "limits, reason",
    [
        ({"seconds": 0.01, "memory_mb": 8000}, "took longer than 0.01 s"),
        ({"seconds": 60, "memory_mb": 1}, "needs more than 1 MB"),
    ],
    ids=["time", "memory"],
)
def test_a_killed_simplification_leaves_no_temporary_folder(monkeypatch, tmp_path, whole, limits, reason):
    """The child that makes coarser levels of detail works on files; killed, it cannot remove them itself."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(lods, "call", lambda *arguments, **_: call(*arguments, **limits))
    coarse, why = lods.coarser(whole, 6)
    assert coarse is None
    assert reason in why
    assert not list((tmp_path / "temporary").iterdir())


def test_a_failed_child_process_is_killed_and_reaped():
    running = child.begin(wait_in_a_folder, None, seconds=0.3)
    with pytest.raises(ChildFailed, match="took longer than 0.3 s"):
        running.result()
    assert running._process.returncode is not None
    assert running._process.returncode < 0
