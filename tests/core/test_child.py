"""Call functions in child processes: results, errors, crashes, time and memory limits."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gdtool.core import child
from gdtool.core.errors import InputError
from tests.conftest import ROOT


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """Set PYTHONPATH so that children can import this file."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def double(array, noise=""):
    print(noise)
    return array * 2


def of_own_type(arrays):
    """Tell which arrays have one of numpy's own type objects, not a copy of it; returns the arrays too."""
    return [array.dtype is np.dtype(array.dtype.str) for array in arrays], arrays


def ask_for_more():
    return child.call(double, np.arange(3), seconds=20, memory_mb=10**6)


def leave_one_behind(pid_file):
    child.begin(hang_as, pid_file, seconds=30)
    while not pid_file.exists():
        time.sleep(0.02)


def hang_as(pid_file):
    pid_file.with_suffix(".new").write_text(str(os.getpid()))
    pid_file.with_suffix(".new").rename(pid_file)
    hang()


def refuse():
    raise InputError("mesh", "is a bow-tie", "cut it")


def read_by():
    """Return the id of this process, and whether it has imported a module that nothing else needs."""
    return os.getpid(), "json.tool" in sys.modules


def crash():
    os.abort()


def leave():
    os._exit(0)


def large():
    return np.zeros(2**20)  # more than a pipe holds


def hang():
    time.sleep(60)


def grow():
    return np.ones(2**28)  # 2 GB


def test_arrays_survive_the_round_trip_to_a_child_that_prints():
    assert (child.call(double, np.arange(5), noise="text", seconds=30) == np.arange(5) * 2).all()


def test_arrays_from_a_child_share_numpys_own_types():
    """ufunc.at takes ten times as long with type objects that only equal numpy's."""
    numbers = [
        np.arange(2).astype(kind)
        for kind in (bool, np.int8, np.int32, np.uint64, np.float32, float, complex)
        for _ in range(2)
    ]
    others = [np.arange(5, dtype=">f8"), np.array(["a", "bc"]), np.array([(1, 2.0)], [("one", int), ("two", float)])]
    there, arrays = child.call(of_own_type, numbers + others, seconds=30)
    assert all(there[: len(numbers)])
    assert all(of_own_type(arrays[: len(numbers)])[0])
    assert all(
        one.dtype == other.dtype and (one == other).all() for one, other in zip(arrays, numbers + others, strict=True)
    )


def test_a_prepared_child_is_used_and_has_imported_the_module():
    child.end_waiting()
    child.prepare(read_by, ["json.tool"])
    waiting = child._waiting[__name__][0]
    assert child.call(read_by, seconds=30) == (waiting.pid, True)
    assert child.call(read_by, seconds=30) != (waiting.pid, True)


def test_preparing_twice_starts_no_more_children():
    child.end_waiting()
    for _ in range(2):
        child.prepare(double, count=2)
    assert len(child._waiting[__name__]) == 2
    child.end_waiting()
    assert not child._waiting


def test_a_prepared_child_that_died_is_a_failure_with_its_reason():
    child.end_waiting()
    child.prepare(double)
    child._waiting[__name__][0].kill()
    with pytest.raises(child.ChildFailed, match="SIGKILL"):
        child.call(double, 1, seconds=30)


def test_a_child_works_in_the_folder_of_the_call(tmp_path, monkeypatch):
    child.prepare(os.getcwd)
    monkeypatch.chdir(tmp_path)
    assert child.call(os.getcwd, seconds=30) == str(tmp_path.resolve())


def test_a_copy_of_this_process_does_not_use_its_waiting_children():
    child.end_waiting()
    child.prepare(double)
    receive, send = os.pipe()
    if not os.fork():
        try:
            os.write(send, b"%d" % len(child._waiting))
        finally:
            os._exit(0)
    os.close(send)
    with os.fdopen(receive, "rb") as file:
        assert int(file.read()) == 0
    os.wait()


def test_children_run_in_parallel_within_their_limits():
    running = [child.begin(large, seconds=30) for _ in range(2)] + [child.begin(hang, seconds=1)]
    deadline = time.monotonic() + 30
    # Nobody has asked for a result yet.
    while any(child._process.returncode is None for child in running) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert all(child._process.returncode is not None for child in running)
    assert [len(child.result()) for child in running[:2]] == [2**20] * 2
    with pytest.raises(child.ChildFailed, match="longer than 1 s"):
        running[2].result()


def test_a_gdtool_error_in_a_child_is_raised_by_the_parent():
    with pytest.raises(InputError, match="mesh: is a bow-tie; cut it") as caught:
        child.call(refuse, seconds=30)
    assert caught.value.cure == "cut it"


@pytest.mark.parametrize(
    "name, words, limits",
    [
        ("crash", "SIGABRT", {"seconds": 30}),
        ("leave", "no result", {"seconds": 30}),
        ("hang", "longer than 1 s", {"seconds": 1}),
        ("grow", "more than 500 MB", {"seconds": 30, "memory_mb": 500}),
    ],
)
def test_any_other_failure_of_a_child_names_its_reason(name, words, limits):
    with pytest.raises(child.ChildFailed, match=words):
        child.call(globals()[name], **limits)


def test_a_grandchild_may_ask_for_more_memory_than_its_parent_has():
    assert child.call(ask_for_more, seconds=30, memory_mb=4000).tolist() == [0, 2, 4]


def test_a_grandchild_dies_with_its_parent(tmp_path):
    child.call(leave_one_behind, tmp_path / "pid", seconds=30)
    pid = int((tmp_path / "pid").read_text())
    deadline = time.monotonic() + 5
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(pid)


def below(pid):
    """List the processes that a process started, and those that they started."""
    child_pids = [
        int(word) for word in subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()
    ]
    return child_pids + [other for word in child_pids for other in below(word)]


def alive(pid):
    """Tell whether a process runs; a zombie that is not reaped yet does not."""
    try:
        with Path(f"/proc/{pid}/stat").open() as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_children_die_with_their_parent():
    code = (
        "from gdtool.core import child; from tests.core.test_child import double, hang; child.prepare(double); "
        "child.call(hang, seconds=50)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT)})
    children = []
    for _ in range(100):
        time.sleep(0.05)
        children = below(parent.pid)
        if children:
            break
    time.sleep(0.5)  # let it set its death signal
    parent.kill()
    parent.wait()
    time.sleep(0.3)
    assert children
    assert not any(alive(pid) for pid in children)


def test_a_child_imports_no_module_from_the_working_folder(tmp_path, monkeypatch):
    for name in ("socket", "pickle", "random", "numpy", "gdtool"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not this one')")
    monkeypatch.chdir(tmp_path)
    child.end_waiting()
    assert child.call(double, np.arange(3), seconds=20).tolist() == [0, 2, 4]
