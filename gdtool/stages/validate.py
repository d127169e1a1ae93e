"""Check folders and .glb files against the format; exit 3 with the first faults.

Use it on a folder that another program wrote, or at the end of a pipe. Every file is opened and read as a stage would
read it: the manifest against its schema, the files against the manifest, pixel formats, ranges, indices, units.

Example:
  gdtool validate cat.asset/views cat.asset/asset/asset.glb
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import msgspec

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder, open_folder
from gdtool.core.keys import key_of, names_file
from gdtool.core.manifest import MANIFEST
from gdtool.core.sources import digest

STAGES = (
    "render-dataset",
    "train",
    "sample-views",
    "import-views",
    "reconstruct",
    "remesh",
    "unwrap",
    "bake",
    "relight",
)


def faults(path: Path) -> Iterator[str]:
    """Yield the faults of a folder, a .glb or a .gltf, one line each; none when it is right.

    Raises ResourceError where the check cannot run here: a package or memory is missing.
    """
    if path.suffix.lower() in (".glb", ".gltf"):
        yield from _unreadable_as_fault(lambda: _checks().check_scene(path))
        return
    try:
        folder = open_folder(path)
    except InputError as error:
        yield str(error)
        return
    listed = {entry.path for entry in folder.manifest.files}
    for name in sorted(_checks().required_files(folder) - listed):
        yield f"{folder.file(name)}: {folder.kind} needs it, and the manifest does not list it"
    yield from _check_key(folder)
    yield from _unreadable_as_fault(lambda: _checks().faults_in_files(folder))


def _checks() -> ModuleType:
    """Import the checks of files, which need numpy, only where there is something to check."""
    return importlib.import_module("gdtool.folders.checks")


def _unreadable_as_fault(check: Callable[[], Iterator[str]]) -> Iterator[str]:
    """Yield the faults that a check finds; a file that the check cannot read ends it and is the last fault."""
    try:
        yield from check()
    except InputError as error:
        yield str(error)


def _check_key(folder: Folder) -> Iterator[str]:
    """Compare a folder's key with the one that its stage, version, options and inputs give.

    Three kinds of folder are not checked and pass: a folder without a key, one of a stage of another program, and one
    with an option that names a file which does not exist any more, because the digest of that file is part of the key.
    """
    manifest = folder.manifest
    if not manifest.key or manifest.stage not in STAGES:
        return
    options = dict(manifest.options)
    stage = importlib.import_module("gdtool.stages." + manifest.stage.replace("-", "_")).STAGE
    for name in (field.name for field in msgspec.structs.fields(stage.Options) if names_file(field)):
        value = options.get(name)
        if not isinstance(value, str) or not value.startswith(".."):
            continue  # not given, or one of the stage's built-in names
        path = folder.path.resolve() / value
        if not path.is_file():
            return
        options[name] = digest(path)
    inputs = [(entry.role, entry.digest) for entry in manifest.inputs]
    if key_of(manifest.stage, manifest.stage_version, options, inputs) != manifest.key:
        yield (
            f"{folder.path / MANIFEST}: options and inputs are not those that the key was made of; run gdtool "
            f"{manifest.stage} again"
        )
