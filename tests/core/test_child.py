"""Protected children: results, errors, crashes, time and memory limits."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from gdtool.core import child
from gdtool.core.errors import InputError
from tests.conftest import ROOT


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def double(array, noise=""):
    print(noise)
    return array * 2


def ask_for_more():
    return child.call("tests.core.test_child:double", np.arange(3), seconds=20, memory_mb=10**6)


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


def test_a_prepared_child_takes_the_next_call_and_a_dead_one_none():
    child.prepare("tests.core.test_child", 2)
    waiting = [process.pid for process in child._ready["tests.core.test_child"]]
    assert len(set(waiting)) == 2
    os.kill(waiting[1], signal.SIGKILL)
    time.sleep(0.2)
    assert child.call("tests.core.test_child:own_pid", seconds=30) == waiting[0]
    assert child.call("tests.core.test_child:own_pid", seconds=30) not in waiting
    child.prepare("no.such.module")
    with pytest.raises(child.ChildFailed, match="ModuleNotFoundError"):
        child.call("no.such.module:function", seconds=30)


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


def test_a_copy_of_a_child_works_beside_it():
    own, other = child.call("tests.core.test_child:by_two", "own_pid", seconds=30)
    assert own != other and not alive(other)
    assert len(child.call("tests.core.test_child:by_two", "large", seconds=30)[1]) == 2**20
    for death in ("crash", "leave", "refuse"):
        with pytest.raises(child.ChildFailed, match=f"{death} died in a copy"):
            child.call("tests.core.test_child:by_two", death, seconds=30)


def test_a_copy_dies_with_the_child():
    running = child.begin("tests.core.test_child:by_two", "hang", seconds=5)
    copies = []
    while not copies and not running._timed_out:
        time.sleep(0.05)
        copies = subprocess.run(["pgrep", "-P", str(running._process.pid)], capture_output=True, text=True).stdout.split()
    with pytest.raises(child.ChildFailed, match="longer than 5 s"):
        running.result()
    time.sleep(0.3)
    assert copies and not any(alive(pid) for pid in copies)


def alive(pid):
    """Whether a process runs (a zombie that nobody has reaped yet does not)."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_child_dies_with_its_parent():
    code = "from gdtool.core import child; child.call('tests.core.test_child:hang', seconds=50)"
    parent = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(ROOT), "GDTOOL_MARK": "1"})
    children = []
    for _ in range(100):
        time.sleep(0.05)
        children = subprocess.run(["pgrep", "-P", str(parent.pid)], capture_output=True, text=True).stdout.split()
        if children:
            break
    time.sleep(0.5)  # let it set its death signal
    parent.kill()
    parent.wait()
    time.sleep(0.3)
    assert children and not any(alive(pid) for pid in children)
