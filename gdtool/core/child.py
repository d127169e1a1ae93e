"""Run one function in a killable child process with a time and a memory limit.

Native mesh code hangs, crashes or calls exit() on hard input (FAULTS.md). The child gets its arguments and gives its
result by pickle over pipes of our own; it dies with its parent, however the parent dies.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from gdtool.core import errors


class ChildFailed(Exception):
    """The child crashed, ran out of time or memory, or ended without a result; str() says which."""


# glibc gives large blocks back at once, and native vectors that grow fault their pages in again and again: a sixth of the
# time of a quadric collapse. A child ends soon; it keeps what it has.
# OpenBLAS starts a thread for each core as numpy is imported, which takes a third of a child's start-up; none multiplies dense matrices.
_SETTINGS = {"OPENBLAS_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": str(2**30), "MALLOC_TRIM_THRESHOLD_": str(2**32), "MALLOC_TOP_PAD_": str(2**26)}
# Children that have imported a module and wait for a call, by the module's name.
_ready: dict[str, list[subprocess.Popen]] = {}


def prepare(module: str, count: int = 1) -> None:
    """Start children now that the next `count` calls into a module will use: their start-up then costs those no time.

    For a main thread only: a child dies with the thread that starts it. What is never called ends with the process.
    """
    waiting = _ready.setdefault(module, [])
    waiting.extend(_start(module) for _ in range(count - len(waiting)))


def _start(module: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", "gdtool.core.child", module], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            env=_SETTINGS | os.environ)


def _take(module: str) -> subprocess.Popen:
    while _ready.get(module):
        process = _ready[module].pop()
        if process.poll() is None:
            return process
        process.communicate()
    return _start(module)


class Running:
    """A call under way in a child: result() waits for it."""

    def __init__(self, function: str, process: subprocess.Popen, request: bytes, seconds: float):
        self._function, self._process, self._timed_out = function, process, False
        self._answer, self._noise = b"", b""
        self._timer = threading.Timer(seconds, self._stop)
        self._timer.daemon = True
        self._timer.start()
        try:
            with contextlib.suppress(BrokenPipeError):  # it is dead already: result() says of what
                process.stdin.write(request)
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
        except BaseException:
            process.kill()
            process.wait()
            raise
        process.stdin = None  # communicate() would flush it
        # Read from now on: a child that is done ends, whenever result() is asked for.
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _stop(self) -> None:
        self._timed_out = True
        self._process.kill()

    def _read(self) -> None:
        self._answer, self._noise = self._process.communicate()
        self._timer.cancel()

    def result(self) -> Any:
        """What the function returned. A GdtoolError raised in the child is raised here; ChildFailed for all else."""
        try:
            self._reader.join()
        except BaseException:
            self._process.kill()
            self._reader.join()
            raise
        process, function = self._process, self._function
        if self._timed_out:
            raise ChildFailed(f"{function} took longer than {self._timer.interval:g} s")
        if process.returncode < 0:
            raise ChildFailed(f"{function} died of {signal.Signals(-process.returncode).name}")
        if not self._answer:
            last = self._noise.decode(errors="replace").strip().splitlines()[-1:]
            raise ChildFailed(f"{function} ended with exit code {process.returncode} and no result" + "".join(f" ({x})" for x in last))
        status, value = pickle.loads(self._answer)
        if status == "done":
            return value
        if status == "error":
            raise value
        raise ChildFailed(f"{function}: {value}")


def begin(function: str, *args: Any, seconds: float, memory_mb: int | None = None, **kwargs: Any) -> Running:
    """Start "package.module:function"(*args, **kwargs) in a child process; the child has all of it when this returns.

    memory_mb limits the growth of the child's address space over what it has after importing.
    """
    request = pickle.dumps((function, args, kwargs, memory_mb), protocol=5)
    return Running(function, _take(function.split(":")[0]), request, seconds)


def call(function: str, *args: Any, seconds: float, memory_mb: int | None = None, **kwargs: Any) -> Any:
    """begin(...).result(): raises ChildFailed, and a GdtoolError that was raised in the child."""
    return begin(function, *args, seconds=seconds, memory_mb=memory_mb, **kwargs).result()


def beside(function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
    """Begin function(*args) in a copy of this process, which shares its memory until written to; what is returned waits for what it returns.

    For what runs in a child (begin): only a process without other threads can be copied. The copy dies with it. Linux only. Waiting raises
    ChildFailed where the copy failed.
    """
    receive, send = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            _die_with_parent()
            os.close(receive)
            answer = function(*args)
            with os.fdopen(send, "wb") as file:
                pickle.dump(answer, file, protocol=5)
        finally:
            os._exit(0)
    os.close(send)

    def result() -> Any:
        with os.fdopen(receive, "rb") as file:
            answer = file.read()
        os.waitpid(pid, 0)
        if not answer:
            raise ChildFailed(f"{function.__name__} died in a copy of the process")
        return pickle.loads(answer)

    return result


def _die_with_parent() -> None:
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def _limit_memory(megabytes: int) -> None:
    import resource

    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limit, most = now + megabytes * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]
    if most != resource.RLIM_INFINITY:  # a child's child cannot have more than the child
        limit = min(limit, most)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _main() -> None:
    _die_with_parent()
    # Native libraries print to stdout; the answer goes out through a descriptor they do not know.
    answer_to = os.dup(1)
    os.dup2(2, 1)
    with contextlib.suppress(Exception):  # told when the function is asked for
        importlib.import_module(sys.argv[1])
    request = sys.stdin.buffer.read()
    if not request:
        return
    gc.disable()  # it looks at a hundred thousand small objects again and again as they become more; a child ends soon
    function, args, kwargs, memory_mb = pickle.loads(request)
    module, name = function.split(":")
    try:
        target = getattr(importlib.import_module(module), name)
        if memory_mb is not None and sys.platform == "linux":
            _limit_memory(memory_mb)
        answer = ("done", target(*args, **kwargs))
    except errors.GdtoolError as error:
        answer = ("error", type(error)(error.subject, error.fact, error.cure))
    except MemoryError:
        answer = ("failed", f"needs more than {memory_mb} MB")
    except Exception as error:  # reported to the parent, which knows a fallback
        answer = ("failed", f"{type(error).__name__}: {error}")
    with os.fdopen(answer_to, "wb") as file:
        pickle.dump(answer, file, protocol=5)
    os._exit(0)  # a native library may hang or crash in its own teardown; the answer is out


if __name__ == "__main__":
    _main()
