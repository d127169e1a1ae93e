"""Protected children: results, errors, crashes, time and memory limits."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from gdtool.core import child
from gdtool.core.errors import InputError
from tests.conftest import ROOT


@pytest.fixture(autouse=True, params=[True, False] if sys.platform == "linux" else [False], ids=lambda forks: "forked" if forks else "started")
def forks(request, monkeypatch):
    monkeypatch.setattr(child, "_FORKS", request.param)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return request.param


def double(array, noise=""):
    print(noise)
    return array * 2


def of_own_type(arrays):
    """Which are of numpy's own type, not of another that is equal to it; and the arrays."""
    return [array.dtype is np.dtype(array.dtype.str) for array in arrays], arrays


def ask_for_more():
    return child.call("tests.core.test_child:double", np.arange(3), seconds=20, memory_mb=10**6)


def parents():
    """Own parent, and that of a child."""
    return os.getppid(), child.call("os:getppid", seconds=20)


def leave_one_behind(pid_file):
    child.begin("tests.core.test_child:hang_as", pid_file, seconds=30)
    while not pid_file.exists():
        time.sleep(0.02)


def hang_as(pid_file):
    pid_file.with_suffix(".new").write_text(str(os.getpid()))
    pid_file.with_suffix(".new").rename(pid_file)
    hang()


def work(seconds):
    kept = np.ones(2**23)  # 64 MB
    while time.process_time() < seconds:
        kept.sum()


def refuse():
    raise InputError("mesh", "is a bow-tie", "cut it")


def own_pid():
    return os.getpid()


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


def by_two(name):
    """Its own and its copy's process, and what the copy answers."""
    answer = child.beside(globals()[name])
    return os.getpid(), answer()


def test_arrays_go_there_and_back_whatever_the_function_prints():
    assert (child.call("tests.core.test_child:double", np.arange(5), noise="text", seconds=30) == np.arange(5) * 2).all()


def test_numbers_there_and_back_are_of_numpys_own_types():
    """ufunc.at takes ten times as long with types that are equal to these only; others come as they are."""
    numbers = [np.arange(2).astype(kind) for kind in (bool, np.int8, np.int32, np.uint64, np.float32, float, complex) for _ in range(2)]
    others = [np.arange(5, dtype=">f8"), np.array(["a", "bc"]), np.array([(1, 2.0)], [("one", int), ("two", float)])]
    there, arrays = child.call("tests.core.test_child:of_own_type", numbers + others, seconds=30)
    assert all(there[:len(numbers)]) and all(of_own_type(arrays[:len(numbers)])[0])
    assert all(one.dtype == other.dtype and (one == other).all() for one, other in zip(arrays, numbers + others, strict=True))


def test_what_may_not_be_needed_gives_way_to_others_and_fails_silently():
    given = child.begin("os:getpriority", os.PRIO_PROCESS, 0, seconds=30, in_case=True)
    assert given.if_done() == min(os.getpriority(os.PRIO_PROCESS, 0) + child._NICE, 19)
    assert child.begin("tests.core.test_child:crash", seconds=30, in_case=True).if_done() is None


def test_what_is_prepared_is_read_already_and_what_cannot_be_is_told_when_it_is_asked_for(tmp_path, forks):
    (tmp_path / "marked_module.py").write_text("import os\nread_by = os.getpid()\ndef asked():\n    return os.getpid(), read_by\n")
    sys.path.append(str(tmp_path))
    try:
        child.prepare("marked_module")
        own, read_by = child.call("marked_module:asked", seconds=30)
    finally:
        sys.path.remove(str(tmp_path))
    assert own != os.getpid() and (own != read_by) == forks
    child.prepare("no.such.module")
    with pytest.raises(child.ChildFailed, match="ModuleNotFoundError"):
        child.call("no.such.module:function", seconds=30)


def test_a_child_has_the_place_and_the_environment_of_the_call(tmp_path, monkeypatch):
    child.prepare("tests.core.test_child")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GDTOOL_MARK", "1")
    assert child.call("os:getcwd", seconds=30) == str(tmp_path.resolve())
    assert child.call("os:getenv", "GDTOOL_MARK", seconds=30) == "1"
    monkeypatch.delenv("GDTOOL_MARK")
    assert child.call("os:getenv", "GDTOOL_MARK", seconds=30) is None


@pytest.mark.skipif(sys.platform != "linux", reason="children are forked on Linux only")
def test_what_forks_children_is_started_again_where_it_died_and_has_one_thread(forks):
    if not forks:
        pytest.skip("children are started anew")
    for module in ("gdtool.geometry.simplify_child", "gdtool.geometry.quad_child", "gdtool.texture.unwrap_charts", "gdtool.texture.unwrap_child",
                   "gdtool.texture.unwrap_pack"):
        child.prepare(module)
    assert child.call("os:getppid", seconds=30) == child._nursery.process.pid
    assert len(os.listdir(f"/proc/{child._nursery.process.pid}/task")) == 1  # what has more cannot be copied
    running = child.begin("tests.core.test_child:hang", seconds=30)
    child._nursery.process.kill()
    with pytest.raises(child.ChildFailed, match="SIGKILL"):
        running.result()
    assert child.call("tests.core.test_child:double", 1, seconds=30) == 2


def test_children_are_started_where_none_can_be_forked(monkeypatch):
    def refused(environment):
        raise PermissionError

    monkeypatch.setattr(child, "_nursery", None)
    monkeypatch.setattr(child.Nursery, "start", refused)
    child.prepare("tests.core.test_child")
    assert child.call("os:getppid", seconds=30) == os.getpid()


