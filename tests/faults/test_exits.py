"""Check each way a command ends: its exit code, its one line, and that nothing is left behind."""

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
HANG_SECONDS = 60  # a process that takes longer to end hangs
ELSEWHERE = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def default_signals():
    """Reset the signals: a shell starts background jobs, perhaps the tests, with SIGINT and SIGQUIT ignored."""
    for number in ending.SIGNALS:
        signal.signal(number, signal.SIG_DFL)


def start(command, **kwargs):
    """Start a process with pipes and default signals."""
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ELSEWHERE,
        **{"preexec_fn": default_signals, **kwargs},
    )


def wait_until(condition, process, seconds=20):
    """Wait for condition() while a process runs."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.stderr.read()
        if time.monotonic() > deadline:
            raise TimeoutError(f"nothing happened in {seconds} s")
        time.sleep(0.002)


def handles_signals(process):
    """Tell whether a process handles SIGHUP, which Python alone does not."""
    with contextlib.suppress(FileNotFoundError), Path(f"/proc/{process.pid}/status").open() as file:
        caught = next(line for line in file if line.startswith("SigCgt"))
        return bool(int(caught.split()[1], 16) >> (signal.SIGHUP - 1) & 1)
    return False


@pytest.fixture
def pictures(tmp_path):
    """Make three files that the toy stage takes for pictures."""
    for name in "abc":
        (tmp_path / f"{name}.png").write_bytes(name.encode())
    return [f"{name}.png" for name in "abc"]


# Exceptions become messages and exit codes.


def no_array():
    """Return the error that numpy raises when an array does not fit in memory."""
    try:
        return np.empty(2**55)
    except MemoryError as error:
        return error


class OutOfMemoryError(RuntimeError):
    """Stand in for torch's error."""

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
def test_an_exception_becomes_an_error_with_its_exit_code(error, kind, words):
    converted = from_exception(error, "subject")
    assert type(converted) is kind
    assert converted.cure
    assert len(str(converted).splitlines()) == 1
    with pytest.raises(kind, match=words):
        raise converted
    assert str(pickle.loads(pickle.dumps(converted))) == str(converted)


@pytest.mark.parametrize(
    "raised, code",
    [(TypeError("odd"), 1), (MemoryError(), 5), (InputError("x", "is bad", "mend it"), 3), (KeyError("k"), 1)],
    ids=lambda value: type(value).__name__,
)
@pytest.mark.parametrize("debug", [False, True], ids=["plain", "debug"])
def test_any_exception_of_a_command_becomes_one_line(monkeypatch, capsys, raised, code, debug):
    @click.command()
    @click.option("--debug", is_flag=True)
    def command(debug):
        raise raised

    monkeypatch.setattr(sys, "argv", ["gdtool", *(["--debug"] if debug else [])])
    with pytest.raises(SystemExit) as ended:
        _exit.guarded(command)
    errors = capsys.readouterr().err
    assert ended.value.code == code
    assert ("Traceback" in errors) == debug
    last = errors.splitlines()[-1]
    assert last.startswith("gdtool: ")
    assert not last.startswith("gdtool: gdtool")
    assert debug or len(errors.splitlines()) == 1
    assert ("internal error" in last) == (code == 1)


def test_an_unexpected_failure_of_one_source_does_not_stop_the_others(monkeypatch, capsys, tmp_path, pictures):
    work = toy.run

    def run(inputs, options, out):
        if inputs.name == "b":
            out.path("half.png").write_bytes(b"half")
            raise ZeroDivisionError("by\nzero")
        work(inputs, options, out)

    monkeypatch.setattr(sys, "argv", ["gdtool", *pictures, "-q"])
    with pytest.raises(SystemExit) as ended:
        _exit.guarded(_stage_command.stage_command(dataclasses.replace(toy.STAGE, run=run), "Toy."))
    out, errors = capsys.readouterr()
    assert ended.value.code == 1
    assert out.split() == ["a.asset/renders", "c.asset/renders"]
    assert lines_of(errors) == [
        "gdtool: b.png: internal error (ZeroDivisionError: by); run it again with --debug to see where, and report that"
    ]
    assert leftovers(tmp_path) == []
    assert not (tmp_path / "b.asset").exists()


