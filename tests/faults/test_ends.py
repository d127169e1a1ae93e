"""Ways out of a command: each has its exit code and one line, and leaves nothing behind."""

import contextlib
import dataclasses
import errno
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import click
import numpy as np
import pytest

from gdtool.commands import _exit, _group, _stage_command
from gdtool.core import child, ending, log, runner
from gdtool.core.errors import GdtoolError, InputError, OutputError, ResourceError, from_exception
from tests.conftest import ROOT
from tests.core import toy
from tests.faults import toy_runs
from tests.faults.files import leftovers, lines_of, quad_cube

GDTOOL = [sys.executable, "-m", "gdtool"]
TOY = [sys.executable, "-m", "tests.core.toy"]
RUNS = [sys.executable, "-m", "tests.faults.toy_runs"]
ELSEWHERE = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def default_signals():
    """A shell starts background jobs deaf to SIGINT and SIGQUIT, and the tests may be one."""
    for number in ending.SIGNALS:
        signal.signal(number, signal.SIG_DFL)


def start(command, **kwargs):
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ELSEWHERE,
        **{"preexec_fn": default_signals, **kwargs},
    )


def until(happens, process, seconds=20):
    deadline = time.monotonic() + seconds
    while not happens():
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.002)


def listens(process):
    """Whether a process handles SIGHUP, which Python by itself does not."""
    with contextlib.suppress(FileNotFoundError), Path(f"/proc/{process.pid}/status").open() as file:
        caught = next(line for line in file if line.startswith("SigCgt"))
        return bool(int(caught.split()[1], 16) >> (signal.SIGHUP - 1) & 1)
    return False


@pytest.fixture
def pictures(tmp_path):
    for name in "abc":
        (tmp_path / f"{name}.png").write_bytes(name.encode())
    return [f"{name}.png" for name in "abc"]


# What was raised becomes a line and a code.


def no_array():
    """What numpy raises where memory for an array is not to be had."""
    try:
        return np.empty(2**55)
    except MemoryError as error:
        return error


class OutOfMemoryError(RuntimeError):
    __module__ = "torch"


@pytest.mark.parametrize(
    "error, kind, words",
    [
        (
            TypeError("a"),
            GdtoolError,
            r"internal error \(TypeError: a\); run it again with --debug to see where, and report that",
        ),
        (ValueError("first\nsecond"), GdtoolError, r"internal error \(ValueError: first\)"),
        (RecursionError(), GdtoolError, "internal error"),
        (InputError("f", "is bad", "mend it"), InputError, "f: is bad; mend it"),
        (FileNotFoundError(errno.ENOENT, "No such file", "f"), OutputError, "f: no such file"),
        (OSError(errno.ENAMETOOLONG, "File name too long", "f"), InputError, "shorten the name"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), ResourceError, "free memory"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), ResourceError, "ulimit -u"),
        (MemoryError(), ResourceError, "ran out of memory"),
        (no_array(), ResourceError, "ran out of memory"),
        (
            RuntimeError(
                "[enforce fail at alloc_cpu.cpp:114] . DefaultCPUAllocator: can't allocate memory: you tried to "
                "allocate 1 bytes."
            ),
            ResourceError,
            "ran out of memory",
        ),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), ResourceError, "ran out of memory"),
        (RuntimeError("std::bad_alloc"), ResourceError, "ran out of memory"),
        (OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), ResourceError, "ran out of memory"),
        (RuntimeError("can't start new thread"), ResourceError, "ulimit"),
        (RuntimeError("Found no NVIDIA driver on your system."), ResourceError, "run it on the cpu"),
        (AssertionError("Torch not compiled with CUDA enabled"), ResourceError, "run it on the cpu"),
        (
            ImportError(
                "libGL.so.1: cannot open shared object file: No such file or directory", name="pymeshlab.pmeshlab"
            ),
            ResourceError,
            "libGL.so.1: is not installed, and pymeshlab needs it; apt install libgl1",
        ),
        (
            ImportError("libodd-2.so.7.1: cannot open shared object file: No such file or directory"),
            ResourceError,
            "libodd-2.so.7.1: is not installed; install",
        ),
        (ModuleNotFoundError("No module named 'igl'", name="igl"), ResourceError, "igl: is not installed; pip install"),
        (ModuleNotFoundError("No module named 'gdtool.x'", name="gdtool.x"), GdtoolError, "internal error"),
        (ImportError("cannot import name 'x' from 'gdtool'", name="gdtool"), GdtoolError, "internal error"),
        (child.ChildFailed("f died of SIGSEGV"), ResourceError, "died of SIGSEGV"),
    ],
    ids=lambda value: f"{type(value).__name__}-{value}"[:50] if isinstance(value, Exception) else "",
)
def test_what_was_raised_has_its_code(error, kind, words):
    found = from_exception(error, "subject")
    assert type(found) is kind and found.cure and len(str(found).splitlines()) == 1
    with pytest.raises(kind, match=words):
        raise found
    assert str(pickle.loads(pickle.dumps(found))) == str(found)


