"""Folders that stages read: opening, checking, and walking back along what they were made from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gdtool.core.errors import InputError
from gdtool.core.kinds import MADE_BY, Content
from gdtool.core.manifest import MANIFEST, Manifest, check_files, read_manifest


@dataclass(frozen=True)
class Folder:
    """A folder with a manifest."""

    path: Path
    manifest: Manifest

    @property
    def kind(self) -> str:
        return self.manifest.kind

    @property
    def content(self) -> Content:
        return self.manifest.content

    @property
    def name(self) -> str:
        """The object's name."""
        return self.manifest.name

    def file(self, relative: str) -> Path:
        """Path of a file of the folder."""
        return self.path / relative


def is_folder(path: Path) -> bool:
    """Whether path is a folder with a manifest."""
    return (path / MANIFEST).is_file()


def open_folder(path: Path | str, kinds: tuple[str, ...] = (), reader: str = "", check: bool = True) -> Folder:
    """Open a folder and check it against the format, its kind against kinds, its files against the manifest.

    reader is the command that reads it, for the message. Raises InputError.
    """
    path = Path(path)
    if path.name == MANIFEST and path.is_file():
        path = path.parent
    manifest = read_manifest(path)
    if kinds and manifest.kind not in kinds:
        raise InputError(path, f"holds {manifest.kind}, but {reader or 'this'} reads {' or '.join(kinds)}",
                         f"run gdtool {MADE_BY[kinds[0]]} first")
    if check:
        check_files(path, manifest)
    return Folder(path, manifest)


def ancestors(folder: Folder) -> Iterator[Folder]:
    """The folders that this one was made from, nearest first, as far as they still lie where the manifests say."""
    queue, seen = [folder], {folder.path.resolve()}
    while queue:
        current = queue.pop(0)
        for entry in current.manifest.inputs:
            path = Path(current.path, entry.path)
            if not is_folder(path) or path.resolve() in seen:
                continue
            seen.add(path.resolve())
            found = open_folder(path, check=False)
            yield found
            queue.append(found)


def find_ancestor(folder: Folder, kind: str) -> Folder | None:
    """The nearest folder of a kind along the provenance chain (the folder itself included), or None."""
    if folder.kind == kind:
        return folder
    return next((f for f in ancestors(folder) if f.kind == kind), None)


def find_source(folder: Folder) -> str | None:
    """The first input along the chain that is not a folder: a file path, procedural:SEED, or None."""
    for one in (folder, *ancestors(folder)):
        for entry in one.manifest.inputs:
            if entry.path.startswith("procedural:"):
                return entry.path
            path = Path(one.path, entry.path)
            if path.is_file():
                return str(path)
    return None