@pytest.mark.skipif(sys.platform != "linux", reason="children are forked on Linux only")
def test_a_copy_of_this_process_has_children_of_its_own(forks):
    first = child.call("os:getppid", seconds=30)
    receive, send = os.pipe()
    if not os.fork():
        try:
            os.write(send, b"%d" % child.call("os:getppid", seconds=30))
        finally:
            os._exit(0)
    os.close(send)
    with os.fdopen(receive, "rb") as file:
        assert int(file.read()) != first
    os.wait()
    assert child.call("os:getppid", seconds=30) == first


def test_children_that_were_begun_work_at_once_and_keep_their_limits():
    running = [child.begin("tests.core.test_child:large", seconds=30) for _ in range(2)] + [child.begin("tests.core.test_child:hang", seconds=1)]
    deadline = time.monotonic() + 30
    while any(one._process.returncode is None for one in running) and time.monotonic() < deadline:  # nobody has asked for a result yet
        time.sleep(0.05)
    assert all(one._process.returncode is not None for one in running)
    assert [len(one.result()) for one in running[:2]] == [2**20] * 2
    with pytest.raises(child.ChildFailed, match="longer than 1 s"):
        running[2].result()


def test_our_errors_come_back_as_themselves():
    with pytest.raises(InputError, match="mesh: is a bow-tie; cut it") as caught:
        child.call("tests.core.test_child:refuse", seconds=30)
    assert caught.value.cure == "cut it"


@pytest.mark.parametrize("name, words, limits", [
    ("crash", "SIGABRT", {"seconds": 30}),
    ("leave", "no result", {"seconds": 30}),
    ("hang", "longer than 1 s", {"seconds": 1}),
    ("grow", "more than 500 MB", {"seconds": 30, "memory_mb": 500}),
])
def test_everything_else_is_a_failure_with_its_reason(name, words, limits):
    with pytest.raises(child.ChildFailed, match=words):
        child.call(f"tests.core.test_child:{name}", **limits)


def test_a_childs_child_may_ask_for_more_than_the_child_has():
    assert child.call("tests.core.test_child:ask_for_more", seconds=30, memory_mb=4000).tolist() == [0, 2, 4]


def test_a_childs_child_comes_from_where_the_child_came_from_and_dies_with_it(tmp_path, forks):
    own, other = child.call("tests.core.test_child:parents", seconds=30)
    assert (own == other) == forks
    child.call("tests.core.test_child:leave_one_behind", tmp_path / "pid", seconds=30)
    pid = int((tmp_path / "pid").read_text())
    deadline = time.monotonic() + 5
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(pid)


def test_what_children_spent_is_known(monkeypatch, forks):
    if not forks:
        pytest.skip("the system counts what was started")
    monkeypatch.setattr(child, "spent", child.Spent())
    child.call("tests.core.test_child:work", 0.3, seconds=30)
    assert 0.25 < child.spent.seconds < 5 and 64 < child.spent.peak_mb < 2000


def test_a_copy_of_a_child_works_beside_it():
    own, other = child.call("tests.core.test_child:by_two", "own_pid", seconds=30)
    assert own != other and not alive(other)
    assert len(child.call("tests.core.test_child:by_two", "large", seconds=30)[1]) == 2**20
    for death in ("crash", "leave", "refuse"):
        with pytest.raises(child.ChildFailed, match=f"{death} died in a copy"):
            child.call("tests.core.test_child:by_two", death, seconds=30)


def test_a_copy_dies_with_the_child(forks):
    running = child.begin("tests.core.test_child:by_two", "hang", seconds=5)
    copies, nursery = [], child._nursery.process.pid if forks else None
    while not copies and not running._timed_out:
        time.sleep(0.05)
        copies = [pid for pid in below(os.getpid()) if parent_of(pid) not in (os.getpid(), nursery)]
    with pytest.raises(child.ChildFailed, match="longer than 5 s"):
        running.result()
    time.sleep(0.3)
    assert copies and not any(alive(pid) for pid in copies)


def parent_of(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return int(file.read().rsplit(")", 1)[1].split()[1])
    except FileNotFoundError:
        return None


def below(pid):
    """Processes that it started, and that these started."""
    own = [int(one) for one in subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()]
    return own + [other for one in own for other in below(one)]


def alive(pid):
    """Whether a process runs (a zombie that nobody has reaped yet does not)."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_child_dies_with_its_parent(forks):
    code = f"from gdtool.core import child; child._FORKS = {forks}; child.call('tests.core.test_child:hang', seconds=50)"
    parent = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT), "GDTOOL_MARK": "1"})
    children = []
    for _ in range(100):
        time.sleep(0.05)
        children = below(parent.pid)
        if len(children) > forks:  # what forks it is one
            break
    time.sleep(0.5)  # let it set its death signal
    parent.kill()
    parent.wait()
    time.sleep(0.3)
    assert children and not any(alive(pid) for pid in children)


def test_what_lies_in_the_folder_is_not_taken_for_a_module(tmp_path, monkeypatch):
    for name in ("socket", "pickle", "random", "numpy", "gdtool"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('not this one')")
    monkeypatch.chdir(tmp_path)
    child.forget_nursery()
    assert child.call("tests.core.test_child:double", np.arange(3), seconds=20).tolist() == [0, 2, 4]