@pytest.mark.parametrize(
    "raised, code",
    [(TypeError("odd"), 1), (MemoryError(), 5), (InputError("x", "is bad", "mend it"), 3), (KeyError("k"), 1)],
    ids=lambda value: type(value).__name__,
)
@pytest.mark.parametrize("debug", [False, True], ids=["plain", "debug"])
def test_the_command_line_catches_all(monkeypatch, capsys, raised, code, debug):
    @click.command()
    @click.option("--debug", is_flag=True)
    def command(debug):
        raise raised

    monkeypatch.setattr(sys, "argv", ["gdtool", *(["--debug"] if debug else [])])
    with pytest.raises(SystemExit) as ended:
        _exit.guarded(command)
    told = capsys.readouterr().err
    assert ended.value.code == code and ("Traceback" in told) == debug
    last = told.splitlines()[-1]
    assert (
        last.startswith("gdtool: ") and not last.startswith("gdtool: gdtool") and (debug or len(told.splitlines()) == 1)
    )
    assert ("internal error" in last) == (code == 1)


def test_one_source_that_fails_unexpectedly_does_not_stop_the_rest(monkeypatch, capsys, tmp_path, pictures):
    work = toy.run

    def run(inputs, options, out):
        if inputs.name == "b":
            out.path("half.png").write_bytes(b"half")
            raise ZeroDivisionError("by\nzero")
        work(inputs, options, out)

    monkeypatch.setattr(sys, "argv", ["gdtool", *pictures, "-q"])
    with pytest.raises(SystemExit) as ended:
        _exit.guarded(_stage_command.stage_command(dataclasses.replace(toy.STAGE, run=run), "Toy."))
    out, told = capsys.readouterr()
    assert ended.value.code == 1 and out.split() == ["a.asset/renders", "c.asset/renders"]
    assert lines_of(told) == [
        "gdtool: b.png: internal error (ZeroDivisionError: by); run it again with --debug to see where, and report that"
    ]
    assert leftovers(tmp_path) == [] and not (tmp_path / "b.asset").exists()


@pytest.mark.parametrize("name", ["a\nb", "a\r\x1b[2J", "a\x85b\u2028c"], ids=ascii)
def test_what_is_printed_is_one_line_whatever_a_name_holds(capsys, monkeypatch, name):
    monkeypatch.setattr(log, "level", log.NORMAL)
    _exit.report(InputError(name, f"is {name}", "mend it"))
    log.say(f"  {name}")
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 2 and "\x1b" not in told
    assert log.printable("caf\udce9 é 日本") == "caf\ufffd é 日本"


def needs_a_library():
    raise ImportError(
        "libGL.so.1: cannot open shared object file: No such file or directory", name="pymeshlab.pmeshlab"
    )


def test_a_library_that_a_child_lacks_is_told_and_not_worked_around():
    with pytest.raises(ResourceError, match="libGL.so.1: is not installed, and pymeshlab needs it; apt install libgl1"):
        child.call(needs_a_library, seconds=60)


# Signals.


@pytest.mark.parametrize("number", ending.SIGNALS, ids=lambda number: number.name)
def test_every_signal_that_ends_cleans_up(tmp_path, pictures, number):
    process = start([*TOY, "a.png", "--repeat", "9999", "--pause", "0.01"])
    until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial/005.png")), process)
    process.send_signal(number)
    before = time.monotonic()
    out, told = process.communicate()
    assert process.returncode == 128 + number and out == "" and time.monotonic() - before < 2
    # Who sets a limit of processor time may not know that it was met.
    assert [line for line in lines_of(told) if "running toy" not in line] == (
        ["gdtool: the limit of processor time is reached; raise it (ulimit -t)"] if number == signal.SIGXCPU else []
    )
    assert leftovers(tmp_path) == [] and not (tmp_path / "a.asset").exists()


