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

# Seconds after which a time limit that was reached during an import is checked again.
_RETRY_SECONDS = 0.1

# Seconds between the soft and the hard limit of processor time, for the clean-up.
_CPU_RESERVE = 2

_ALARM = getattr(signal, "SIGALRM", None)  # of time limits

received: int | None = None  # the first signal that asked for the end
_ignores_signals = False
_late_error: GdtoolError | None = None  # the error of the time limit that holds now
_clean_ups: list[Callable[[], None]] = []


class Stopped(KeyboardInterrupt):
    """Report that a signal asked this process to end. It is a KeyboardInterrupt, so that libraries do not catch it."""

    def __init__(self, number: int):
        self.number = number
        super().__init__(number)


def listen() -> Callable[[], None]:
    """Make the signals that ask a process to end (SIGNALS) raise Stopped in the main thread, once.

    Signals that the caller ignores stay ignored. Returns a function that restores the previous handlers. Where listen()
    is active already, neither it nor the returned function does anything.
    """
    global received, _ignores_signals
    before = {number: signal.getsignal(number) for number in SIGNALS}
    if _handle_signal in before.values():
        return lambda: None
    received, _ignores_signals = None, False
    _leave_time_to_clean_up()
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    _start_thread(read_end)
    wakeup = signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _handle_signal)

    def undo() -> None:
        global received, _ignores_signals
        received, _ignores_signals = None, False
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        signal.set_wakeup_fd(wakeup)
        os.close(write_end)  # the thread ends

    return undo


def ignore() -> None:
    """Ignore further signals, because the process is about to end.

    The thread that listen() started still ends the process GRACE seconds after the first signal.
    """
    global _ignores_signals
    _ignores_signals = True


@contextmanager
def guaranteed_clean_up(clean_up: Callable[[], None]) -> Iterator[None]:
    """Run clean_up at the end of the block, and also where a signal ends the process during a native call.

    clean_up may run twice, at the same time from two threads.
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
    with guaranteed_clean_up(lambda: shutil.rmtree(folder, ignore_errors=True)):
        yield folder


class TimeOver(BaseException):
    """Report that a time limit is over; not an Exception, so that no fallback takes it for a failed attempt."""


@contextmanager
def time_limit(seconds: float, late: GdtoolError) -> Iterator[None]:
    """Raise the error `late` in a block that takes longer than `seconds`.

    Where a native call goes on for GRACE seconds more, the whole process ends with that error. The limit holds in the
    main thread only, and only where the system has SIGALRM. It cannot be nested.
    """
    global _late_error
    if _ALARM is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    before, _late_error = signal.signal(_ALARM, _handle_alarm), late
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    except TimeOver:
        raise late from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        _late_error = None
        signal.signal(_ALARM, before)


def _handle_alarm(_number: int, frame: FrameType | None) -> None:
    """Handle SIGALRM: raise TimeOver, or try again later while a module is being imported."""
    if _is_importing(frame):
        signal.setitimer(signal.ITIMER_REAL, _RETRY_SECONDS)
    elif _late_error is not None and received is None:
        raise TimeOver


def _handle_signal(number: int, frame: FrameType | None) -> None:
    """Handle the first signal: raise Stopped, or end at once while a module is being imported."""
    global received
    if received is not None or _ignores_signals:  # a second Ctrl-C does not cut the clean-up short
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
    """Clean up and end the process now, with exit code `code`, or 128 + number of a signal without it."""
    for clean_up in reversed(_clean_ups):
        with contextlib.suppress(Exception):
            clean_up()
    os._exit(128 + number if code is None else code)


def _start_thread(read_end: int) -> None:
    """Start the thread that ends the process where the main thread cannot; read_end: of the pipe for signal numbers."""
    import _thread

    with contextlib.suppress(RuntimeError):  # no thread can be started: the process then ends only after a native call
        _thread.start_new_thread(_watch, (read_end,))


def _watch(read_end: int) -> None:
    """End the process GRACE seconds after the first signal, whose number Python writes to the pipe `read_end`."""
    try:
        while signal_byte := os.read(read_end, 1):
            if signal_byte[0] == _ALARM:
                late = _late_error
                time.sleep(GRACE)
                if late is not None and _late_error is late:  # the block has not been left
                    log.line(f"gdtool: {late}")
                    _end(0, late.exit_code)
                continue
            if signal_byte[0] not in SIGNALS or signal.getsignal(signal_byte[0]) is not _handle_signal:
                continue
            time.sleep(GRACE)
            if signal.getsignal(signal_byte[0]) is _handle_signal:  # it has not been undone
                _end(signal_byte[0])
    finally:
        os.close(read_end)


def _leave_time_to_clean_up() -> None:
    """Lower the soft limit of processor time below a hard one: at the hard limit the kernel kills without a signal."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_CPU)
        if hard != resource.RLIM_INFINITY and (soft == resource.RLIM_INFINITY or soft > hard - _CPU_RESERVE):
            resource.setrlimit(resource.RLIMIT_CPU, (max(hard - _CPU_RESERVE, 1), hard))
