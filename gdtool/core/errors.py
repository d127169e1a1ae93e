"""Define the errors that a user reads: one line that names the subject, the fact and the cure, and an exit code."""

from __future__ import annotations

import errno
import re


class GdtoolError(Exception):
    """Hold an error with a one-line message `subject: fact; cure` and an exit code.

    An instance of this class itself has exit code 1; the subclasses have the exit codes of docs/format.md.
    """

    exit_code = 1

    def __init__(self, subject: object, fact: str, cure: str):
        self.subject, self.fact, self.cure = str(subject), fact, cure
        super().__init__(f"{subject}: {fact}; {cure}")

    def __reduce__(self):
        return type(self), (self.subject, self.fact, self.cure)


class UsageError(GdtoolError):
    """Report that the command line asks for something impossible."""

    exit_code = 2


class InputError(GdtoolError):
    """Report that a file, folder or manifest breaks the rules of its format."""

    exit_code = 3


class OutputError(GdtoolError):
    """Report that something cannot be read or written: permission, disk, lock."""

    exit_code = 4


class ResourceError(GdtoolError):
    """Report that an optional dependency or a device is missing, or that a memory or time limit is reached."""

    exit_code = 5


class ChildFailed(Exception):
    """Report that a child process crashed, ran out of time or memory, or ended without a result; str() says which."""


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
# Limits of the machine, as against the disk.
_LIMITS = {
    errno.ENOMEM: "free memory or raise its limit (ulimit -v)",
    errno.EAGAIN: "raise the limit of processes (ulimit -u)",
    errno.ENFILE: "close other programs",
}
# A name that no file can have is a fault of the input, not of the disk.
_BAD_NAMES = {
    errno.ENAMETOOLONG: "shorten the name",
    errno.ELOOP: "remove the loop of links",
    errno.EILSEQ: "rename it",
}


def from_os_error(error: OSError, subject: object) -> GdtoolError:
    """Turn an OSError into an error for the user; its subject is the error's file name, else `subject`.

    Names that are too long and links that lead in a circle give InputError, limits of the machine ResourceError, all
    else OutputError.
    """
    fact = error.strerror or str(error) or type(error).__name__
    fact, named = fact[0].lower() + fact[1:], error.filename or subject
    if error.errno in _BAD_NAMES:
        return InputError(named, fact, _BAD_NAMES[error.errno])
    if error.errno in _LIMITS:
        return ResourceError(named, fact, _LIMITS[error.errno])
    return OutputError(named, fact, _CURES.get(error.errno or 0, "check that the disk and the folder can be used"))


# The Debian package of each shared library that gdtool's dependencies are linked with.
_DEBIAN_PACKAGES = {
    "libGL.so.1": "libgl1",
    "libGLU.so.1": "libglu1-mesa",
    "libOpenGL.so.0": "libopengl0",
    "libEGL.so.1": "libegl1",
    "libgomp.so.1": "libgomp1",
    "libstdc++.so.6": "libstdc++6",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libxcb.so.1": "libxcb1",
    "libglib-2.0.so.0": "libglib2.0-0",
    "libgthread-2.0.so.0": "libglib2.0-0",
    "libz.so.1": "zlib1g",
    "libfontconfig.so.1": "libfontconfig1",
    "libfreetype.so.6": "libfreetype6",
    "libdbus-1.so.3": "libdbus-1-3",
}
# Messages of the loader where it lacks address space, not the library.
_NOT_MAPPED = re.compile(r"failed to map segment|cannot allocate memory|cannot create shared object descriptor", re.I)
# The size in a message about a failed allocation, of numpy or of torch.
_ASKED = re.compile(r"(?:unable|tried) to allocate ([\d.]+) ?(bytes|[KMGT]i?B)", re.I)
_NO_LIBRARY = re.compile(r"([\w+.-]+\.so[.\d]*): cannot open shared object file")
# Messages of torch, OpenCV and C++ when memory runs out; numpy and Python raise MemoryError.
_NO_MEMORY = re.compile(
    r"out of memory|bad_alloc|can't allocate memory|not enough memory|insufficient memory|failed to allocate|unable "
    r"to allocate",
    re.I,
)
_NO_THREAD = re.compile(r"can't start new thread|resource temporarily unavailable", re.I)
_NO_DEVICE = re.compile(
    r"found no nvidia driver|not compiled with cuda|no cuda gpus are available|cuda (driver )?error|cudnn", re.I
)
_MOST_SHOWN = 200  # characters of another program's message


