"""Turn a signal into an orderly end: raise an exception in the main thread, clean up, exit with 128 + signal.

Python can raise the exception only between two of its own instructions. Where a native call keeps the main thread busy
for longer than GRACE seconds, a second thread runs the clean-up and ends the process. It cannot do so inside a native
call that holds the interpreter's lock: no Python code runs until that call returns.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from gdtool.core import log
from gdtool.core.errors import GdtoolError

# Seconds that the main thread has to unwind. With the clean-up after it, an interrupted command ends within two
# seconds.
GRACE = 1.2

# SIGXCPU: the soft limit of processor time (ulimit -t) is reached.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGXCPU")
SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))

# Seconds after which a time limit that was met in the middle of an import is looked at again.
_AGAIN = 0.1

# Seconds between the soft and the hard limit of processor time, for the clean-up.
_CPU_RESERVE = 2

_ALARM = getattr(signal, "SIGALRM", None)  # of time limits

received: int | None = None  # the first signal that asked for the end
_deaf = False
_late: GdtoolError | None = None  # what to tell when the time limit of the work under way is over
_clean_ups: list[Callable[[], None]] = []


class Stopped(KeyboardInterrupt):
    """Report that a signal asked this process to end. It is a KeyboardInterrupt, so that libraries do not catch it."""

    def __init__(self, number: int):
        self.number = number
        super().__init__(number)


def listen() -> Callable[[], None]:
    """Make the signals of SIGNALS raise Stopped in the main thread, once.

    Signals that the caller ignores stay ignored. Returns a function that restores the previous handlers. Where listen()
    is active already, neither it nor the returned function does anything.
    """
    global received, _deaf
    before = {number: signal.getsignal(number) for number in SIGNALS}
    if _stop in before.values():
        return lambda: None
    received, _deaf = None, False
    _leave_time_to_clean_up()
    heard, tell = os.pipe()
    os.set_blocking(tell, False)
    _start_thread(heard)
    wakeup = signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _stop)

    def undo() -> None:
        global received, _deaf
        received, _deaf = None, False
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        signal.set_wakeup_fd(wakeup)
        os.close(tell)  # the thread ends

    return undo


def ignore() -> None:
    """Ignore further signals, because the process is about to end.

    The thread that listen() started still ends the process GRACE seconds after the first signal.
    """
    global _deaf
    _deaf = True


@contextmanager
def certainly(clean_up: Callable[[], None]) -> Iterator[None]:
    """Run clean_up at the end of the block, and also where the process is ended during a native call.

    It may run twice, at the same time from two threads.
    """
    _clean_ups.append(clean_up)
    try:
        yield
    finally:
        clean_up()
        _clean_ups.remove(clean_up)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a temporary folder of this process, and remove it at the end of the block, however the block ends."""
    import shutil
    import tempfile

    folder = Path(tempfile.mkdtemp(prefix="gdtool-"))
    with certainly(lambda: shutil.rmtree(folder, ignore_errors=True)):
        yield folder


class TimeOver(BaseException):
    """Report that a time limit is over; not an Exception, so that no fallback takes it for a failed attempt."""


@contextmanager
def time_limit(seconds: float, late: GdtoolError) -> Iterator[None]:
    """Raise the error `late` in a block that takes longer than `seconds`.

    Where a native call goes on for GRACE seconds more, the whole process ends with that error. The limit holds in the
    main thread only, and only where the system has SIGALRM. It cannot be nested.
    """
    global _late
    if _ALARM is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    before, _late = signal.signal(_ALARM, _ring), late
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    except TimeOver:
        raise late from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        _late = None
        signal.signal(_ALARM, before)


def _ring(_number: int, frame: FrameType | None) -> None:
    """Handle SIGALRM: raise TimeOver, or try again later where an import is under way."""
    if _is_importing(frame):
        signal.setitimer(signal.ITIMER_REAL, _AGAIN)
    elif _late is not None and received is None:
        raise TimeOver


def _stop(number: int, frame: FrameType | None) -> None:
    """Handle the first signal: raise Stopped, or end at once where an import is under way."""
    global received
    if received is not None or _deaf:  # a second Ctrl-C does not cut the clean-up short
        return
    received = number
    if _is_importing(frame):  # a native module that an exception leaves half initialised aborts the process
        _end(number)
    raise Stopped(number)


def _is_importing(frame: FrameType | None) -> bool:
    """Tell whether a module is being imported at a frame."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _end(number: int, code: int | None = None) -> None:
    """Clean up and end the process now, with the code of a signal or the given one."""
    for clean_up in reversed(_clean_ups):
        with contextlib.suppress(Exception):
            clean_up()
    os._exit(128 + number if code is None else code)


def _start_thread(heard: int) -> None:
    """Start the thread that ends the process where the main thread cannot."""
    import _thread

    with contextlib.suppress(RuntimeError):  # no thread to be had: a native call is then waited for
        _thread.start_new_thread(_watch, (heard,))


def _watch(heard: int) -> None:
    """Wait for a signal, which is written to the pipe whatever the main thread does; end the process GRACE later."""
    try:
        while told := os.read(heard, 1):
            if told[0] == _ALARM:
                late = _late
                time.sleep(GRACE)
                if late is not None and _late is late:  # the block has not been left
                    log.line(f"gdtool: {late}")
                    _end(0, late.exit_code)
                continue
            if told[0] not in SIGNALS or signal.getsignal(told[0]) is not _stop:
                continue
            time.sleep(GRACE)
            if signal.getsignal(told[0]) is _stop:  # it has not been undone
                _end(told[0])
    finally:
        os.close(heard)


def _leave_time_to_clean_up() -> None:
    """Lower the soft limit of processor time below a hard one: at the hard limit the kernel kills without a signal."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_CPU)
        if hard != resource.RLIM_INFINITY and (soft == resource.RLIM_INFINITY or soft > hard - _CPU_RESERVE):
            resource.setrlimit(resource.RLIMIT_CPU, (max(hard - _CPU_RESERVE, 1), hard))
