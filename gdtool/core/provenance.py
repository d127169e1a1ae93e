"""Walk back along what a folder was made from, by path and by digest.

A manifest says where each input lay and what it was. An input that lies there still but is another one by now is told
and refused: what a stage would take from it does not belong to the folder at hand."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gdtool.core import sources
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder, is_folder, open_folder
from gdtool.core.manifest import MANIFEST, InputEntry, read_manifest
from gdtool.core.names import relative_parts


@dataclass(frozen=True)
class Origin:
    """One thing that a folder was made from, as far as it still lies where the manifest says."""

    of: Folder
    entry: InputEntry
    path: Path

    @property
    def is_gone(self) -> bool:
        """Whether nothing lies there any more."""
        return not os.path.lexists(self.path)

    def require_same(self, cure: str) -> None:
        """Raise InputError where what lies there now is not what the folder was made from: another digest."""
        kind = "source"
        if is_folder(self.path):
            found = read_manifest(self.path)
            kind, digest = found.kind, found.digest
        else:
            digest = sources.digest(self.path)
        if digest != self.entry.digest:
            raise InputError(self.path, f"{kind} is not the one that {self.of.kind} {self.of.path} was made from", cure)


def origins(folder: Folder) -> Iterator[Origin]:
    """Yield what a folder was made from, generated objects left out; paths in manifests are relative to where the
    folder really lies."""
    for entry in folder.manifest.inputs:
        if not entry.path.startswith("procedural:"):
            parts = relative_parts(entry.path, folder.path / MANIFEST, "input", levels_up=None, byte_escapes=True)
            yield Origin(folder, entry, Path(os.path.normpath(folder.path.resolve().joinpath(*parts))))


def ancestors(folder: Folder, cure: str) -> Iterator[Folder]:
    """Yield the folders that this one was made from, nearest first, as far as they still lie where the manifests say; a
    model's network is none.

    cure: what to do about a folder that was replaced since, for the message.
    Raises InputError for one that was replaced since.
    """
    queue, seen = [folder], {folder.path.resolve()}
    while queue:
        for origin in origins(queue.pop(0)):
            path = origin.path.resolve()
            if not is_folder(path) or path in seen:
                continue
            seen.add(path)
            if read_manifest(path).kind == "model":  # what it was made with, not what of
                continue
            origin.require_same(cure)
            # Shown as the user would write it, where the chain lies beside the folder that was given.
            found = open_folder(Path(os.path.normpath(origin.of.path / origin.entry.path)), check=False)
            yield found if found.path.resolve() == path else open_folder(path, check=False)
            queue.append(found)


def find_ancestor(folder: Folder, kind: str, cure: str) -> Folder | None:
    """Return the nearest folder of a kind along the provenance chain (the folder itself included), or None. Raises as
    ancestors() does."""
    if folder.kind == kind:
        return folder
    return next((found for found in ancestors(folder, cure) if found.kind == kind), None)


def missing_origin(folder: Folder, cure: str) -> Origin | None:
    """Return the first thing along the provenance chain that lies no more where the manifests say; None where all is
    there.
    Raises as ancestors() does."""
    for one in (folder, *ancestors(folder, cure)):
        for origin in origins(one):
            if origin.is_gone:
                return origin
    return None


def find_source(folder: Folder, cure: str) -> str | None:
    """Return the first input along the chain that is not a folder: a file path, procedural:SEED, or None.

    Raises InputError where the file or a folder on the way was replaced since; cure as for ancestors().
    """
    for one in (folder, *ancestors(folder, cure)):
        for entry in one.manifest.inputs:
            if entry.path.startswith("procedural:"):
                return entry.path
        for origin in origins(one):
            if origin.path.is_file():
                origin.require_same(cure)
                return str(origin.path)
    return None