def first_line(error: BaseException) -> str:
    """Return the first line of an exception's message, shortened."""
    return (str(error).strip() or "no message").splitlines()[0][:_MOST_SHOWN]


def missing_library(error: ImportError) -> GdtoolError | None:
    """Turn an ImportError for a missing system library or Python package into an error for the user.

    Returns None for any other ImportError: a module of gdtool that cannot be imported is a fault of gdtool.
    """
    library = _NO_LIBRARY.search(str(error))
    if library:
        needed_by = (error.name or "").partition(".")[0]
        package = _DEBIAN_PACKAGES.get(library[1])
        return ResourceError(
            library[1],
            "is not installed" + (f", and {needed_by} needs it" if needed_by else ""),
            f"apt install {package}" if package else f"install the system package that holds {library[1]}",
        )
    if isinstance(error, ModuleNotFoundError) and error.name and error.name.partition(".")[0] != "gdtool":
        return ResourceError(error.name, "is not installed", "pip install gdtool, which brings what it needs")
    return None


def from_exception(error: Exception, subject: object) -> GdtoolError:
    """Turn any exception that was raised while working on subject into an error for the user.

    A GdtoolError is returned unchanged. Faults of the system, the memory, a device or a missing library become
    OutputError, InputError or ResourceError. All else becomes a GdtoolError with exit code 1, "internal error".
    """
    if isinstance(error, GdtoolError):
        return error
    problem: GdtoolError | None = None
    first = first_line(error)
    native = isinstance(error, RuntimeError) or type(error).__module__.partition(".")[0] in ("cv2", "torch", "scipy")
    if isinstance(error, MemoryError) or native and _NO_MEMORY.search(str(error)):
        problem = ResourceError(
            subject, "ran out of memory" + allocation_size(error), "lower the resolution or free memory"
        )
    elif isinstance(error, OSError):
        problem = from_os_error(error, subject)
    elif isinstance(error, ImportError) and is_unmapped(error):
        problem = ResourceError(
            subject,
            f"ran out of memory while {error.name or 'a library'} was loaded",
            "free memory or raise its limit (ulimit -v)",
        )
    elif isinstance(error, ImportError):
        problem = missing_library(error)
    elif isinstance(error, ChildFailed):
        problem = ResourceError(subject, f"a step of it failed ({first})", "free memory, or give it a smaller input")
    elif native and _NO_THREAD.search(str(error)):
        problem = ResourceError(
            subject,
            f"cannot start a thread ({first})",
            "raise the limit of processes (ulimit -u) or of memory (ulimit -v)",
        )
    elif isinstance(error, (RuntimeError, AssertionError)) and _NO_DEVICE.search(str(error)):
        problem = ResourceError(subject, f"the device failed ({first})", "run it on the cpu")
    return problem or internal_error(error, subject)


def is_unmapped(error: BaseException) -> bool:
    """Tell whether an import failed because there was no memory to load a library into."""
    return bool(_NOT_MAPPED.search(str(error)))


def allocation_size(error: BaseException) -> str:
    """Return the size of the allocation that failed, in parentheses; empty where the message does not say."""
    request = _ASKED.search(str(error))
    if not request:
        return ""
    amount, unit = float(request[1]), request[2]
    return f" (it asked for {amount / 2**30:.2f} GiB)" if unit == "bytes" else f" (it asked for {amount:g} {unit})"


def internal_error(error: BaseException, subject: object) -> GdtoolError:
    """Make the error that reports a fault of gdtool itself."""
    return GdtoolError(
        subject,
        f"internal error ({type(error).__name__}: {first_line(error)})",
        "run it again with --debug to see where, and report that",
    )