def test_a_hard_limit_of_processor_time_leaves_time_to_clean_up(tmp_path, pictures):
    def limited():
        default_signals()
        resource.setrlimit(resource.RLIMIT_CPU, (3, 3))

    process = start([*RUNS, "busy", "a.png", "-q"], preexec_fn=limited)
    told = process.communicate()[1]
    assert process.returncode == 128 + signal.SIGXCPU and len(lines_of(told)) == 1 and leftovers(tmp_path) == [], told


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="asks /proc which signals are handled")
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.25, 0.6])
def test_ctrl_c_while_it_starts_is_quiet(tmp_path, pictures, delay):
    """From before click is imported on, through the imports of numpy and torch."""
    process = start([*GDTOOL, "sample-views", "a.png"])
    until(lambda: listens(process), process)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    out, told = process.communicate()
    if process.returncode == 3:  # a.png is no picture: on a quick machine it had said so
        return
    assert (
        process.returncode == 130
        and out == ""
        and [line for line in told.splitlines() if "running sample-views" not in line] == []
    ), told
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("run", ["native", "pooled"])
def test_what_does_not_return_to_python_is_ended_all_the_same(tmp_path, pictures, run):
    """A second thread cleans up and ends the process where the main thread is in a native call or waits for another
    one."""
    process = start([*RUNS, run, "a.png", "-q"])
    until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial/half.png")), process)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    before = time.monotonic()
    out, told = process.communicate()
    assert process.returncode == 143 and out == "" and told == "" and time.monotonic() - before < 2.2
    assert leftovers(tmp_path) == [] and not (tmp_path / "a.asset").exists()


