"""Import packages with native code, report what is missing, and reserve the memory that they need."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from types import ModuleType

from gdtool.core.errors import GdtoolError, ResourceError, first_line, is_unmapped, missing_library

# Name of the package for pip, where it differs from the module's.
_DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "fast_simplification": "fast-simplification",
    "igl": "libigl",
    "pxr": "gdtool[usd]",
    "pyQuadriFlow": "gdtool[quadriflow]",
    "onnxruntime": "gdtool[matting]",
}


def imported(module: str) -> ModuleType:
    """Import a module of a native package, such as "pymeshlab" or "embreex.rtcore_scene".

    Raises ResourceError where the package is not installed, a shared library that it needs is missing, or it cannot be
    loaded."""
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: packages that load their library by ctypes
        raise import_error(error, module) from None


def imported_if_installed(module: str) -> ModuleType | None:
    """Import a module as imported() does, or return None where its package is not installed.

    It is for packages that the caller can do without.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if _is_package_of(error.name, module):
            return None
        raise import_error(error, module) from None
    except (ImportError, OSError) as error:
        raise import_error(error, module) from None


def import_error(error: ImportError | OSError, module: str) -> GdtoolError | MemoryError:
    """Turn a failed import of `module` into an error for the user.

    It is MemoryError where there was no memory to load the library: in a child with a memory limit that is a reason to
    fall back, elsewhere exit code 5.
    """
    if is_unmapped(error):
        return MemoryError(f"no memory to load {module}")
    package = module.partition(".")[0]
    distribution = _DISTRIBUTIONS.get(package, package)
    install = f"'{distribution}'" if "[" in distribution else distribution
    if isinstance(error, ModuleNotFoundError):
        if _is_package_of(error.name, module):
            return ResourceError(package, "is not installed", f"pip install {install}")
    else:
        problem = missing_library(ImportError(str(error), name=package))
        if problem:
            return problem
    return ResourceError(package, f"cannot be loaded ({first_line(error)})", f"pip install --force-reinstall {install}")


def require_address_space(size: int, what: str) -> None:
    """Raise MemoryError when the limit on this process's address space (RLIMIT_AS) leaves less than `size` bytes.

    It is for libraries that crash where an allocation fails. what: names the memory in the message.
    """
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return
        with Path("/proc/self/statm").open() as file:
            left = limit - int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError):  # Windows, or no /proc to tell what is used
        return
    if size > left:
        raise MemoryError(
            f"unable to allocate {size / 2**30:.2f} GiB for {what}: {max(left, 0) / 2**30:.2f} GiB of the limit are "
            f"left"
        )


def _is_package_of(missing: str | None, module: str) -> bool:
    """Tell whether the module that was not found is the requested one, or a package that contains it."""
    return bool(missing) and (module == missing or module.startswith(f"{missing}."))
