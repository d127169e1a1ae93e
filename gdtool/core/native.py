"""Import packages that bring native code; what keeps one from loading becomes an error with the package that removes it."""

from __future__ import annotations

import importlib
from types import ModuleType

from gdtool.core.errors import GdtoolError, ResourceError, first_line, missing_library

# What pip installs, where that is not the module's name.
_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "fast_simplification": "fast-simplification", "igl": "libigl", "pxr": "gdtool[usd]",
                  "pyQuadriFlow": "gdtool[quadriflow]", "onnxruntime": "gdtool[matting]"}


def imported(module: str) -> ModuleType:
    """Import a module of a native package, such as "pymeshlab" or "embreex.rtcore_scene".

    Raises ResourceError where the package is not installed, a shared library that it needs is missing, or it cannot be loaded.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:  # OSError: packages that load their library by ctypes
        raise import_error(error, module) from None


def imported_if_installed(module: str) -> ModuleType | None:
    """imported(), but None where the package is not installed: for one that has an equal substitute."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if _is_of(error.name, module):
            return None
        raise import_error(error, module) from None
    except (ImportError, OSError) as error:
        raise import_error(error, module) from None


def import_error(error: ImportError | OSError, module: str) -> GdtoolError:
    """The error to report for a failed import of `module`."""
    package = module.partition(".")[0]
    distribution = _DISTRIBUTIONS.get(package, package)
    install = f"'{distribution}'" if "[" in distribution else distribution
    if isinstance(error, ModuleNotFoundError):
        if _is_of(error.name, module):
            return ResourceError(package, "is not installed", f"pip install {install}")
    else:
        found = missing_library(ImportError(str(error), name=package))
        if found:
            return found
    return ResourceError(package, f"cannot be loaded ({first_line(error)})", f"pip install --force-reinstall {install}")


def _is_of(missing: str | None, module: str) -> bool:
    """Whether the module that was not found is the one asked for or a package that it is in."""
    return bool(missing) and (module == missing or module.startswith(f"{missing}."))
