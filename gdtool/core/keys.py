"""Compute the key that identifies a result, and tell why a folder is not the result of a key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from gdtool.core import sources
from gdtool.core.errors import InputError
from gdtool.core.folder import is_folder
from gdtool.core.manifest import check_files, digest_of, read_manifest
from gdtool.core.stage import Stage


def option_record(options: Any, folder: Path | None) -> dict[str, Any]:
    """Convert options to plain values: a file is recorded by its digest (for the key) or its path (for the manifest).

    folder: the folder that paths are written relative to; None to record digests.
    """
    record = msgspec.to_builtins(options)
    for field in msgspec.structs.fields(options):
        value = record.get(field.name)
        if names_file(field) and isinstance(value, str) and Path(value).is_file():
            record[field.name] = (
                sources.digest(Path(value)) if folder is None else sources.relative_to(Path(value), folder)
            )
    return record


def names_file(field: Any) -> bool:
    """Tell whether a field of a stage's Options names a file."""
    extra = getattr(getattr(field.type, "__metadata__", (None,))[0], "extra", None) or {}
    return bool(extra.get("file"))


def key_of(stage: str, version: int, options: dict[str, Any], inputs: list[tuple[str, str]]) -> str:
    """Compute the sha256 of a stage's name, version and options (files by digest), and of its inputs (role, digest).

    Two runs with the same key have the same result.
    """
    return digest_of([stage, version, options, inputs])


def stale_reason(
    target: Path, stage: Stage, key: str, options: dict[str, Any], inputs: list[tuple[str, str]]
) -> str | None:
    """Say why the folder at target is not the result of this key; None when it is. The cheapest check comes first."""
    if not is_folder(target):
        return "not made yet"
    try:
        old = read_manifest(target)
        if old.key != key:
            if old.stage != stage.name:
                return f"made by {old.stage}"
            if old.stage_version != stage.version:
                return f"{stage.name} changed (version {old.stage_version} → {stage.version})"
            for name, value in options.items():
                if old.options.get(name) != value:
                    return f"{name} {old.options.get(name)} → {value}"
            before = {entry.role: entry.digest for entry in old.inputs}
            for role, digest in inputs:
                if before.get(role) != digest:
                    return f"{role} changed"
            return "a file that an option names changed"
        check_files(target, old)
    except InputError as error:
        return f"damaged: {error}"
    return None