def test_signals_that_the_caller_ignores_stay_ignored(tmp_path, pictures):
    """nohup, and a shell's background jobs."""
    process = start(
        [*TOY, "a.png", "--repeat", "60", "--pause", "0.01", "-q"],
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial")), process)
    process.send_signal(signal.SIGHUP)
    assert process.communicate() == ("a.asset/renders\n", "") and process.returncode == 0


# Time limits.


def test_a_time_limit_ends_a_step_of_python_with_its_error():
    late = ResourceError("mesh", "is not done after 0.1 s", "raise --seconds to 1")
    before = time.monotonic()
    with pytest.raises(ResourceError) as caught, ending.time_limit(0.1, late):
        try:
            while True:
                time.sleep(0.01)
        except Exception:  # a fallback
            time.sleep(60)
    assert caught.value is late and time.monotonic() - before < 2
    with ending.time_limit(0.2, late):
        pass
    time.sleep(0.3)  # it does not ring any more


def test_a_time_limit_ends_a_native_call_with_its_error(tmp_path, pictures):
    process = start([*RUNS, "late", "a.png", "-q"])
    out, told = process.communicate(timeout=20)
    assert (
        process.returncode == 5 and out == "" and told == "gdtool: a: is not done after 0.3 s; raise --seconds to 1\n"
    )
    assert leftovers(tmp_path) == [] and not (tmp_path / "a.asset").exists()


def test_a_stage_with_seconds_ends_by_twice_of_them_and_5():
    from gdtool.stages import limits

    assert limits.OVER * 10 + limits.MORE - limits._UNWIND + ending.GRACE < 25
    limits.require_time(20.0, 10.0, "--seconds", "mesh", "lower --faces")
    with pytest.raises(
        ResourceError,
        match=(
            "mesh: needs about 220 s in the quickest way, and --seconds 10 allows less; raise --seconds to 220, or "
            "lower"
        ),
    ):
        limits.require_time(220.0, 10.0, "--seconds", "mesh", "lower --faces")


def test_more_quads_than_the_time_allows_are_refused_at_once(gdtool_here, tmp_path):
    quad_cube(tmp_path / "cube.obj", 4)
    begin = time.monotonic()
    done = gdtool_here("remesh", "cube.obj", "--faces", 2_000_000, "--seconds", 10, "-q")
    assert done.returncode == 5 and "raise --seconds to 220" in done.stderr and len(lines_of(done.stderr)) == 1
    assert time.monotonic() - begin < 10 and leftovers(tmp_path) == []


# Standard streams, the environment, plugins.


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-", "2>/dev/full"])
def test_closed_streams_do_not_matter(tmp_path, pictures, closed):
    """Nothing else gets their numbers: neither a message nor a path ends up in a file of the result."""
    done = subprocess.run(
        ["bash", "-c", f"{' '.join(TOY)} a.png {closed}"], capture_output=True, text=True, env=ELSEWHERE
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ("" if ">&-" in closed.split() else "a.asset/renders\n") and "Traceback" not in done.stderr
    assert (tmp_path / "a.asset/renders/000.png").read_bytes() == b"a" and leftovers(tmp_path) == []
    helped = subprocess.run(
        ["bash", "-c", f"{' '.join(GDTOOL)} remesh --help {closed}"], capture_output=True, text=True, env=ELSEWHERE
    )
    assert helped.returncode == 0 and helped.stderr == ""


def test_a_full_stdout_is_told(tmp_path, pictures):
    for command in (f"{' '.join(TOY)} a.png -q", f"{' '.join(GDTOOL)} --help"):
        done = subprocess.run(["bash", "-c", f"{command} >/dev/full"], capture_output=True, text=True, env=ELSEWHERE)
        assert done.returncode == 4 and len(lines_of(done.stderr)) == 1 and "no space left" in done.stderr, done.stderr


def test_without_docstrings(gdtool, tmp_path, pictures):
    """python -OO drops them, and asserts with them."""
    for arguments in (["--help"], ["remesh", "--help"], ["validate", "--help"], ["train", "--help"]):
        plain, stripped = gdtool(*arguments), gdtool(*arguments, env={"PYTHONOPTIMIZE": "2"})
        assert stripped.returncode == 0 and stripped.stdout == plain.stdout and stripped.stderr == ""
    (tmp_path / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
        "f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
    )
    done = gdtool("remesh", "box.obj", "--faces", "96", "--engine", "split", "-q", env={"PYTHONOPTIMIZE": "2"})
    assert done.returncode == 0 and done.stderr == "", done.stderr


def test_a_umask_never_closes_a_result_to_its_own_user(tmp_path, pictures):
    done = subprocess.run(
        [*TOY, "a.png", "-q"], capture_output=True, text=True, env=ELSEWHERE, preexec_fn=lambda: os.umask(0o777)
    )
    assert done.returncode == 0 and leftovers(tmp_path) == [], done.stderr
    for path, mode in (
        ("a.asset", 0o700),
        ("a.asset/renders", 0o700),
        ("a.asset/renders/000.png", 0o600),
        ("a.asset/renders/manifest.json", 0o600),
    ):
        assert (tmp_path / path).stat().st_mode & 0o777 == mode, path


class Plugin:
    """An entry point whose module cannot be imported."""

    name, value, module, dist = "broken", "odd_package:command", "odd_package", None

    def load(self):
        raise ValueError("at import\nof it")


def test_a_plugin_that_cannot_be_imported_is_told_and_the_rest_works(gdtool_here, monkeypatch):
    monkeypatch.setattr(_group, "_plugins", lambda: {"broken": Plugin()})
    helped = gdtool_here("--help")
    assert helped.returncode == 0 and "broken" in helped.stdout and "remesh" in helped.stdout
    done = gdtool_here("broken", "x")
    assert done.returncode == 5 and lines_of(done.stderr) == [
        "gdtool: plugin broken: cannot be loaded (ValueError: at import); pip uninstall odd_package, or install a "
        "release of it that works with this gdtool"
    ]
    monkeypatch.setattr(Plugin, "load", lambda self: print)
    assert "is no click command" in gdtool_here("broken").stderr
    assert gdtool_here("remesh", "nothing.obj").returncode == 3


# What a failed run leaves.


def test_a_workspace_stays_only_where_a_run_can_go_on_from_it(tmp_path, pictures, capsys, monkeypatch):
    monkeypatch.setattr(log, "level", log.NORMAL)
    settings = runner.Settings()
    (failed,) = runner.run_all(toy_runs.stage("lost"), ("a.png",), toy.Options(), {}, settings)
    assert (
        "internal error (ValueError: before" in str(failed)
        and leftovers(tmp_path) == []
        and "goes on from it" not in capsys.readouterr().err
    )
    (failed,) = runner.run_all(toy_runs.stage("resumable"), ("a.png",), toy.Options(), {}, settings)
    (kept,) = tmp_path.glob("a.asset/.renders.*.work")
    told = capsys.readouterr().err
    assert (
        "internal error (ValueError: after" in str(failed)
        and f"is kept in {kept.relative_to(tmp_path)}; the same command goes on from it" in told
    )
    (done,) = runner.run_all(toy_runs.stage("resumable"), ("a.png",), toy.Options(), {}, settings)
    assert done.status == "done" and leftovers(tmp_path) == []


def test_train_keeps_the_file_that_it_resumes_from():
    from gdtool.diffusion.training.loop import CHECKPOINT
    from gdtool.stages.train import STAGE

    assert STAGE.checkpoint == CHECKPOINT
