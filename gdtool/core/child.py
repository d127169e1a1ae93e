"""Run one function in a killable child process with a time and a memory limit.

Native mesh code hangs, crashes or calls exit() on hard input (FAULTS.md). The child gets its arguments and gives its
result by pickle over pipes of our own; it dies with its parent, however the parent dies. On Linux it is forked by a process
that has read numpy and what else children need (nursery.py), elsewhere started anew.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import io
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gdtool.core import errors
from gdtool.core.errors import ChildFailed
from gdtool.core.nursery import Forked, Nursery, die_with_parent, python_running


# glibc gives large blocks back at once, and native vectors that grow fault their pages in again and again: a sixth of the
# time of a quadric collapse. A child ends soon; it keeps what it has.
# OpenBLAS starts a thread for each core as numpy is imported, which takes a third of a child's start-up; none multiplies dense matrices.
_SETTINGS = {"OPENBLAS_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": str(2**30), "MALLOC_TRIM_THRESHOLD_": str(2**32), "MALLOC_TOP_PAD_": str(2**26)}
_NICE = 10
_FORKS = sys.platform == "linux"
_nursery: Nursery | None = None
_asking = threading.Lock()


@dataclass
class Spent:
    """By what forks children and those that have ended: they are no children of this process to the system (RUSAGE_CHILDREN)."""

    seconds: float = 0.0  # of the processor
    peak_mb: float = 0.0  # resident in one of them
    _nursery: float = 0.0

    def add(self, child: Forked) -> None:
        self.seconds += child.seconds + max(child.nursery_seconds - self._nursery, 0)
        self._nursery = max(child.nursery_seconds, self._nursery)
        self.peak_mb = max(self.peak_mb, child.peak_mb)


spent = Spent()


def prepare(module: str) -> None:
    """Have a module that the next children will ask for read now, by the process that forks them: that then costs those no time."""
    if _FORKS:
        with contextlib.suppress(OSError):
            _tell_nursery(lambda nursery: nursery.read(module))


def _tell_nursery(tell: Callable[[Nursery], Any]) -> Any:
    """What comes of telling the nursery, a new one where there is none or it is no more."""
    global _nursery
    with _asking:
        if _nursery is not None:
            with contextlib.suppress(OSError):
                return tell(_nursery)
        _nursery = Nursery.start(_SETTINGS | os.environ)
        return tell(_nursery)


def forget_nursery() -> None:
    """Have the next children forked by a process that reads what they need anew, as in a command that has just been started."""
    global _nursery, _asking, spent
    _asking, spent = threading.Lock(), Spent()
    if _nursery is not None:
        _nursery.leave()
        _nursery = None


if _FORKS:
    os.register_at_fork(after_in_child=forget_nursery)  # a copy of this process has children of its own


def _started() -> Forked | subprocess.Popen:
    if _FORKS:
        with contextlib.suppress(OSError):  # no such sockets to be had
            return _tell_nursery(Nursery.fork)
    code = f"from {__name__} import serve; serve()"
    return subprocess.Popen(python_running(code), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=_SETTINGS | os.environ)


class _Pickler(pickle.Pickler):
    """Writes numpy's types by their names: it would have each array that is read be of a type of its own, which ufunc.at has no quick loops for."""

    def reducer_override(self, thing: Any) -> Any:
        numpy = sys.modules.get("numpy")
        if numpy is not None and isinstance(thing, numpy.dtype) and thing.kind in "biufc" and thing.isnative:
            return numpy.dtype, (thing.str,)
        return NotImplemented


def _pickled(thing: Any) -> bytes:
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(thing)
    return file.getvalue()


