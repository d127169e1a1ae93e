"""Decide whether a run may replace the folder at the path of its output, which may hold somebody's work.

It may where the folder is empty. It may also where a stage wrote the folder, with the same kind, and every file in it
is listed by its manifest and unchanged. `--force` does not change that.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from gdtool.core.errors import InputError, UsageError
from gdtool.core.manifest import MANIFEST, Manifest, file_sha256, read_manifest
from gdtool.core.names import text_fault

CURE = "name another output with -o"


def output_place(path: Path) -> Path:
    """Return the path of an output with a link at `path` followed.

    A link is followed once, and is not replaced. Raises UsageError for a link to a link, for a name with a line break,
    another control character or NUL, and where something else than a folder lies at the result.
    """
    fault = text_fault(str(path), byte_escapes=True)
    if fault:
        raise UsageError(ascii(str(path)), fault, CURE)
    place = path
    if path.is_symlink():
        place = path.parent / path.readlink()
        if place.is_symlink():
            raise UsageError(path, "is a link to a link", "name the folder itself with -o")
    if place.exists() and not place.is_dir():
        raise UsageError(path, "is a file", CURE)
    return place


def refuse_overlap(place: Path, sources: Iterable[Path]) -> None:
    """Raise UsageError where the output is one of the sources, contains one, or lies inside one.

    The run would delete or change its own input.
    """
    here = place.resolve()
    for source in sources:
        there = source.resolve()
        if here == there:
            raise UsageError(place, "is both source and output", CURE)
        if here in there.parents:
            raise UsageError(place, f"holds the source {source}", CURE)
        if there in here.parents and there.is_dir():
            raise UsageError(place, f"lies inside the source {source}", CURE)


def refuse_loss(place: Path, kind: str) -> None:
    """Raise UsageError, naming the file, where a result of this kind would replace a file of the user's.

    That is a file which gdtool did not write, or which was changed since. Reads every listed file, to compare its
    digest.
    """
    if not os.path.lexists(place):
        return
    present = _files_below(place)
    if not present:
        return
    manifest = _manifest_to_replace(place, present)
    if manifest.kind != kind:
        raise UsageError(place, f"holds {manifest.kind}, not {kind}", CURE)
    if not (manifest.stage and manifest.stage_version and manifest.key):
        raise UsageError(place / MANIFEST, "was not written by a stage of gdtool (no stage, version and key)", CURE)
    listed = {entry.path: entry for entry in manifest.files}
    for relative in present:
        if relative == MANIFEST:
            continue
        path = place / relative
        if relative not in listed:
            raise UsageError(path, "is not a file that gdtool wrote there", f"move it away, or {CURE}")
        if (
            path.is_symlink()
            or path.stat().st_size != listed[relative].size
            or file_sha256(path) != listed[relative].sha256
        ):
            raise UsageError(path, "was changed after gdtool wrote it", f"move it away, or {CURE}")


def refuse_index(root: Path) -> None:
    """Raise UsageError where root has a manifest.json that is not a dataset index written by gdtool."""
    if not (root / MANIFEST).exists():
        return
    manifest = _manifest_to_replace(root, [MANIFEST])
    if manifest.kind != "dataset" or not manifest.tool_version:
        raise UsageError(root / MANIFEST, f"describes {manifest.kind}, not a dataset that gdtool wrote", CURE)


def _manifest_to_replace(place: Path, present: list[str]) -> Manifest:
    """Read the manifest of a folder that a run would replace. Raises UsageError where gdtool wrote none there."""
    if MANIFEST not in present:
        raise UsageError(place / present[0], "would be deleted, and gdtool did not write that folder", CURE)
    try:
        return read_manifest(place)
    except InputError as error:
        raise UsageError(place / MANIFEST, f"is no manifest of gdtool's ({error.fact})", CURE) from None


def _files_below(folder: Path) -> list[str]:
    """List all entries below a folder that are not plain folders: files, links and others; relative and sorted."""
    out = []
    for root, folders, names in os.walk(folder):
        names += [name for name in folders if Path(root, name).is_symlink()]
        out += [Path(root, name).relative_to(folder).as_posix() for name in names]
    return sorted(out)
