"""A process that has read what children need and forks them: each starts in milliseconds, where reading numpy and scipy takes half a second.

The side of those that ask is Nursery and Forked, what the process itself runs is main(). Children have theirs from the same one. Linux only:
elsewhere a fork without exec is not safe.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import select
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

_MESSAGE = 2**16  # bytes, at most


def python_running(code: str) -> list[str]:
    """The command of another Python that runs code beside this gdtool, whatever lies in the folder that it starts in."""
    root = str(Path(__file__).resolve().parents[2])
    return [sys.executable, "-P", "-c", f"import sys; sys.path.insert(0, {root!r}); import gdtool; del sys.path[0]; {code}"]


class Nursery:
    """Where children come from, for one process: what it asks for goes through `control`, and its children end with it, however it ends."""

    def __init__(self, control: socket.socket, process: subprocess.Popen | None = None):
        self._control, self.process = control, process
        self._lock, self._forked = threading.Lock(), 0

    @classmethod
    def start(cls, environment: dict[str, str]) -> Nursery:
        """One of this process' own; its children ask the same one for theirs."""
        own, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            code = f"from gdtool.core.child import serve; from {__name__} import main; main(serve)"
            return cls(own, subprocess.Popen([*python_running(code), str(theirs.fileno())], pass_fds=[theirs.fileno()], env=environment,
                                             stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

    def read(self, module: str) -> None:
        """Have a module imported before children ask for it."""
        self._tell(("read", module, list(sys.path)))

    def fork(self) -> Forked:
        """A child that waits for its request. Raises OSError where the nursery is no more."""
        with self._lock:
            self._forked += 1
            number = self._forked
        pipes = [os.pipe() for _ in range(4)]  # request, answer, noise, end
        theirs = [pipes[0][0], *(write for _, write in pipes[1:])]
        own = [pipes[0][1], *(read for read, _ in pipes[1:])]
        try:
            self._tell(("fork", number), theirs)
        except OSError:
            for descriptor in own:
                os.close(descriptor)
            raise
        finally:
            for descriptor in theirs:
                os.close(descriptor)
        return Forked(lambda: self._tell(("kill", number)), *own)

    def leave(self) -> None:
        """Ask no more; what was forked for this process, not for one that it is a copy of, ends."""
        self._control.close()

    def _tell(self, message: tuple, descriptors: Sequence[int] = ()) -> None:
        with self._lock:
            socket.send_fds(self._control, [pickle.dumps(message)], descriptors)


class Forked:
    """A child, as subprocess.Popen would give it: stdin, communicate(), kill() and, from the end on, returncode; and what it spent."""

    def __init__(self, kill: Callable[[], None], request: int, answer: int, noise: int, end: int):
        self._kill, self._answer, self._noise, self._end = kill, answer, noise, end
        self.stdin = os.fdopen(request, "wb")
        self.returncode: int | None = None
        self.seconds, self.nursery_seconds, self.peak_mb = 0.0, 0.0, 0.0  # of the processor, the nursery's own until then; resident at most

    def kill(self) -> None:
        with contextlib.suppress(OSError):  # the nursery is no more, and its children with it
            self._kill()

    def communicate(self) -> tuple[bytes, bytes]:
        """What it answers and what it prints, once it has ended."""
        said: dict[int, bytearray] = {self._answer: bytearray(), self._noise: bytearray(), self._end: bytearray()}
        with selectors.DefaultSelector() as selector:
            for descriptor in said:
                selector.register(descriptor, selectors.EVENT_READ)
            while selector.get_map():
                for key, _ in selector.select():
                    if some := os.read(key.fd, 2**20):
                        said[key.fd] += some
                    else:
                        selector.unregister(key.fd)
                        os.close(key.fd)
        code, *spent = said[self._end].split() or (-signal.SIGKILL, 0, 0, 0)  # nothing where the nursery died, and the child with it
        self.seconds, self.nursery_seconds, self.peak_mb = map(float, spent)
        self.returncode = int(code)
        return bytes(said[self._answer]), bytes(said[self._noise])


@dataclass
class _Owner:
    """A process that children are forked for: it knows them by numbers."""

    control: socket.socket
    since: float  # seconds of the nursery's processor before it
    children: dict[int, int] = field(default_factory=dict)  # processes by their numbers


class _Server:
    """What runs in the nursery: it imports and forks as it is told, until the process that started it is gone."""

    def __init__(self, serve: Callable[[Nursery], None], first: socket.socket):
        self._serve, self._first = serve, first
        self._owners = {first.fileno(): _Owner(first, 0.0)}
        self._ends: dict[int, tuple[int, _Owner]] = {}  # of the pipes for how processes ended, by these
        self._ended, self._wake = os.pipe()
        os.set_blocking(self._wake, False)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for the one that started it, which may go on
        self._poll = select.poll()
        for one in (self._ended, first.fileno()):
            self._poll.register(one, select.POLLIN)

    def run(self) -> None:
        while True:
            for one, _ in self._poll.poll():
                if one == self._ended:
                    os.read(self._ended, _MESSAGE)
                    self._reap()
                else:
                    self._hear(self._owners[one])

    def _hear(self, owner: _Owner) -> None:
        message, descriptors, *_ = socket.recv_fds(owner.control, _MESSAGE, 4)
        if not message:
            self._leave(owner)
            return
        what, *about = pickle.loads(message)
        if what == "read":
            module, sys.path[:] = about
            with contextlib.suppress(Exception):  # told when a function of it is asked for
                importlib.import_module(module)
        elif what == "fork":
            self._fork(owner, about[0], descriptors)
        elif about[0] in owner.children:
            os.kill(owner.children[about[0]], signal.SIGKILL)

    def _leave(self, owner: _Owner) -> None:
        if owner.control is self._first:
            os._exit(0)  # all others die with it
        self._poll.unregister(owner.control)
        del self._owners[owner.control.fileno()]
        owner.control.close()
        for pid in owner.children.values():
            os.kill(pid, signal.SIGKILL)

    def _reap(self) -> None:
        while self._ends:
            pid, status, used = os.wait4(-1, os.WNOHANG)
            if not pid:
                break
            if pid not in self._ends:
                continue
            end, owner = self._ends.pop(pid)
            owner.children = {number: other for number, other in owner.children.items() if other != pid}
            with contextlib.suppress(BrokenPipeError), os.fdopen(end, "wb") as file:
                file.write(b"%d %f %f %f" % (os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, time.process_time() - owner.since,
                                             used.ru_maxrss / 1024))

    def _fork(self, owner: _Owner, number: int, descriptors: list[int]) -> None:
        """A child whose stdin is the request, its stdout the answer, its stderr the noise."""
        *standard, end = descriptors
        own, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        nursery, pid = os.getpid(), os.fork()
        if not pid:
            try:
                die_with_parent()
                if os.getppid() != nursery:
                    os._exit(1)
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                signal.signal(signal.SIGINT, signal.default_int_handler)
                for control in (own, *(other.control for other in self._owners.values())):
                    control.close()
                for one in (self._ended, self._wake, end, *(other for other, _ in self._ends.values())):
                    os.close(one)
                for one, place in zip(standard, range(3), strict=True):
                    os.dup2(one, place)
                    os.close(one)
                self._serve(Nursery(theirs))
            finally:
                os._exit(1)
        theirs.close()
        for one in standard:
            os.close(one)
        owner.children[number], self._ends[pid] = pid, (end, owner)
        self._owners[own.fileno()] = _Owner(own, time.process_time())
        self._poll.register(own, select.POLLIN)


def main(serve: Callable[[Nursery], None]) -> None:
    """What the nursery runs. serve: what a child runs, from its stdin to its stdout; it is given where children of its own come from."""
    server = _Server(serve, socket.socket(fileno=int(sys.argv[1])))
    importlib.import_module("numpy")
    gc.disable()  # it would write to every object, whose memory the children share
    server.run()


def die_with_parent() -> None:
    """Have this process killed when the one that started it ends."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