@pytest.mark.parametrize("name", ["a\nb", "a\r\x1b[2J", "a\x85b\u2028c"], ids=ascii)
def test_messages_are_one_line_whatever_characters_a_name_has(capsys, monkeypatch, name):
    monkeypatch.setattr(log, "level", log.NORMAL)
    _exit.report(InputError(name, f"is {name}", "mend it"))
    log.say(f"  {name}")
    errors = capsys.readouterr().err
    assert len(errors.splitlines()) == 2
    assert "\x1b" not in errors
    assert log.printable("caf\udce9 é 日本") == "caf\ufffd é 日本"


def needs_a_library():
    """Fail like a package whose shared library is missing."""
    raise ImportError(
        "libGL.so.1: cannot open shared object file: No such file or directory", name="pymeshlab.pmeshlab"
    )


def test_a_library_missing_in_a_child_process_is_an_error():
    with pytest.raises(ResourceError, match="libGL.so.1: is not installed, and pymeshlab needs it; apt install libgl1"):
        child.call(needs_a_library, seconds=60)


# Signals.


@pytest.mark.parametrize("number", ending.SIGNALS, ids=lambda number: number.name)
def test_every_terminating_signal_cleans_up(tmp_path, pictures, number):
    process = start([*TOY, "a.png", "--repeat", "9999", "--pause", "0.01"])
    wait_until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial/005.png")), process)
    process.send_signal(number)
    out, errors = process.communicate(timeout=HANG_SECONDS)
    assert process.returncode == 128 + number
    assert out == ""
    # Only a limit of processor time is reported: the user may not know that it was reached.
    assert [line for line in lines_of(errors) if "running toy" not in line] == (
        ["gdtool: the limit of processor time is reached; raise it (ulimit -t)"] if number == signal.SIGXCPU else []
    )
    assert leftovers(tmp_path) == []
    assert not (tmp_path / "a.asset").exists()


def test_a_hard_cpu_limit_leaves_time_to_clean_up(tmp_path, pictures):
    def limited():
        default_signals()
        resource.setrlimit(resource.RLIMIT_CPU, (3, 3))

    process = start([*RUNS, "busy", "a.png", "-q"], preexec_fn=limited)
    errors = process.communicate(timeout=HANG_SECONDS)[1]
    assert process.returncode == 128 + signal.SIGXCPU, errors
    assert len(lines_of(errors)) == 1, errors
    assert leftovers(tmp_path) == [], errors


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="asks /proc which signals are handled")
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.25, 0.6])
def test_ctrl_c_during_start_up_is_quiet(tmp_path, pictures, delay):
    """From the import of click on, through the imports of numpy and torch."""
    process = start([*GDTOOL, "sample-views", "a.png"])
    wait_until(lambda: handles_signals(process), process)
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate()
    if process.returncode == 3:  # on a fast machine the run has already ended: a.png is no picture
        return
    assert process.returncode == 130, errors
    assert out == "", errors
    assert [line for line in errors.splitlines() if "running sample-views" not in line] == [], errors
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("run", ["native", "pooled"])
def test_a_signal_ends_a_run_blocked_in_native_code(tmp_path, pictures, run):
    """A second thread cleans up and ends the process where the main thread is in a native call or joins a thread."""
    process = start([*RUNS, run, "a.png", "-q"])
    wait_until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial/half.png")), process)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    out, errors = process.communicate(timeout=HANG_SECONDS)
    assert process.returncode == 143
    assert out == ""
    assert errors == ""
    assert leftovers(tmp_path) == []
    assert not (tmp_path / "a.asset").exists()


