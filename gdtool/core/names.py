"""Turn names that stand inside files into paths, and refuse those that lead elsewhere.

A manifest, a dataset index, an archive, a glTF or an OBJ may come from anyone. A name in it becomes a path only through
path_inside(), so that no file outside of its folder is ever read or written.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from urllib.parse import unquote

from gdtool.core.errors import InputError

MAX_NAME_BYTES = 255  # of one component: NAME_MAX of Linux and macOS file systems
MAX_PATH_BYTES = 4095  # of a whole path: PATH_MAX of Linux, less its final NUL

CURE = "rename it to letters, digits, dots, dashes and underscores"

_DRIVE = re.compile(r"[A-Za-z]:")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
# Bytes of a file name that is not UTF-8, as Python holds them (PEP 383); any other lone surrogate names no file.
_BYTE_ESCAPES = range(0xDC80, 0xDD00)


def text_fault(text: str, byte_escapes: bool = False) -> str | None:
    """Say why text cannot be a name or a line of output; None where it can.

    Refused are NUL, control characters (C0, DEL, C1) and lone surrogates. byte_escapes: accept U+DC80 to U+DCFF, which
    stand for the bytes of a name on disk that is not UTF-8.
    """
    for character in text:
        code = ord(character)
        if code == 0:
            return "holds a NUL character"
        if code < 0x20 or 0x7F <= code < 0xA0:
            return f"holds the control character U+{code:04X}"
        if 0xD800 <= code < 0xE000 and not (byte_escapes and code in _BYTE_ESCAPES):
            return f"holds the lone surrogate U+{code:04X}"
    return None


def name_fault(text: str, byte_escapes: bool = False) -> str | None:
    """Say why text cannot be one component of a path; None where it can."""
    if not text:
        return "is empty"
    if text in (".", ".."):
        return "is not a name"
    if "/" in text or "\\" in text:
        return "holds a separator"
    if _DRIVE.match(text):
        return "begins with a drive"
    fault = text_fault(text, byte_escapes)
    if fault is None and len(os.fsencode(text)) > MAX_NAME_BYTES:
        return f"is longer than {MAX_NAME_BYTES} bytes"
    return fault


def checked_name(text: str, subject: object, what: str) -> str:
    """Return text where it is a single component of a path. Raises InputError.

    subject: the file that the name stands in. what: what it names there. Both are for the message.
    """
    fault = name_fault(text)
    if fault:
        raise InputError(subject, f"{what} {quoted(text)} {fault}", CURE)
    return text


def path_inside(
    folder: Path, relative: str, subject: object, what: str, *, levels_up: int = 0, byte_escapes: bool = False
) -> Path:
    """Return folder / relative for a name inside a file, and check that it lies below folder, links followed.

    relative: components with forward slashes. An absolute path, a drive, a backslash, control characters, lone
    surrogates and over-long names are refused. levels_up: how many folders above `folder` still belong to it. subject:
    the file that holds the name. what: what it names. The path need not exist. Raises InputError.
    """
    parts = relative_parts(relative, subject, what, levels_up=levels_up, byte_escapes=byte_escapes)
    path = folder.joinpath(*parts)
    try:
        root, target = folder.resolve(), path.resolve()
    except (OSError, RuntimeError):  # a loop of links
        raise InputError(
            subject, f"{what} {quoted(relative)} is a link that leads nowhere", "replace the link by the file itself"
        ) from None
    for _ in range(levels_up):
        root = root.parent
    if not target.is_relative_to(root):
        raise InputError(
            subject, f"{what} {quoted(relative)} is a link that leaves {folder}", "replace the link by the file itself"
        )
    return path


def relative_parts(
    relative: str, subject: object, what: str, *, levels_up: int | None = 0, byte_escapes: bool = False
) -> tuple[str, ...]:
    """Split a relative path in a file into components, without "." but with "..".

    levels_up: how far ".." may lead above the start; None: any distance. Raises InputError as path_inside() does.
    """
    parts: list[str] = []
    depth = 0
    fault = "is empty" if not relative else "is absolute" if relative.startswith(("/", "\\")) else None
    for part in relative.split("/"):
        if fault:
            break
        if part in ("", "."):
            continue
        if part == "..":
            depth -= 1
            if levels_up is not None and depth < -levels_up:
                fault = "leaves its folder"
        else:
            fault = name_fault(part, byte_escapes)
            depth += 1
        parts.append(part)
    if not fault and not parts:
        fault = "names no file"
    if not fault and len(os.fsencode(relative)) > MAX_PATH_BYTES:
        fault = f"is longer than {MAX_PATH_BYTES} bytes"
    if fault:
        cure = (
            "put the file beside or below the one that names it"
            if fault in ("is absolute", "leaves its folder", "begins with a drive")
            else CURE
        )
        raise InputError(subject, f"{what} {quoted(relative)} {fault}", cure)
    return tuple(parts)


def uri_path(folder: Path, uri: str, subject: object, what: str, *, levels_up: int = 0) -> Path:
    """Return the path of the file that a relative URI in a model stands for; plain file names are accepted too.

    The URI is percent-decoded before it is checked. Where a file exists under the undecoded name, with its percent
    signs, that file is taken. Backslashes count as slashes. A scheme (file:, http:, C:) is refused. Raises InputError.
    """
    decoded = unquote(uri)
    for text in (uri, decoded):
        if _SCHEME.match(text):
            raise InputError(
                subject,
                f"{what} {quoted(uri)} does not name a local file",
                "put the file beside or below the one that names it",
            )
    literal, plain = uri.replace("\\", "/"), decoded.replace("\\", "/")
    path = path_inside(folder, plain, subject, what, levels_up=levels_up)
    if literal != plain and text_fault(literal) is None:
        written = path_inside(folder, literal, subject, what, levels_up=levels_up)
        if written.is_file():
            return written
    return path


def quoted(text: str, max_length: int = 80) -> str:
    """Quote text for a message: escaped, and shortened where it is long."""
    return ascii(text) if len(text) <= max_length else ascii(text[:max_length]) + "…"


def name_from_path(text: str) -> str:
    """Make an object's name from a file's.

    Bytes that are not UTF-8 are read as Latin-1; characters that a name may not hold become underscores.
    """
    plain = "".join(chr(ord(c) - 0xDC00) if ord(c) in _BYTE_ESCAPES else c for c in text)
    name = "".join("_" if c in "/\\" or text_fault(c) else c for c in plain)
    if _DRIVE.match(name):
        name = name.replace(":", "_", 1)
    return "_" if name in ("", ".", "..") else name
