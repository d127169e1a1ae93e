"""Run a function in a child process with a time and a memory limit.

Native mesh libraries hang, crash or call exit() on hard input. In a child that costs one attempt, not the run. A child
gets its arguments and returns its result by pickle over pipes. It ends with its parent, however the parent ends.
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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gdtool.core import errors
from gdtool.core.errors import ChildFailed

# The environment of a child. glibc gives large blocks back to the system at once, so that native vectors which grow
# fault their pages in again and again: a sixth of the time of a quadric collapse. OpenBLAS starts a thread for each
# core as numpy is imported, a third of a child's start-up, and no child multiplies dense matrices.
_SETTINGS = {
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(2**30),
    "MALLOC_TRIM_THRESHOLD_": str(2**32),
    "MALLOC_TOP_PAD_": str(2**26),
}

# Prepared children, by the module that they import.
_waiting: dict[str, list[subprocess.Popen]] = {}

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_waiting.clear)  # a copy of this process must not use the pipes of the original


def prepare(function: Callable[..., Any], modules: Sequence[str] = (), count: int = 1) -> None:
    """Start `count` child processes ahead of time: they import the module of `function`, and `modules`, and wait.

    This process goes on meanwhile. A later begin() of `function` uses one of them.
    """
    module = _module_of(function)
    waiting = _waiting.setdefault(module, [])
    with contextlib.suppress(OSError):  # begin() then starts one, and reports what fails
        while len(waiting) < count:
            waiting.append(_started((module, *modules)))


def begin(
    function: Callable[..., Any], *args: Any, seconds: float, memory_mb: int | None = None, **kwargs: Any
) -> Running:
    """Start function(*args, **kwargs) in a child process, which gets a copy of the arguments as they are now.

    function: defined at the top level of a module. seconds: the time after which the child is killed. memory_mb: how
    much the child's address space may grow after its imports (Linux), in MB. The thread that calls this must outlive
    the child: the system ends a child with the thread that started it.
    """
    module = _module_of(function)
    waiting = _waiting.get(module)
    working_folder = None
    with contextlib.suppress(OSError):  # it may have been deleted
        working_folder = str(Path.cwd())
    request = _pickled((working_folder, module, function.__qualname__, args, kwargs, memory_mb))
    process = waiting.pop() if waiting else _started((module,))
    return Running(f"{module}:{function.__qualname__}", process, request, seconds)


def call(function: Callable[..., Any], *args: Any, seconds: float, memory_mb: int | None = None, **kwargs: Any) -> Any:
    """Run begin() and wait for the result. Raises ChildFailed, or the GdtoolError that the function raised."""
    return begin(function, *args, seconds=seconds, memory_mb=memory_mb, **kwargs).result()


def end_waiting() -> None:
    """End the prepared children that no begin() has used."""
    while _waiting:
        for process in _waiting.popitem()[1]:
            process.kill()
            process.communicate()


def _module_of(function: Callable[..., Any]) -> str:
    """Return the name by which a child imports the function's module: for a script, the name of its file."""
    if function.__module__ != "__main__":
        return function.__module__
    main = sys.modules["__main__"]
    return main.__spec__.name if main.__spec__ else Path(main.__file__ or "").stem


class Running:
    """Hold a call that runs in a child process."""

    def __init__(self, name: str, process: subprocess.Popen, request: bytes, seconds: float):
        self._name, self._process, self._timed_out = name, process, False
        self._answer, self._printed = b"", b""
        self._timer = threading.Timer(seconds, self._stop)
        self._timer.daemon = True
        self._timer.start()
        # A thread serves the pipes from now on, so that the child never waits for a call of result().
        self._talk = threading.Thread(target=self._converse, args=(request,), daemon=True)
        self._talk.start()

    def _stop(self) -> None:
        """End the child at its time limit."""
        self._timed_out = True
        self._process.kill()

    def _converse(self, request: bytes) -> None:
        """Send the request, and read the answer until the child ends."""
        self._answer, self._printed = self._process.communicate(request)
        self._timer.cancel()

    def kill(self) -> None:
        """End the child, whose result is no longer needed."""
        self._process.kill()

    def result(self) -> Any:
        """Wait for the function's return value. Raises the GdtoolError that it raised, ChildFailed for all else."""
        try:
            self._talk.join()
        except BaseException:
            self._process.kill()
            self._talk.join()
            raise
        code = self._process.returncode
        if self._timed_out:
            raise ChildFailed(f"{self._name} took longer than {self._timer.interval:g} s")
        if code < 0:
            raise ChildFailed(f"{self._name} died of {signal.Signals(-code).name}")
        if not self._answer:
            last = self._printed.decode(errors="replace").strip().splitlines()[-1:]
            raise ChildFailed(
                f"{self._name} ended with exit code {code} and no result" + "".join(f" ({line})" for line in last)
            )
        status, value = pickle.loads(self._answer)
        if status == "done":
            return value
        if status == "error":
            raise value
        raise ChildFailed(f"{self._name}: {value}")