@pytest.mark.slow
@pytest.mark.parametrize("run", ["busy", "native", "pooled"])
def test_a_signal_ends_a_run_within_two_seconds(tmp_path, pictures, run):
    """Marked slow because a busy machine may exceed the time, which docs/faults.md promises."""
    process = start([*RUNS, run, "a.png", "-q"])
    wait_until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial/half.png")), process)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    before = time.monotonic()
    process.communicate(timeout=HANG_SECONDS)
    assert time.monotonic() - before < 2.2


def test_signals_that_the_parent_ignores_stay_ignored(tmp_path, pictures):
    """nohup and the background jobs of a shell rely on it."""
    process = start(
        [*TOY, "a.png", "--repeat", "60", "--pause", "0.01", "-q"],
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    wait_until(lambda: list(tmp_path.glob("a.asset/.renders.*.partial")), process)
    process.send_signal(signal.SIGHUP)
    assert process.communicate() == ("a.asset/renders\n", "")
    assert process.returncode == 0


# Time limits.


def test_a_time_limit_in_python_code_raises_its_error_past_fallbacks():
    late = ResourceError("mesh", "is not done after 0.1 s", "raise --seconds to 1")
    caught_by_fallback = []
    with pytest.raises(ResourceError) as caught, ending.time_limit(0.1, late):
        try:
            while True:
                time.sleep(0.01)
        except Exception as error:  # as a stage's fallback would
            caught_by_fallback.append(error)
    assert caught.value is late
    assert caught_by_fallback == []
    with ending.time_limit(0.2, late):
        pass
    time.sleep(0.3)  # longer than the limit, which must not raise any more


def test_a_time_limit_in_native_code_ends_the_process_with_its_error(tmp_path, pictures):
    process = start([*RUNS, "late", "a.png", "-q"])
    out, errors = process.communicate(timeout=20)
    assert process.returncode == 5
    assert out == ""
    assert errors == "gdtool: a: is not done after 0.3 s; raise --seconds to 1\n"
    assert leftovers(tmp_path) == []
    assert not (tmp_path / "a.asset").exists()


def test_a_stage_ends_within_twice_its_seconds_plus_five():
    from gdtool.stages import limits

    assert limits.OVER * 10 + limits.MORE - limits._UNWIND + ending.GRACE < 25
    limits.require_time(20.0, 10.0, "--seconds", "mesh", "lower --faces")
    with pytest.raises(
        ResourceError,
        match=(
            "mesh: needs about 220 s even with the quickest method, and --seconds 10 allows less; "
            "raise --seconds to 220, or lower"
        ),
    ):
        limits.require_time(220.0, 10.0, "--seconds", "mesh", "lower --faces")


def test_more_faces_than_the_time_allows_are_refused_before_any_work(gdtool_here, tmp_path):
    quad_cube(tmp_path / "cube.obj", 4)
    done = gdtool_here("remesh", "cube.obj", "--faces", 2_000_000, "--seconds", 10, "-q")
    assert done.returncode == 5
    assert "raise --seconds to 220" in done.stderr
    assert len(lines_of(done.stderr)) == 1
    assert leftovers(tmp_path) == []


# Standard streams, the environment, plugins.


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-", "2>/dev/full"])
def test_closed_standard_streams_are_harmless(tmp_path, pictures, closed):
    """No file of the result may get a closed stream's number, or messages would end up in it."""
    done = subprocess.run(
        ["bash", "-c", f"{' '.join(TOY)} a.png {closed}"], capture_output=True, text=True, env=ELSEWHERE
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ("" if ">&-" in closed.split() else "a.asset/renders\n")
    assert "Traceback" not in done.stderr
    assert (tmp_path / "a.asset/renders/000.png").read_bytes() == b"a"
    assert leftovers(tmp_path) == []
    helped = subprocess.run(
        ["bash", "-c", f"{' '.join(GDTOOL)} remesh --help {closed}"], capture_output=True, text=True, env=ELSEWHERE
    )
    assert helped.returncode == 0
    assert helped.stderr == ""


def test_a_full_stdout_exits_4(tmp_path, pictures):
    for command in (f"{' '.join(TOY)} a.png -q", f"{' '.join(GDTOOL)} --help"):
        done = subprocess.run(["bash", "-c", f"{command} >/dev/full"], capture_output=True, text=True, env=ELSEWHERE)
        assert done.returncode == 4, done.stderr
        assert len(lines_of(done.stderr)) == 1, done.stderr
        assert "no space left" in done.stderr, done.stderr


def test_commands_work_under_python_OO(gdtool, tmp_path, pictures):
    """python -OO drops docstrings and assert statements."""
    for arguments in (["--help"], ["remesh", "--help"], ["validate", "--help"], ["train", "--help"]):
        plain, stripped = gdtool(*arguments), gdtool(*arguments, env={"PYTHONOPTIMIZE": "2"})
        assert stripped.returncode == 0
        assert stripped.stdout == plain.stdout
        assert stripped.stderr == ""
    (tmp_path / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
        "f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
    )
    done = gdtool("remesh", "box.obj", "--faces", "96", "--engine", "split", "-q", env={"PYTHONOPTIMIZE": "2"})
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", done.stderr


def test_a_umask_leaves_the_result_open_to_its_owner(tmp_path, pictures):
    done = subprocess.run(
        [*TOY, "a.png", "-q"], capture_output=True, text=True, env=ELSEWHERE, preexec_fn=lambda: os.umask(0o777)
    )
    assert done.returncode == 0, done.stderr
    assert leftovers(tmp_path) == [], done.stderr
    for path, mode in (
        ("a.asset", 0o700),
        ("a.asset/renders", 0o700),
        ("a.asset/renders/000.png", 0o600),
        ("a.asset/renders/manifest.json", 0o600),
    ):
        assert (tmp_path / path).stat().st_mode & 0o777 == mode, path


class Plugin:
    """Stand in for an entry point whose module cannot be imported."""

    name, value, module, dist = "broken", "odd_package:command", "odd_package", None

    def load(self):
        raise ValueError("at import\nof it")


def test_a_plugin_that_fails_to_import_is_reported_and_the_rest_works(gdtool_here, monkeypatch):
    monkeypatch.setattr(_group, "_plugins", lambda: {"broken": Plugin()})
    helped = gdtool_here("--help")
    assert helped.returncode == 0
    assert "broken" in helped.stdout
    assert "remesh" in helped.stdout
    done = gdtool_here("broken", "x")
    assert done.returncode == 5
    assert lines_of(done.stderr) == [
        "gdtool: plugin broken: cannot be loaded (ValueError: at import); pip uninstall odd_package, or install a "
        "release of it that works with this gdtool"
    ]
    monkeypatch.setattr(Plugin, "load", lambda self: print)
    assert "is no click command" in gdtool_here("broken").stderr
    assert gdtool_here("remesh", "nothing.obj").returncode == 3


# Workspaces of failed runs.


def test_a_workspace_is_kept_only_where_a_run_can_resume_from_it(tmp_path, pictures, capsys, monkeypatch):
    monkeypatch.setattr(log, "level", log.NORMAL)
    settings = runner.Settings()
    (failed,) = runner.run_all(toy_runs.stage("lost"), ("a.png",), toy.Options(), {}, settings)
    assert "internal error (ValueError: before" in str(failed)
    assert leftovers(tmp_path) == []
    assert "goes on from it" not in capsys.readouterr().err
    (failed,) = runner.run_all(toy_runs.stage("resumable"), ("a.png",), toy.Options(), {}, settings)
    (kept,) = tmp_path.glob("a.asset/.renders.*.work")
    errors = capsys.readouterr().err
    assert "internal error (ValueError: after" in str(failed)
    assert f"is kept in {kept.relative_to(tmp_path)}; the same command goes on from it" in errors
    (done,) = runner.run_all(toy_runs.stage("resumable"), ("a.png",), toy.Options(), {}, settings)
    assert done.status == "done"
    assert leftovers(tmp_path) == []


def test_train_names_the_file_that_it_resumes_from():
    from gdtool.diffusion.training.loop import CHECKPOINT
    from gdtool.stages.train import STAGE

    assert STAGE.checkpoint == CHECKPOINT
