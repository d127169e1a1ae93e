"""Write the index of a dataset: the manifest at its root that lists the views folders below."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gdtool import __version__
from gdtool.core.folder import is_folder
from gdtool.core.kinds import DatasetContent, DatasetObject
from gdtool.core.manifest import MANIFEST, Manifest, encode, read_manifest
from gdtool.core.ownership import refuse_index


def write_dataset_index(root: Path, folders: Iterable[Path]) -> Path:
    """Write the dataset manifest at root: it lists `folders`, and the folders of an earlier index that still exist.

    folders: views folders below root. Raises UsageError where root has a manifest.json that is not a dataset index
    written by gdtool.
    """
    refuse_index(root)
    digests: dict[str, str] = {}
    if is_folder(root):
        earlier = read_manifest(root).content.objects
        digests = {entry.path: entry.digest for entry in earlier if is_folder(root / entry.path)}
    for folder in folders:
        digests[folder.relative_to(root).as_posix()] = read_manifest(folder).digest
    manifest = Manifest(
        kind="dataset",
        name=root.absolute().name,
        stage="render-dataset",
        tool_version=__version__,
        content=DatasetContent(objects=tuple(DatasetObject(path, digests[path]) for path in sorted(digests))),
        files=(),
    )
    temporary = root / f".{MANIFEST}.partial"
    temporary.write_bytes(encode(manifest))
    temporary.replace(root / MANIFEST)
    return root
