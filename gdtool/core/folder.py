"""Folders that stages read: opening and checking."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gdtool.core.errors import InputError
from gdtool.core.kinds import MADE_BY, Content, DatasetContent
from gdtool.core.manifest import MANIFEST, Manifest, check_files, read_manifest
from gdtool.core.names import path_inside

ContentT = TypeVar("ContentT", bound=Content)


@dataclass(frozen=True)
class Folder:
    """A folder with a manifest."""

    path: Path
    manifest: Manifest

    @property
    def kind(self) -> str:
        """The kind of the folder, such as 'views' (a key of kinds.CONTENTS)."""
        return self.manifest.kind

    @property
    def content(self) -> Content:
        """What the manifest says that the folder holds."""
        return self.manifest.content

    def content_as(self, wanted: type[ContentT]) -> ContentT:
        """Return the content as the type of its kind. Raises TypeError for a folder of another kind."""
        if not isinstance(self.manifest.content, wanted):
            raise TypeError(f"{self.path} holds {self.kind}, not {wanted.__name__}")
        return self.manifest.content

    @property
    def name(self) -> str:
        """The object's name."""
        return self.manifest.name

    def file(self, relative: str) -> Path:
        """Path of a file of the folder, which lies below it, links followed. Raises InputError for a name or a link
        that leads elsewhere."""
        return path_inside(self.path, relative, self.path / MANIFEST, "file")


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
        raise InputError(
            path,
            f"holds {manifest.kind}, but {reader or 'this'} reads {' or '.join(kinds)}",
            f"run gdtool {MADE_BY[kinds[0]]} first" if kinds[0] in MADE_BY else f"name a file for {reader}",
        )
    if check:
        check_files(path, manifest)
    return Folder(path, manifest)


def dataset_objects(dataset: Folder) -> Iterator[Folder]:
    """Yield the views folders that a dataset lists, in its order; their files are not checked.

    Raises InputError for one that leaves the dataset, is missing, or is not the one listed (another digest).
    """
    for entry in dataset.content_as(DatasetContent).objects:
        path = path_inside(dataset.path, entry.path, dataset.path / MANIFEST, "object")
        found = open_folder(path, ("views",), "a dataset", check=False)
        if found.manifest.digest != entry.digest:
            raise InputError(
                path,
                "is not the folder that the dataset lists (other digest)",
                f"run gdtool render-dataset into {dataset.path} again",
            )
        yield found
