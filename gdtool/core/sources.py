"""Resolve the sources of a command: folders, files, procedural:SEED; their names, digests and order of arrival."""

from __future__ import annotations

import functools
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from gdtool.core.errors import InputError, ResourceError, UsageError
from gdtool.core.folder import Folder, is_folder, open_folder
from gdtool.core.kinds import MADE_BY
from gdtool.core.manifest import digest_of, file_sha256
from gdtool.core.names import name_from_path, quoted, text_fault
from gdtool.core.reading import MAX_INTEGER_DIGITS, parse_json, require_regular_file
from gdtool.core.references import referred_files

PROCEDURAL = re.compile(r"procedural:([0-9]+)(?:\.\.([0-9]+))?")

Source = Folder | Path | str  # a str is procedural:SEED
PICTURES = "pictures"  # a kind of source: a folder of another program, without a manifest


def expand(text: str) -> Iterator[str]:
    """Expand procedural:A..B to one source for each seed; any other text is returned unchanged.

    Raises UsageError for a malformed range.
    """
    if not text.startswith("procedural:"):
        yield text
        return
    match = PROCEDURAL.fullmatch(text)
    if not match:
        raise UsageError(
            quoted(text),
            "is not procedural:SEED or procedural:FIRST..LAST",
            "give whole numbers, as in procedural:0..9",
        )
    if any(len(digits) > MAX_INTEGER_DIGITS or int(digits) >= 2**63 for digits in (match[1], match[2] or "0")):
        raise UsageError(quoted(text), "has a seed beyond 64 bits", f"give seeds up to {2**63 - 1}")
    first = int(match[1])
    last = first if match[2] is None else int(match[2])
    if last < first:
        raise UsageError(quoted(text), "ends before it begins", f"write procedural:{last}..{first}")
    for seed in range(first, last + 1):
        yield f"procedural:{seed}" if match[2] else text


def incoming(arguments: tuple[str, ...]) -> Iterator[str]:
    """Yield sources in order: the arguments, or without any the lines of stdin, each as soon as it arrives.

    Raises UsageError where both are empty: then the command before the pipe has failed, and the whole pipe has to fail.
    Arguments that cannot be sources raise UsageError before the first source is worked on.
    """
    empty = True
    for text in arguments:
        next(expand(_checked(text)))
    for text in arguments or _lines():
        empty = False
        yield from expand(text)
    if empty and (sys.stdin is None or sys.stdin.isatty()):
        raise UsageError("stdin", "gave no sources", "name files or folders, or pipe their paths in")
    if empty:
        cure = "the command before the pipe has failed or printed nothing: see its message, or name files or folders"
        raise UsageError("stdin", "gave no sources", cure)


MAX_LINE_BYTES = 2**20  # of stdin; a line of --json with all that was skipped takes some thousands


def _lines() -> Iterator[str]:
    """Yield the sources of stdin, one a line: paths, or objects of --json. Raises UsageError."""
    if sys.stdin is None or sys.stdin.isatty():
        return
    for raw in iter(functools.partial(sys.stdin.buffer.readline, MAX_LINE_BYTES + 1), b""):
        if len(raw) > MAX_LINE_BYTES:
            raise UsageError("stdin", f"has a line of more than {MAX_LINE_BYTES} bytes", "pipe paths in, one a line")
        line: str | None = os.fsdecode(raw.rstrip(b"\r\n"))
        if line and line.startswith("{"):
            line = _folder_of(raw, line)
        if line:
            yield _checked(line)


def _folder_of(raw: bytes, line: str) -> str | None:
    """Return the folder that a line of --json names; None where the line is not of that form. Raises UsageError."""
    try:
        record = parse_json(raw, "stdin")
    except InputError as error:
        raise UsageError(
            "stdin", f"line {quoted(line, 60)} {error.fact}", "pipe in paths, or what --json prints"
        ) from None
    if isinstance(record, dict) and "folder" in record and isinstance(record["folder"], str | None):
        return record["folder"]
    raise UsageError(
        "stdin",
        f"line {quoted(line, 60)} is neither a path nor an object of --json",
        "pipe in paths, or what --json prints",
    )