def _started(modules: tuple[str, ...]) -> subprocess.Popen:
    """Start a child that imports modules and then waits for its request."""
    root = str(Path(__file__).resolve().parents[2])
    # The gdtool beside this file, and nothing of the folder that the child starts in.
    code = f"import sys; sys.path.insert(0, {root!r}); import gdtool; from {__name__} import serve; serve()"
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=_SETTINGS | os.environ,
    )
    with contextlib.suppress(BrokenPipeError):  # the child is dead already: result() says why
        assert process.stdin is not None  # a pipe
        process.stdin.write(pickle.dumps((sys.path, modules)))
        process.stdin.flush()
    return process


class _Pickler(pickle.Pickler):
    """Pickle numpy's data types by their names.

    By default unpickling gives each array a copy of its type object. ufunc.at has fast loops only for numpy's own type
    objects, and takes ten times as long with a copy.
    """

    def reducer_override(self, value: Any) -> Any:
        """Pickle a native numeric dtype as a call of numpy.dtype."""
        numpy = sys.modules.get("numpy")
        if numpy is not None and isinstance(value, numpy.dtype) and value.kind in "biufc" and value.isnative:
            return numpy.dtype, (value.str,)
        return NotImplemented


def _pickled(value: Any) -> bytes:
    """Pickle a value with numpy's types by name."""
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(value)
    return file.getvalue()


def serve() -> None:
    """Run as the child: read modules to import and a request from stdin, and write the answer to stdout."""
    _die_with_parent()
    # Native libraries print to stdout; the answer goes out through a descriptor that they do not know.
    answer_to = os.dup(1)
    os.dup2(2, 1)
    gc.disable()  # a child ends soon, and the collector would look at a hundred thousand objects again and again
    with os.fdopen(0, "rb", closefd=False) as file:
        sys.path[:], modules = pickle.load(file)
        for module in modules:
            with contextlib.suppress(Exception):  # reported when one of its functions is requested
                importlib.import_module(module)
        try:
            working_folder, module, name, args, kwargs, memory_mb = pickle.load(file)
        except EOFError:  # it was prepared and is not needed
            os._exit(0)
    with contextlib.suppress(OSError, TypeError):
        os.chdir(working_folder)
    answer = _answer(module, name, args, kwargs, memory_mb)
    with os.fdopen(answer_to, "wb") as file:
        file.write(_pickled(answer))
    os._exit(0)  # a native library may hang or crash in its own teardown; the answer is out


def _answer(module: str, name: str, args: tuple, kwargs: dict[str, Any], memory_mb: int | None) -> tuple[str, Any]:
    """Run the function; returns "done" and its result, "error" and a GdtoolError, or "failed" and the reason."""
    try:
        function: Any = importlib.import_module(module)
        for part in name.split("."):
            function = getattr(function, part)
        if memory_mb is not None and sys.platform == "linux":
            _limit_memory(memory_mb)
        return "done", function(*args, **kwargs)
    except errors.GdtoolError as error:
        return "error", type(error)(error.subject, error.fact, error.cure)
    except MemoryError:
        return "failed", "ran out of memory" if memory_mb is None else f"needs more than {memory_mb} MB"
    except ImportError as error:
        # A missing system library is reported: a fallback would hide why the result is worse.
        library = None if isinstance(error, ModuleNotFoundError) else errors.missing_library(error)
        return ("error", library) if library else ("failed", f"{type(error).__name__}: {error}")
    except Exception as error:  # the parent has a fallback
        return "failed", f"{type(error).__name__}: {error}"


def _limit_memory(megabytes: int) -> None:
    """Limit how much the address space of this process may still grow, in MB."""
    import resource

    with Path("/proc/self/statm").open() as file:
        now = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    limit, hard_limit = now + megabytes * 2**20, resource.getrlimit(resource.RLIMIT_AS)[1]
    if hard_limit != resource.RLIM_INFINITY:  # a child's child cannot have more than the child
        limit = min(limit, hard_limit)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent ends (Linux)."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
