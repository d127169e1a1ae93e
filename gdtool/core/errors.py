"""Errors that a user reads: one line that names the thing, the fact and the cure, and the exit code that goes with it."""

from __future__ import annotations

import errno
from pathlib import Path


class GdtoolError(Exception):
    """An error with a one-line message `subject: fact; cure` and an exit code.

    Raised directly it means exit 1; the subclasses mean what DESIGN's table of exit codes says.
    """

    exit_code = 1

    def __init__(self, subject: object, fact: str, cure: str = ""):
        self.subject, self.fact, self.cure = str(subject), fact, cure
        super().__init__(f"{subject}: {fact}" + (f"; {cure}" if cure else ""))

    def __reduce__(self):
        return type(self), (self.subject, self.fact, self.cure)


class UsageError(GdtoolError):
    """The command line asks for something that cannot be meant."""

    exit_code = 2


class InputError(GdtoolError):
    """A file, folder or manifest is not what it has to be."""

    exit_code = 3


class OutputError(GdtoolError):
    """Something cannot be read or written: permission, disk, lock."""

    exit_code = 4


class ResourceError(GdtoolError):
    """A missing optional dependency or device, or a memory or time limit."""

    exit_code = 5


def from_os_error(error: OSError, subject: object) -> GdtoolError:
    """The error to report for an OSError: what failed is in its file name, else in subject."""
    cures = {
        errno.ENOSPC: "free some space or choose another -o",
        errno.EDQUOT: "free some space or choose another -o",
        errno.EFBIG: "raise the file size limit or choose another -o",
        errno.EROFS: "choose another -o",
        errno.EACCES: "check the permissions",
        errno.EPERM: "check the permissions",
    }
    fact = error.strerror or str(error)
    return OutputError(error.filename or subject, fact[0].lower() + fact[1:], cures.get(error.errno, ""))


def bytes_of(path: Path) -> bytes:
    """What a file holds that the user named. Raises InputError where there is none, and as from_os_error() says."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "does not exist") from None
    except OSError as error:
        raise from_os_error(error, path) from None
