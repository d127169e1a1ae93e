"""Import packages that bring native code; what keeps one from loading becomes an error with the package that removes it."""

from __future__ import annotations

import importlib
import re
from types import ModuleType

from gdtool.core.errors import ResourceError

# The Debian package of a shared library that wheels expect from the system.
_DEBIAN = {
    "libEGL.so.1": "libegl1", "libGL.so.1": "libgl1", "libGLU.so.1": "libglu1-mesa", "libOpenGL.so.0": "libopengl0", "libGLX.so.0": "libglx0",
    "libX11.so.6": "libx11-6", "libXext.so.6": "libxext6", "libXrender.so.1": "libxrender1", "libSM.so.6": "libsm6", "libICE.so.6": "libice6",
    "libglib-2.0.so.0": "libglib2.0-0", "libgthread-2.0.so.0": "libglib2.0-0", "libgomp.so.1": "libgomp1", "libstdc++.so.6": "libstdc++6",
    "libfontconfig.so.1": "libfontconfig1", "libfreetype.so.6": "libfreetype6", "libtbb.so.12": "libtbb12", "libz.so.1": "zlib1g",
}
# What pip installs, where that is not the module's name.
_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "fast_simplification": "fast-simplification", "igl": "libigl", "pxr": "gdtool[usd]",
                  "pyQuadriFlow": "gdtool[quadriflow]", "onnxruntime": "gdtool[matting]"}
_NO_LIBRARY = re.compile(r"([\w.+-]+\.so[\w.]*): (?:cannot open shared object file|file not found)")


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


def import_error(error: ImportError | OSError, module: str) -> ResourceError:
    """The error to report for a failed import of `module`."""
    package = module.partition(".")[0]
    distribution = _DISTRIBUTIONS.get(package, package)
    install = f"pip install '{distribution}'" if "[" in distribution else f"pip install {distribution}"
    if isinstance(error, ModuleNotFoundError) and _is_of(error.name, module):
        return ResourceError(package, "is not installed", install)
    missing = _NO_LIBRARY.search(str(error))
    if missing:
        library = missing[1]
        return ResourceError(package, f"needs {library}, which this system does not have",
                             f"apt install {_DEBIAN[library]}" if library in _DEBIAN else f"install the system package that holds {library}")
    lines = str(error).strip().splitlines()
    return ResourceError(package, f"cannot be loaded ({lines[0] if lines else type(error).__name__})", install.replace("install", "install --force-reinstall"))


def _is_of(missing: str | None, module: str) -> bool:
    """Whether the module that was not found is the one asked for or a package that it is in."""
    return bool(missing) and (module == missing or module.startswith(f"{missing}."))
