"""Declare what a stage is: a function from folders to a folder, with its options, inputs and output."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from gdtool.core import log
from gdtool.core.folder import Folder
from gdtool.core.kinds import Content
from gdtool.core.manifest import Skip
from gdtool.core.sources import Source

# Upper bounds of numeric options: more than anybody needs, but finite and within the range of a manifest's numbers.
MOST_SEED = 2**63 - 1  # a 64-bit integer
MOST_SECONDS = 7 * 86400.0  # a week
LEAST_EXPOSURE, MOST_EXPOSURE = 1e-4, 1e4  # factors on radiance, 13 stops either way

# Marks an option that names a file (msgspec.Meta's extra), or one of the stage's built-in names. The file's content
# enters the key, its path relative to the output the manifest.
FILE = {"file": True}


@dataclass(frozen=True)
class SecondInput:
    """Declare an input beside the source, which the user names by a flag.

    search: without the flag it is looked for along the provenance chain. default: the folder to take where neither
    gives one, as "package/folder" of what ships with gdtool. foreign: a folder of another program, or an id of the
    Hugging Face hub, is accepted too, and is passed as a Path.
    """

    kind: str
    required: bool = False
    search: bool = True
    help: str = ""
    default: str = ""
    foreign: bool = False


@dataclass(frozen=True)
class Inputs:
    """Hold what a run reads. second has an entry for each second input, None where there is none."""

    main: Source
    name: str
    second: dict[str, Folder | Path | None] = field(default_factory=dict)
    all: tuple[Source, ...] = ()

    @property
    def folder(self) -> Folder:
        """The source of a stage that reads folders only. Raises TypeError for a file or a generated object."""
        if not isinstance(self.main, Folder):
            raise TypeError(f"{self.main} is not a folder")
        return self.main

    @property
    def path(self) -> Path:
        """The source of a stage that reads files, or folders of other programs. Raises TypeError for any other."""
        if not isinstance(self.main, Path):
            raise TypeError(f"{self.main} is not a path")
        return self.main

    @property
    def on_disk(self) -> tuple[Folder | Path, ...]:
        """All sources that are folders or files, without generated objects."""
        return tuple(source for source in self.all if not isinstance(source, str))

    def second_folder(self, flag: str) -> Folder | None:
        """Return a second input as a folder that gdtool wrote, or None. Raises TypeError for a folder of another
        program.
        """
        folder = self.second.get(flag)
        if isinstance(folder, Path):
            raise TypeError(f"{folder} is not a folder with a manifest")
        return folder

    def second_path(self, flag: str) -> Path | None:
        """Return the path of a second input, whichever program wrote it; None where there is none."""
        source = self.second.get(flag)
        return source.path if isinstance(source, Folder) else source


@dataclass(frozen=True)
class Stage:
    """Declare a stage; its command line, its manifest and its schema are derived from this.

    reads: the kinds of folder that it reads, and "image-file", "model-file", "mesh-file" for files. version: raised
    when results change. gathers: all sources go into one run (train). dataset: the results of several sources lie below
    one root, with an index. check(inputs, options): called before any work. It is quick, and raises a GdtoolError for
    what the run would notice only later: a file that an option names is missing, or a package. checkpoint: the file of
    the workspace that a later run can resume from; without it a failed run leaves no workspace. networks: the stage
    runs neural networks, so its command has --device.
    """

    name: str
    version: int
    reads: tuple[str, ...]
    writes: str
    Options: type[msgspec.Struct]
    run: Callable[[Inputs, Any, Output], None]
    second_inputs: dict[str, SecondInput | str] = field(default_factory=dict)
    gathers: bool = False
    dataset: bool = False
    check: Callable[[Inputs, Any], None] | None = None
    checkpoint: str = ""
    networks: bool = False

    def second(self, flag: str) -> SecondInput:
        """Return the declaration of a second input."""
        declared = self.second_inputs[flag]
        return SecondInput(declared) if isinstance(declared, str) else declared


class Output:
    """Hold the unpublished folder that a run writes, and the record of the run."""

    def __init__(self, folder: Path, workspace: Path, threads: int, device: str):
        self.folder, self.place_of_workspace = folder, workspace
        self.threads, self.device = threads, device
        self.content: Content | None = None
        self.seconds: dict[str, float] = {}
        self.skipped: list[Skip] = []
        self.warnings: list[str] = []

    def path(self, relative: str) -> Path:
        """Return where to write a file of the result, and make the folders above it."""
        path = self.folder / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    @property
    def workspace(self) -> Path:
        """Folder that survives a kill and is removed when the result is published: for checkpoints and caches."""
        self.place_of_workspace.mkdir(parents=True, exist_ok=True)
        return self.place_of_workspace

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Measure the seconds of a block for the manifest; blocks of the same name are added up."""
        log.say(f"  {name}", at=log.VERBOSE)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def skip(self, what: str, reason: str, saved_seconds: float | None = None) -> None:
        """Record work that the scene or the options did not need."""
        self.skipped.append(Skip(what, reason, saved_seconds))
        log.say(f"  skipped {what}: {reason}", at=log.VERBOSE)

    def warn(self, text: str) -> None:
        """Record a warning and show it."""
        self.warnings.append(text)
        log.say(f"warning: {text}")

    def progress(self, iterable: Iterable, total: int | None = None, label: str = "") -> Iterator:
        """Iterate with a bar on stderr when it is a terminal."""
        return log.progress(iterable, total, label)
