"""Read, check and write manifest.json: what a folder holds, what it was made from and how.

A folder gets its manifest last. So a folder with a manifest is complete.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError
from gdtool.core.kinds import CONTENTS, Content, Scalar
from gdtool.core.names import checked_name, path_inside, relative_parts
from gdtool.core.reading import read_json

FORMAT = 1
MANIFEST = "manifest.json"

Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class FileEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file of the folder."""

    path: Annotated[str, Meta(description="relative to the folder, forward slashes")]
    size: Annotated[int, Meta(ge=0)]
    sha256: Sha256


class InputEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One input that the folder was made from."""

    role: Annotated[str, Meta(description="source, or the name of the flag that gave it")]
    path: Annotated[str, Meta(description="relative to the folder, or procedural:SEED")]
    digest: Sha256


class Skip(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Work that the scene did not need."""

    what: str
    reason: str
    saved_seconds: float | None = None


class RunRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the run went; outside every digest, so that equal results have equal digests."""

    seconds: dict[str, float] = {}
    total_seconds: float = 0.0
    peak_memory_mb: float = 0.0
    finished: str = ""


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """manifest.json of every kind; content has the type that CONTENTS names for the kind."""

    format: Annotated[int, Meta(ge=1)] = FORMAT
    kind: str
    name: Annotated[str, Meta(description="the object's name")]
    stage: Annotated[str, Meta(description="what made the folder; any name when it was not gdtool")]
    stage_version: Annotated[int, Meta(ge=0)] = 0
    tool_version: str = ""
    key: Annotated[str, Meta(description="sha256 of stage, stage version, options and input digests; may be empty")] = (
        ""
    )
    options: dict[str, Any] = {}
    inputs: tuple[InputEntry, ...] = ()
    content: Any
    skipped: tuple[Skip, ...] = ()
    warnings: tuple[str, ...] = ()
    files: tuple[FileEntry, ...]
    run: RunRecord = RunRecord()

    @property
    def digest(self) -> str:
        """sha256 of the folder's kind, format, content and files; neither time nor options are part of it."""
        return digest_of([self.format, self.kind, self.content, sorted((f.path, f.sha256) for f in self.files)])


def digest_of(value: Any) -> str:
    """Compute the sha256 of the canonical JSON of a value."""
    text = json.dumps(msgspec.to_builtins(value), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def file_sha256(path: Path) -> str:
    """Compute the sha256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def encode(manifest: Manifest) -> bytes:
    """Encode a manifest as indented JSON, in field order, with one trailing newline."""
    try:
        return msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n"
    except UnicodeEncodeError:
        # A file name that is not UTF-8: Python holds its bytes as lone surrogates, which json writes as \udcXX.
        return json.dumps(msgspec.to_builtins(manifest), indent=1).encode() + b"\n"


def _nearest(message: str, types: tuple[type[msgspec.Struct], ...]) -> str:
    """Suggest the known field nearest to the unknown one in a message of msgspec; empty for other messages."""
    unknown = re.search(r"unknown field `([^`]+)`", message)
    if not unknown:
        return ""
    known_fields = {field for struct in types for field in struct.__struct_fields__}
    near = difflib.get_close_matches(unknown[1], known_fields, n=1)
    return f"did you mean {near[0]!r}?" if near else ""


def decode(raw: Any, path: Path) -> Manifest:
    """Check parsed JSON against the format. Raises InputError that names path and the fault."""
    if isinstance(raw, dict) and isinstance(raw.get("format"), int) and raw["format"] > FORMAT:
        raise InputError(path, f"has format {raw['format']}, this gdtool reads up to {FORMAT}", "upgrade gdtool")
    nested: tuple[type[msgspec.Struct], ...] = (Manifest, FileEntry, InputEntry, Skip, RunRecord)
    try:
        manifest = msgspec.convert(raw, Manifest)
        if manifest.kind not in CONTENTS:
            raise InputError(path, f"has unknown kind {manifest.kind!r}", f"known: {', '.join(CONTENTS)}")
        nested = (CONTENTS[manifest.kind],)
        content = msgspec.convert(raw["content"], CONTENTS[manifest.kind])
    except msgspec.ValidationError as error:
        fact = str(error)
        raise InputError(
            path, fact[0].lower() + fact[1:], _nearest(fact, nested) or "see docs/format.md for the fields"
        ) from None
    checked_name(manifest.name, path, "name")
    for relative in (*(entry.path for entry in manifest.files), *_files_named_in(content)):
        relative_parts(relative, path, "file path")
    for view in getattr(content, "views", ()):
        checked_name(view, path, "view")
    for entry in manifest.inputs:
        if not entry.path.startswith("procedural:"):
            relative_parts(entry.path, path, "input path", levels_up=None, byte_escapes=True)
    return msgspec.structs.replace(manifest, content=content)


def _files_named_in(content: Content) -> Iterator[str]:
    """Yield the paths below the folder that its content names besides those of `files`."""
    yield from (entry.path for entry in getattr(content, "objects", ()))
    yield from getattr(content, "maps", {}).values()
    yield from getattr(content, "lods", ())
    yield from filter(None, [getattr(content, "usd", "")])


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a folder. Raises InputError when there is none or it is faulty."""
    path = folder / MANIFEST
    if not path.is_file():
        fact = (
            "has no manifest.json" if folder.is_dir() else ("is not a folder" if folder.exists() else "does not exist")
        )
        raise InputError(
            folder, fact, "name a folder that a gdtool command has written" if folder.exists() else "check the path"
        )
    return decode(read_json(path), path)


def check_files(folder: Path, manifest: Manifest) -> None:
    """Raise InputError when a listed file is missing, leaves the folder by a link, or has another size or hash."""
    for entry in manifest.files:
        path = path_inside(folder, entry.path, folder / MANIFEST, "file")
        if not path.is_file():
            raise InputError(
                path, "is listed in the manifest but missing", f"put it back, or run {_maker(manifest)} again"
            )
        if path.stat().st_size != entry.size or file_sha256(path) != entry.sha256:
            raise InputError(
                path,
                "is not the file that the manifest lists (other size or hash)",
                f"put the file back, or move it away and run {_maker(manifest)} again",
            )


def _maker(manifest: Manifest) -> str:
    """Name the command or program that wrote a folder, for a message."""
    return f"gdtool {manifest.stage}" if manifest.key else "the program that wrote it"


def list_files(folder: Path) -> tuple[FileEntry, ...]:
    """List all files below a folder except the manifest, sorted by path."""
    out = []
    for root, _, names in os.walk(folder):
        for name in names:
            path = Path(root, name)
            relative = path.relative_to(folder).as_posix()
            if relative != MANIFEST:
                out.append(FileEntry(relative, path.stat().st_size, file_sha256(path)))
    return tuple(sorted(out, key=lambda entry: entry.path))


__all__ = ["Content", "FileEntry", "InputEntry", "Manifest", "RunRecord", "Scalar", "Skip"]