class Running:
    """A call under way in a child: result() waits for it."""

    def __init__(self, function: str, process: Forked | subprocess.Popen, request: bytes, seconds: float):
        self._function, self._process, self._timed_out = function, process, False
        self._answer, self._noise = b"", b""
        self._timer = threading.Timer(seconds, self._stop)
        self._timer.daemon = True
        self._timer.start()
        # A child that still starts takes in what it is asked when it can, and one that is done ends, whenever result() is asked for.
        self._talk = threading.Thread(target=self._converse, args=(request,), daemon=True)
        self._talk.start()

    def _stop(self) -> None:
        self._timed_out = True
        self._process.kill()

    def kill(self) -> None:
        """End it, where nobody will ask for its result."""
        self._process.kill()

    def _converse(self, request: bytes) -> None:
        for told in (lambda: self._process.stdin.write(request), self._process.stdin.close):
            with contextlib.suppress(BrokenPipeError):  # it is dead already: result() says of what
                told()
        self._process.stdin = None  # communicate() would flush it
        self._answer, self._noise = self._process.communicate()
        self._timer.cancel()
        if isinstance(self._process, Forked):
            with _asking:
                spent.add(self._process)

    def if_done(self) -> Any:
        """result(), or None where the child failed: for what can be done here as well."""
        with contextlib.suppress(ChildFailed):
            return self.result()
        return None

    def result(self) -> Any:
        """What the function returned. A GdtoolError raised in the child is raised here; ChildFailed for all else."""
        try:
            self._talk.join()
        except BaseException:
            self._process.kill()
            self._talk.join()
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


def begin(function: str, *args: Any, seconds: float, memory_mb: int | None = None, in_case: bool = False, **kwargs: Any) -> Running:
    """Start "package.module:function"(*args, **kwargs) in a child process, which gets the arguments as they are now.

    memory_mb limits the growth of the child's address space over what it has after importing. in_case: what it does may not be needed, so
    that it gives way to all others.
    """
    place = None
    with contextlib.suppress(OSError):  # it may have been deleted
        place = os.getcwd()
    request = pickle.dumps((place, sys.path, _SETTINGS | os.environ)) + _pickled((function, args, kwargs, memory_mb, in_case))
    return Running(function, _started(), request, seconds)


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
            die_with_parent()
            os.close(receive)
            answer = function(*args)
            with os.fdopen(send, "wb") as file:
                _Pickler(file, protocol=5).dump(answer)
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


def _limit_memory(megabytes: int) -> None:
    import resource

    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limit, most = now + megabytes * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]
    if most != resource.RLIM_INFINITY:  # a child's child cannot have more than the child
        limit = min(limit, most)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def serve(nursery: Nursery | None = None) -> None:
    """What a child runs: what it is asked comes from stdin, the answer goes to stdout, all else that is printed to stderr.

    nursery: where it was forked, and where children of its own come from; None for one that was started.
    """
    global _nursery
    if nursery is None:
        die_with_parent()
    _nursery = nursery
    # Native libraries print to stdout; the answer goes out through a descriptor they do not know.
    answer_to = os.dup(1)
    os.dup2(2, 1)
    gc.disable()  # it looks at a hundred thousand small objects again and again as they become more; a child ends soon
    with os.fdopen(0, "rb", closefd=False) as asked:
        place, sys.path[:], environment = pickle.load(asked)
        os.environ.clear()
        os.environ.update(environment)
        with contextlib.suppress(OSError, TypeError):
            os.chdir(place)
        function, args, kwargs, memory_mb, in_case = pickle.load(asked)
    module, name = function.split(":")
    try:
        target = getattr(importlib.import_module(module), name)
        if memory_mb is not None and sys.platform == "linux":
            _limit_memory(memory_mb)
        if in_case:
            os.nice(_NICE)
        answer = ("done", target(*args, **kwargs))
    except errors.GdtoolError as error:
        answer = ("error", type(error)(error.subject, error.fact, error.cure))
    except MemoryError:
        answer = ("failed", "ran out of memory" if memory_mb is None else f"needs more than {memory_mb} MB")
    except ImportError as error:
        # A shared library that the system lacks is told: a fallback would hide why the result is worse.
        library = None if isinstance(error, ModuleNotFoundError) else errors.missing_library(error)
        answer = ("error", library) if library else ("failed", f"{type(error).__name__}: {error}")
    except Exception as error:  # reported to the parent, which knows a fallback
        answer = ("failed", f"{type(error).__name__}: {error}")
    with os.fdopen(answer_to, "wb") as file:
        _Pickler(file, protocol=5).dump(answer)
    os._exit(0)  # a native library may hang or crash in its own teardown; the answer is out
