"""Open the views folders among a training's sources: folders, datasets and archives."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from pathlib import Path

from gdtool.core.folder import Folder, dataset_objects
from gdtool.diffusion.data.archives import object_count, unpack_views


def views_folders(sources: Iterable[Folder | Path], workspace: Path) -> Iterator[Folder]:
    """Yield the views folders of folders, datasets and archives. Those of an archive are unpacked under workspace."""
    parts: list[Iterable[Folder]] = []
    for source in sources:
        if isinstance(source, Path):
            parts.append(unpack_views(source, workspace))
        else:
            parts.append([source] if source.kind == "views" else dataset_objects(source))
    return itertools.chain.from_iterable(parts)


def count_views_folders(sources: Iterable[Folder | Path]) -> int:
    """Count the folders that views_folders() yields, by manifests and by the headers of archives."""
    return sum(_count(source) for source in sources)


def _count(source: Folder | Path) -> int:
    """Count the views folders of one source."""
    if isinstance(source, Path):
        return object_count(source)
    return 1 if source.kind == "views" else len(source.content.objects)
