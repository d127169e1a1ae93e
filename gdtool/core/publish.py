"""Publish a folder atomically: it appears complete or not at all, even where the run is killed.

While a run works on the target `surface`, these lie beside it: `.surface.lock`; `.surface.<key>.partial`, which the run
writes; `.surface.<key>.old`, the replaced folder, for a moment where the system cannot swap two folders; and, for
stages that resume, `.surface.<key>.work`. <key> is the first twelve hexadecimal digits of the run's key.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import re
import shutil
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gdtool.core import ending, log
from gdtool.core.errors import OutputError

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


@contextmanager
def locked(target: Path, wait_seconds: float = 3600.0) -> Iterator[None]:
    """Hold the lock of a target, and wait where another process has it. Raises OutputError after wait_seconds."""
    path = target.parent / f".{target.name}.lock"
    deadline, is_announced = time.monotonic() + wait_seconds, False
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW, 0o666)
        if os.fstat(handle).st_size:  # gdtool's lock is empty, and is removed in the end
            os.close(handle)
            raise OutputError(
                path,
                "stands where the output's lock file belongs, and gdtool did not write it",
                "move it away, or choose another -o",
            )
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The holder before us removes the file when it is done: a lock on a removed file guards nothing.
            if path.exists() and path.stat().st_ino == os.fstat(handle).st_ino:
                break
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                os.close(handle)
                raise
        os.close(handle)
        if time.monotonic() > deadline:
            raise OutputError(target, "is being written by another process", "wait for it or choose another -o")
        if not is_announced:
            log.say(f"{target}: another process is writing it; waiting")
            is_announced = True
        time.sleep(0.05)
    try:
        with ending.guaranteed_clean_up(lambda: path.unlink(missing_ok=True)):
            yield
    finally:
        os.close(handle)


KEY_DIGITS = 12  # of the key, in the names beside the target


def partial_path(target: Path, key: str) -> Path:
    """Return the folder that the run with this key writes."""
    return _beside(target, key, "partial")


def workspace_path(target: Path, key: str) -> Path:
    """Return the folder in which the run with this key keeps what a later run can resume from."""
    return _beside(target, key, "work")


def _beside(target: Path, key: str, use: str) -> Path:
    """Return the hidden path `.<target>.<key>.<use>` beside the target; use: "partial", "old" or "work"."""
    return target.parent / f".{target.name}.{key[:KEY_DIGITS]}.{use}"


def _leftovers(target: Path, *uses: str) -> list[Path]:
    """List the hidden folders beside the target that its runs have left.

    uses: "partial", "old" or "work", the last part of their names.
    """
    pattern = re.compile(re.escape(f".{target.name}.") + f"[0-9a-f]{{{KEY_DIGITS}}}" + r"\.(" + "|".join(uses) + ")")
    return sorted(
        path
        for path in target.parent.iterdir()
        if pattern.fullmatch(path.name) and path.is_dir() and not path.is_symlink()
    )


def clear_stale(target: Path) -> None:
    """Remove the half-written folders that killed runs left beside the target. The lock must be held.

    Under the lock no run of this output is alive. Workspaces stay, those of other options too: they may hold hours of a
    training. clear_workspaces() removes them after a publication.
    """
    for old in _leftovers(target, "old"):
        if target.exists():
            remove_tree(old)
        else:  # killed between the two renames of a file system without exchange
            old.rename(target)
    for path in _leftovers(target, "partial"):
        remove_tree(path)


def clear_workspaces(target: Path) -> None:
    """Remove the workspaces of this output, which is finished. The lock must be held."""
    for path in _leftovers(target, "work"):
        remove_tree(path)


def remove_tree(folder: Path) -> None:
    """Remove a folder that gdtool wrote, as far as the system permits; a link is not followed.

    Folders that a umask has left without permissions are removed as well.
    """
    if folder.is_symlink() or not folder.is_dir():
        return

    with contextlib.suppress(OSError):
        folder.chmod(folder.stat().st_mode | stat.S_IRWXU)
        for root, folders, _ in os.walk(folder):
            for path in (Path(root, name) for name in folders):
                if not path.is_symlink():  # before os.walk looks into it
                    path.chmod(path.stat().st_mode | stat.S_IRWXU)
    shutil.rmtree(folder, ignore_errors=True)


def require_replaceable(target: Path) -> None:
    """Raise OutputError where this user has no permission to remove the folder at target, or a folder in it."""
    for root, _, _ in os.walk(target):
        if not os.access(root, os.W_OK | os.X_OK):
            raise OutputError(
                root, "cannot be replaced: it is not writable", "check its permissions or choose another -o"
            )


def publish(partial: Path, target: Path) -> None:
    """Move a finished folder to the target in one step, and remove the folder that was there."""
    if not target.exists():
        partial.rename(target)
        return
    if _exchange(partial, target):
        remove_tree(partial)
        return
    old = partial.with_suffix(".old")
    target.rename(old)
    partial.rename(target)
    remove_tree(old)


def _exchange(a: Path, b: Path) -> bool:
    """Swap two paths atomically (renameat2); returns False where the system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    return renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0
