"""Open the folders that stages read, and check them against the format."""

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
    """Hold a folder's path and its manifest."""

    path: Path
    manifest: Manifest

    @property
    def kind(self) -> str:
        """The kind of the folder, such as 'views' (a key of kinds.CONTENTS)."""
        return self.manifest.kind

    @property
    def content(self) -> Content:
        """The part of the manifest that describes what the folder holds."""
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
        """Return the path of a file below the folder. Raises InputError for a name or a link that leads elsewhere."""
        return path_inside(self.path, relative, self.path / MANIFEST, "file")


def is_folder(path: Path) -> bool:
    """Tell whether path is a folder with a manifest."""
    return (path / MANIFEST).is_file()


def open_folder(path: Path | str, kinds: tuple[str, ...] = (), reader: str = "", check: bool = True) -> Folder:
    """Open a folder and check its manifest, its kind (one of `kinds`), and its files against the manifest.

    reader: name of the command that reads it, for the message. check=False leaves out the files. Raises InputError.
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

    Raises InputError for a folder that lies outside of the dataset, is missing, or has another digest than the listed
    one.
    """
    for entry in dataset.content_as(DatasetContent).objects:
        path = path_inside(dataset.path, entry.path, dataset.path / MANIFEST, "object")
        views = open_folder(path, ("views",), "a dataset", check=False)
        if views.manifest.digest != entry.digest:
            raise InputError(
                path,
                "is not the folder that the dataset lists (other digest)",
                f"run gdtool render-dataset into {dataset.path} again",
            )
        yield views
