"""Atomic publishing: a folder appears whole or not at all, whatever kills the run.

Beside the target `surface` live, while a run works on it: `.surface.lock`, `.surface.<key>.partial` (what is being
written) and, for stages that resume, `.surface.<key>.work`.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gdtool.core import log
from gdtool.core.errors import OutputError

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


@contextmanager
def locked(target: Path, wait_seconds: float = 3600.0) -> Iterator[None]:
    """Hold the lock of a target; wait for another process that has it. Raises OutputError when it takes too long."""
    path = target.parent / f".{target.name}.lock"
    deadline, told = time.monotonic() + wait_seconds, False
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The holder before us removes the file when it is done: a lock on a removed file guards nothing.
            if os.path.exists(path) and os.stat(path).st_ino == os.fstat(handle).st_ino:
                break
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                os.close(handle)
                raise
        os.close(handle)
        if time.monotonic() > deadline:
            raise OutputError(target, "is being written by another process", "wait for it or choose another -o")
        if not told:
            log.say(f"{target}: another process is writing it; waiting")
            told = True
        time.sleep(0.05)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)


def partial_path(target: Path, key: str) -> Path:
    """Where the run with this key writes."""
    return target.parent / f".{target.name}.{key[:12]}.partial"


def workspace_path(target: Path, key: str) -> Path:
    """Where the run with this key keeps what a later run can resume from."""
    return target.parent / f".{target.name}.{key[:12]}.work"


def clear_stale(target: Path, key: str) -> None:
    """Remove what killed runs left beside the target, except the workspace of this key. The lock must be held."""
    keep = workspace_path(target, key).name
    old = target.parent / f".{target.name}.old"
    if old.exists():
        if target.exists():
            shutil.rmtree(old, ignore_errors=True)
        else:  # killed between the two renames of a file system without exchange
            old.rename(target)
    for path in target.parent.glob(f".{glob_escape(target.name)}.*"):
        if path.suffix in (".partial", ".work") and path.name != keep and path.is_dir():
            shutil.rmtree(path, ignore_errors=True)


def glob_escape(name: str) -> str:
    """A name as a glob pattern that matches only itself."""
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)


def publish(partial: Path, target: Path) -> None:
    """Put a finished folder in the target's place in one step."""
    if not target.exists():
        partial.rename(target)
        return
    if _exchange(partial, target):
        shutil.rmtree(partial, ignore_errors=True)
        return
    old = target.parent / f".{target.name}.old"
    target.rename(old)
    partial.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two paths atomically (renameat2); False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    return renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0
