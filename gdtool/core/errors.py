"""Errors that a user reads: one line that names the thing, the fact and the cure, and the exit code that goes with it."""

from __future__ import annotations

import errno


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


# What to do about an error of the system, by its number.
_CURES = {
    errno.ENOSPC: "free some space or choose another -o",
    errno.EDQUOT: "free some space or choose another -o",
    errno.EFBIG: "raise the file size limit or choose another -o",
    errno.EROFS: "choose another -o",
    errno.EACCES: "check the permissions",
    errno.EPERM: "check the permissions",
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "check the path: one of its folders is a file",
    errno.EISDIR: "name a file inside it",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.EIO: "check the disk",
}
# A name that no file can have is a fault of what was given, not of the disk.
_BAD_NAMES = {errno.ENAMETOOLONG: "shorten the name", errno.ELOOP: "remove the loop of links", errno.EILSEQ: "rename it"}


def from_os_error(error: OSError, subject: object) -> GdtoolError:
    """The error to report for an OSError: what failed is in its file name, else in subject.

    InputError for names that are too long or lead in a circle, OutputError for all else.
    """
    fact = error.strerror or str(error) or type(error).__name__
    fact, place = fact[0].lower() + fact[1:], error.filename or subject
    if error.errno in _BAD_NAMES:
        return InputError(place, fact, _BAD_NAMES[error.errno])
    return OutputError(place, fact, _CURES.get(error.errno, "check that the disk and the folder can be used"))