def _checked(text: str) -> str:
    """Return a source that is one line of text. Raises UsageError for control characters and NUL."""
    fault = text_fault(text, byte_escapes=True)
    if fault:
        raise UsageError(quoted(text), fault, "rename it without that character")
    return text


def resolve(text: str, kinds: tuple[str, ...], reader: str, allow_missing: bool = False) -> Source:
    """Open what a source names. Raises InputError when it is missing or of the wrong kind."""
    if text.startswith("procedural:"):
        if "model-file" not in kinds and "mesh-file" not in kinds:
            raise InputError(
                text, f"names a model, but {reader} reads {_words(kinds)}", "run gdtool render-dataset first"
            )
        return text
    path = Path(text)
    folder_kinds = tuple(kind for kind in kinds if not kind.endswith("-file"))
    if PICTURES in kinds and path.is_dir() and not is_folder(path):
        return path
    if path.is_dir() or path.name == "manifest.json":
        if not folder_kinds and not is_folder(path):
            raise InputError(path, f"is a folder, but {reader} reads {_words(kinds)}", f"name a file in {path}")
        return open_folder(path, folder_kinds or ("a file",), reader)
    if not (allow_missing and not os.path.lexists(path)):
        require_regular_file(path)
    if path.exists() and len(folder_kinds) == len(kinds):
        raise InputError(
            path,
            f"is a file, but {reader} reads a {_words(kinds)} folder",
            f"name a folder that gdtool {MADE_BY[folder_kinds[0]]} has written"
            if folder_kinds[0] in MADE_BY
            else "name the folder that it lies in",
        )
    return path


def _words(kinds: tuple[str, ...]) -> str:
    """Join kinds for a message."""
    return " or ".join(kind.replace("-file", " files") for kind in kinds)


HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+$")


def hub_folder(text: str, revision: str = "") -> str:
    """Return the folder of a Hugging Face hub id, downloaded once; an existing path and text that is no id are returned
    unchanged.

    revision: a branch, tag or commit; "" is the main branch. Raises ResourceError without huggingface_hub, InputError
    where the download fails.
    """
    if Path(text).exists() or not HUB_ID.match(text):
        return text
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise ResourceError(
            text,
            "does not exist here, and huggingface_hub, which could download it, is not installed",
            "pip install 'gdtool[hub]', or give a local folder",
        ) from None
    try:
        return snapshot_download(text, revision=revision or None, allow_patterns=["*.json", "*.safetensors"])
    except Exception as error:  # of several libraries: no network, no such id, no permission
        raise InputError(
            text,
            f"is not a folder here, and cannot be downloaded from the hub ({type(error).__name__})",
            "check the id and the network, or give a local folder",
        ) from None


def name_of(source: Source) -> str:
    """Return the object's name: the manifest's for a folder, the stem of a file."""
    if isinstance(source, Folder):
        return source.name
    if isinstance(source, str):
        return "procedural-" + source.split(":")[1].zfill(6)
    return name_from_path(source.resolve().name if source.is_dir() else source.stem)


def digest(source: Source) -> str:
    """Compute a sha256 of a source's content; for .gltf and .obj it covers the files that they name."""
    if isinstance(source, Folder):
        return source.manifest.digest
    if isinstance(source, str):
        from gdtool.assets.procedural import VERSION

        return digest_of(["procedural", VERSION, source])
    if source.is_dir():
        files = sorted(path for path in source.rglob("*") if path.is_file())
        return digest_of([[path.relative_to(source).as_posix(), file_sha256(path)] for path in files])
    return digest_of([file_sha256(path) for path in (source, *referred_files(source)) if path.is_file()])


def relative_to(path: Path | str, folder: Path) -> str:
    """Return path relative to folder, links in folder resolved, with forward slashes; procedural:SEED is returned
    unchanged.
    """
    if isinstance(path, str):
        return path
    # Where both really lie, but for a link that the path itself is: ".." from a folder reached by a link does not lead
    # back along the link.
    real = Path(os.path.realpath(path.parent), path.name) if path.name not in ("", "..") else path.resolve()
    return Path(os.path.relpath(real, os.path.realpath(folder))).as_posix()


__all__ = ["Source", "digest", "expand", "incoming", "name_of", "relative_to", "resolve"]
