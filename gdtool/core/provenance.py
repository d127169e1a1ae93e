"""Walk from a folder to the folders and files that it was made from.

A manifest lists the path and the digest of each input. An input that has another digest by now raises an error: it does
not belong to the folder any more.
"""

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
    """Hold an input that a folder was made from: the folder `of`, the entry of its manifest, and the input's absolute
    path.
    """

    of: Folder
    entry: InputEntry
    path: Path

    @property
    def is_gone(self) -> bool:
        """True where nothing lies at the path any more."""
        return not os.path.lexists(self.path)

    def require_same(self, cure: str) -> None:
        """Raise InputError where the input has another digest than the manifest lists."""
        kind = "source"
        if is_folder(self.path):
            manifest = read_manifest(self.path)
            kind, digest = manifest.kind, manifest.digest
        else:
            digest = sources.digest(self.path)
        if digest != self.entry.digest:
            raise InputError(self.path, f"{kind} is not the one that {self.of.kind} {self.of.path} was made from", cure)


def origins(folder: Folder) -> Iterator[Origin]:
    """Yield the inputs that a folder's manifest lists, without generated objects.

    Paths in manifests are relative to the folder with its links resolved.
    """
    for entry in folder.manifest.inputs:
        if not entry.path.startswith("procedural:"):
            parts = relative_parts(entry.path, folder.path / MANIFEST, "input", levels_up=None, byte_escapes=True)
            yield Origin(folder, entry, Path(os.path.normpath(folder.path.resolve().joinpath(*parts))))


def ancestors(folder: Folder, cure: str) -> Iterator[Folder]:
    """Yield the folders that a folder was made from, nearest first, as far as they still exist.

    The folder of a model (a network) is not part of the chain. cure: what to do about a folder that was replaced since,
    for the message. Raises InputError for such a folder.
    """
    queue, seen = [folder], {folder.path.resolve()}
    while queue:
        for origin in origins(queue.pop(0)):
            path = origin.path.resolve()
            if not is_folder(path) or path in seen:
                continue
            seen.add(path)
            if read_manifest(path).kind == "model":  # it was made with the model, not from it
                continue
            origin.require_same(cure)
            # The path as the user would write it, where the chain lies beside the folder that the user named.
            nearby = open_folder(Path(os.path.normpath(origin.of.path / origin.entry.path)), check=False)
            yield nearby if nearby.path.resolve() == path else open_folder(path, check=False)
            queue.append(nearby)


def find_ancestor(folder: Folder, kind: str, cure: str) -> Folder | None:
    """Return the nearest folder of a kind along the provenance chain, which starts with the folder itself; None
    without.

    Raises as ancestors() does.
    """
    if folder.kind == kind:
        return folder
    return next((ancestor for ancestor in ancestors(folder, cure) if ancestor.kind == kind), None)


def missing_origin(folder: Folder, cure: str) -> Origin | None:
    """Return the first input along the provenance chain that does not exist any more; None where all exist.

    Raises as ancestors() does.
    """
    for member in (folder, *ancestors(folder, cure)):
        for origin in origins(member):
            if origin.is_gone:
                return origin
    return None


def find_source(folder: Folder, cure: str) -> str | None:
    """Return the first input along the provenance chain that is not a folder: a file path or procedural:SEED; None
    without.

    cure: what to do about an input that was replaced since, for the message. Raises InputError where the file, or a
    folder on the way to it, has another digest than the manifest lists.
    """
    for member in (folder, *ancestors(folder, cure)):
        for entry in member.manifest.inputs:
            if entry.path.startswith("procedural:"):
                return entry.path
        for origin in origins(member):
            if origin.path.is_file():
                origin.require_same(cure)
                return str(origin.path)
    return None
