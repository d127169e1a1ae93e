"""Check before the run what a stage would need only later: devices, packages, and the files that options name."""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from pathlib import Path

from gdtool.core.errors import InputError, ResourceError, UsageError, missing_library
from gdtool.core.reading import MAX_INTEGER_DIGITS, require_regular_file

# Degrees: a narrower perspective has its cameras farther away than float32 depth resolves an object of size 1.
LEAST_FOV = 0.01


def require_device(device: str) -> None:
    """Raise ResourceError where PyTorch cannot compute on the device ("cpu" or "cuda")."""
    if device == "cpu":
        return
    import torch

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a driver that is too old: told below
        there = torch.cuda.is_available()
    if not there:
        raise ResourceError(f"--device {device}", "is not there", "use --device cpu")


def require_package(module: str, option: str, cure: str) -> None:
    """Raise ResourceError where an option needs a package that cannot be imported."""
    try:
        importlib.import_module(module)
    except ImportError as error:
        library = None if isinstance(error, ModuleNotFoundError) else missing_library(error)
        raise library or ResourceError(option, f"needs the package {module}", cure) from None


def require_installed(module: str, option: str, cure: str) -> None:
    """Raise ResourceError where a package is not installed, without importing it: native code may end the process."""
    if importlib.util.find_spec(module) is None:
        raise ResourceError(option, f"needs the package {module}", cure)


def require_file(option: str, value: str) -> None:
    """Raise InputError unless an option names a file that can be read."""
    try:
        require_regular_file(Path(value))
    except InputError as error:
        cure = f"check the path that {option} gives" if error.fact == "does not exist" else error.cure
        raise InputError(error.subject, error.fact, cure) from None


def require_model(option: str, value: str) -> None:
    """Raise InputError unless an option names procedural:SEED or a file with the suffix of a model."""
    if value.startswith("procedural:"):
        return
    from gdtool.assets.load import SUFFIXES

    require_file(option, value)
    if Path(value).suffix.lower() not in SUFFIXES:
        raise InputError(
            value,
            "does not have the suffix of a model file",
            f"name a {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file with {option}",
        )


def require_picture(option: str, value: str) -> tuple[int, int]:
    """Return width and height of the picture that an option names, from its header.

    Raises the errors of reading it where the header cannot be read.
    """
    require_file(option, value)
    header = _header(value)
    if header is None:
        from gdtool.images.io import read_image

        height, width = read_image(value).shape[:2]  # says what is wrong; a name that is not UTF-8 it can read
        return width, height
    return header[:2]


def require_environment(option: str, value: str, names: tuple[str, ...]) -> None:
    """Raise InputError unless an option names a light.

    A light is one of names, random:NUMBER, or a lat-long picture with float pixels.
    """
    if value in names:
        return
    cure = f"use {', '.join(names)}, random:NUMBER, or an .hdr or .exr file with {option}"
    if value.startswith("random:"):
        number = value.removeprefix("random:")
        if not (number.isascii() and number.isdigit() and len(number) <= MAX_INTEGER_DIGITS and int(number) < 2**63):
            raise UsageError(f"{option} {value[:40]}", "is not random:NUMBER with a 64-bit number", cure)
        return
    try:
        require_file(option, value)
    except InputError as error:
        raise InputError(error.subject, error.fact, cure if error.fact == "does not exist" else error.cure) from None
    header = _header(value)
    if header is None or not header[2] or abs(header[0] / header[1] - 2) > 0.1:
        from gdtool.shading.lights.load import load_environment

        load_environment(value)  # says what is wrong


def require_fov(degrees: float) -> None:
    """Raise UsageError for a perspective field of view too narrow to compute with; 0 is orthographic."""
    if 0 < degrees < LEAST_FOV:
        raise UsageError(
            f"--fov {degrees:g}", f"is narrower than {LEAST_FOV:g} degrees", "use --fov 0, which is orthographic"
        )


def _header(path: str) -> tuple[int, int, bool] | None:
    """Read width and height of an image file, and whether its pixels are floats; None without a readable header."""
    import OpenImageIO as oiio

    try:
        source = oiio.ImageInput.open(path)
    except (TypeError, UnicodeError):  # a name that is not UTF-8
        return None
    if source is None:
        oiio.geterror()  # forget it
        return None
    spec = source.spec()
    source.close()
    return spec.width, spec.height, str(spec.format) in ("float", "half", "double")
