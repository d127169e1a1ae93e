"""Run a stage on its sources: where the result goes, whether it is up to date, one atomic publication each."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import itertools
import os
import resource
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

import gdtool
from gdtool import __version__
from gdtool.core import ending, log, sources
from gdtool.core.errors import (
    GdtoolError,
    InputError,
    ResourceError,
    UsageError,
    asked_for,
    from_exception,
    from_os_error,
)
from gdtool.core.folder import Folder, is_folder, open_folder
from gdtool.core.manifest import (
    MANIFEST,
    InputEntry,
    Manifest,
    RunRecord,
    check_files,
    digest_of,
    encode,
    list_files,
    read_manifest,
)
from gdtool.core.ownership import output_place, refuse_index, refuse_loss, refuse_overlap
from gdtool.core.provenance import find_ancestor, missing_origin
from gdtool.core.publish import (
    clear_stale,
    clear_workspaces,
    locked,
    partial_path,
    publish,
    remove_tree,
    require_replaceable,
    workspace_path,
)
from gdtool.core.sources import Source
from gdtool.core.stage import Inputs, Output, Stage


@dataclass(frozen=True)
class Settings:
    """How to run, as against what to make: none of it enters the key."""

    output: Path | None = None
    several: bool = False
    dry_run: bool = False
    force: bool = False
    threads: int = 0
    device: str = "cpu"
    # Which part of the sources, counted from 1, and of how many.
    shard: tuple[int, int] = (1, 1)
    # A Ray cluster to fan out on, for stages that make datasets.
    ray: str | None = None


@dataclass(frozen=True)
class Result:
    """What became of one source. path is the finished folder, or the one that would be made."""

    path: Path
    kind: str
    status: Literal["done", "up to date", "would run"]
    seconds: float = 0.0
    skipped: tuple[str, ...] = ()


def default_output(stage: Stage, source: Source, output: Path | None, several: bool) -> Path:
    """Where the result goes.

    Without -o: beside the source folder, for files and datasets in ./<name>.asset of the working directory.
    -o names the folder itself for one source, and the parent of <name>.asset/<kind> for several.
    """
    name = sources.name_of(source)
    if output is not None:
        return output / f"{name}.asset" / stage.writes if several else output
    if isinstance(source, Folder) and source.kind != "dataset":
        return source.path.parent / stage.writes
    return Path(f"{name}.asset") / stage.writes


@dataclass(frozen=True)
class SecondInputs:
    """The stage's other inputs by flag, None where there is none, and what to warn of."""

    found: dict[str, Folder | Path | None]
    warnings: tuple[str, ...] = ()


def second_inputs(stage: Stage, source: Source, given: dict[str, str | None]) -> SecondInputs:
    """Return the stage's other inputs: what the flags name, else what lies along the provenance chain.

    Raises InputError where a folder on the way there was replaced since, UsageError where a required one is not there.
    """
    out: dict[str, Folder | Path | None] = {}
    warnings = []
    for flag in stage.second_inputs:
        wanted = stage.second(flag)
        gone = None
        if named := given.get(flag):
            kinds = (wanted.kind, sources.PICTURES) if wanted.foreign else (wanted.kind,)
            place = sources.hub_folder(named) if wanted.foreign else named
            opened = sources.resolve(place, kinds, f"--{flag} of {stage.name}")
            assert not isinstance(opened, str)  # second inputs are folders or files
            out[flag] = opened
        elif wanted.search and isinstance(source, Folder):
            cure = f"run the stages after it again, or name it with --{flag}"
            found = find_ancestor(source, wanted.kind, cure)
            out[flag] = open_folder(found.path) if found else None
            gone = None if found else missing_origin(source, cure)
        elif wanted.default:
            out[flag] = open_folder(Path(gdtool.__file__).parent / wanted.default, (wanted.kind,), stage.name)
        else:
            out[flag] = None
        moved = f"{gone.path}, which {gone.of.kind} {gone.of.path} was made from, is gone" if gone else ""
        if out[flag] is None and wanted.required:
            raise UsageError(
                sources.name_of(source),
                moved or f"has no {wanted.kind} along its provenance chain",
                f"name one with --{flag}",
            )
        if moved:
            warnings.append(f"no {wanted.kind} found: {moved}; name one with --{flag} where there is one")
    return SecondInputs(out, tuple(warnings))


def option_record(options: Any, folder: Path | None) -> dict[str, Any]:
    """Options as plain values; files by digest (folder None, for the key) or by path relative to folder."""
    record = msgspec.to_builtins(options)
    for field in msgspec.structs.fields(options):
        value = record.get(field.name)
        if names_file(field) and isinstance(value, str) and Path(value).is_file():
            record[field.name] = (
                sources.digest(Path(value)) if folder is None else sources.relative_to(Path(value), folder)
            )
    return record


def names_file(field: Any) -> bool:
    """Whether a field of a stage's Options names a file."""
    extra = getattr(getattr(field.type, "__metadata__", (None,))[0], "extra", None) or {}
    return bool(extra.get("file"))


def key_of(stage: str, version: int, options: dict[str, Any], inputs: list[tuple[str, str]]) -> str:
    """Return what tells one result of a stage from another: sha256 of its name, version, options (files by digest), and
    (role, digest) of its inputs."""
    return digest_of([stage, version, options, inputs])


def stale_reason(
    target: Path, stage: Stage, key: str, options: dict[str, Any], inputs: list[tuple[str, str]]
) -> str | None:
    """Why the folder at target is not the result of this key, cheapest check first; None when it is."""
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


def _refuse_other_source(target: Path, stage: Stage, source: Source, chosen: bool) -> None:
    """Raise UsageError where the default output folder holds the result of another source."""
    if chosen or stage.gathers or isinstance(source, Folder) or not is_folder(target):
        return
    before = next((entry.path for entry in read_manifest(target).inputs if entry.role == "source"), None)
    here = source if isinstance(source, str) else os.path.realpath(source)
    there = before if before is None or before.startswith("procedural:") else os.path.realpath(target / before)
    if there is not None and there != here:
        raise UsageError(target, f"was made from another source ({before})", "name an output folder with -o")


def run_one(
    stage: Stage, given: list[Source], options: Any, flags: dict[str, str | None], settings: Settings
) -> Result:
    """Run a stage on one source (or, when it gathers, on all of them) and publish the result."""
    source = given[0]
    named = default_output(stage, source, settings.output, settings.several and not stage.gathers)
    target = output_place(named)
    refuse_overlap(target, _places(given))
    _refuse_other_source(target, stage, source, settings.output is not None and not settings.several)
    if settings.dry_run:
        return Result(named, stage.writes, "would run")
    second = second_inputs(stage, source, flags)
    refuse_overlap(target, _places(second.found.values()))
    inputs = Inputs(source, sources.name_of(source), second.found, tuple(given))
    if stage.check is not None:
        stage.check(inputs, options)
    roles = [("source", one) for one in given] + [(flag, one) for flag, one in second.found.items() if one is not None]
    digests = [(role, sources.digest(one)) for role, one in roles]
    keyed = option_record(options, None)
    key = key_of(stage.name, stage.version, keyed, digests)
    recorded = option_record(options, target)
    start = time.perf_counter()
    with _parents(target), locked(target), contextlib.ExitStack() as at_end:
        clear_stale(target)
        reason = "asked by --force" if settings.force else stale_reason(target, stage, key, recorded, digests)
        if reason is None:
            os.utime(target / MANIFEST)
            log.say(f"{named}: up to date")
            return Result(named, stage.writes, "up to date")
        refuse_loss(target, stage.writes)
        require_replaceable(target)
        log.say(f"{named}: running {stage.name} ({reason})")
        partial = partial_path(target, key)
        out = Output(partial, workspace_path(target, key), settings.threads or os.cpu_count() or 1, settings.device)
        at_end.enter_context(ending.certainly(functools.partial(_drop_workspace, stage, out.place_of_workspace)))
        at_end.enter_context(ending.certainly(functools.partial(remove_tree, partial)))
        for text in second.warnings:
            out.warn(text)
        try:
            partial.mkdir()
            try:
                stage.run(inputs, options, out)
            except MemoryError as error:
                raise ResourceError(
                    inputs.name,
                    f"{stage.name} ran out of memory{asked_for(error)}",
                    "lower the resolution or free memory",
                ) from None
            if out.content is None:
                raise RuntimeError(f"{stage.name} gave no content")
            entries = [
                InputEntry(role, sources.relative_to(one.path if isinstance(one, Folder) else one, target), digest)
                for (role, one), (_, digest) in zip(roles, digests, strict=True)
            ]
            manifest = Manifest(
                kind=stage.writes,
                name=inputs.name,
                stage=stage.name,
                stage_version=stage.version,
                tool_version=__version__,
                key=key,
                options=recorded,
                inputs=tuple(entries),
                content=out.content,
                skipped=tuple(out.skipped),
                warnings=tuple(out.warnings),
                files=list_files(partial),
                run=_record(out, start),
            )
            (partial / MANIFEST).write_bytes(encode(manifest))
            refuse_loss(target, stage.writes)  # again: the run may have taken hours
            publish(partial, target)
            clear_workspaces(target)
        except BaseException as error:
            if _is_resumable(stage, out.place_of_workspace):
                log.say(
                    f"{named}: what is done so far is kept in {out.place_of_workspace}; the same command goes on "
                    f"from it"
                )
            if isinstance(error, OSError):
                raise from_os_error(error, target) from error
            raise
    seconds = time.perf_counter() - start
    log.say(f"{named}: done in {seconds:.1f} s" + (f", skipped {len(out.skipped)}" if out.skipped else ""))
    return Result(named, stage.writes, "done", seconds, tuple(f"{s.what}: {s.reason}" for s in out.skipped))


def _is_resumable(stage: Stage, workspace: Path) -> bool:
    """Whether the same run can go on from what is in its workspace."""
    return bool(stage.checkpoint) and (workspace / stage.checkpoint).is_file()


def _drop_workspace(stage: Stage, workspace: Path) -> None:
    """Remove a workspace that no run can go on from."""
    if not _is_resumable(stage, workspace):
        remove_tree(workspace)


def _places(inputs: Iterable[Source | None]) -> list[Path]:
    """Where inputs lie, generated objects left out."""
    return [one.path if isinstance(one, Folder) else one for one in inputs if isinstance(one, (Folder, Path))]


@contextlib.contextmanager
def _parents(target: Path) -> Iterator[None]:
    """Make the folders above target; what stays empty, because the run failed, goes again."""
    made = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)

    def remove_empty() -> None:
        with contextlib.suppress(OSError):
            for folder in made:
                folder.rmdir()

    with ending.certainly(remove_empty):
        yield


def _record(out: Output, start: float) -> RunRecord:
    finished = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    seconds = {name: round(value, 4) for name, value in out.seconds.items()}
    return RunRecord(seconds, round(time.perf_counter() - start, 4), round(_peak_memory_mb(), 1), finished)


def _peak_memory_mb() -> float:
    """Largest resident set of this process or of one of its children."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    try:
        # Not RUSAGE_SELF: that counts what the process was before it became gdtool, a large parent say.
        status = Path("/proc/self/status").read_text()
        own = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return max(own, children)


def write_dataset_index(root: Path, results: list[Result]) -> Path:
    """Write or extend the dataset manifest at root over the views folders made below it."""
    from gdtool.core.kinds import DatasetContent, DatasetObject

    refuse_index(root)
    objects: dict[str, str] = {}
    if is_folder(root):
        old = read_manifest(root)
        objects = {one.path: one.digest for one in old.content.objects if is_folder(root / one.path)}
    for result in results:
        objects[result.path.relative_to(root).as_posix()] = read_manifest(result.path).digest
    content = DatasetContent(objects=tuple(DatasetObject(path, objects[path]) for path in sorted(objects)))
    manifest = Manifest(
        kind="dataset",
        name=root.absolute().name,
        stage="render-dataset",
        tool_version=__version__,
        content=content,
        files=(),
    )
    temporary = root / f".{MANIFEST}.partial"
    temporary.write_bytes(encode(manifest))
    temporary.replace(root / MANIFEST)
    return root


def _attempt(
    stage: Stage, text: str, *, options: Any, flags: dict[str, str | None], settings: Settings
) -> Result | GdtoolError:
    """Return the result of one source, or what was wrong with it."""
    try:
        source = sources.resolve(text, stage.reads, stage.name, allow_missing=settings.dry_run)
        return run_one(stage, [source], options, flags, settings)
    except Exception as error:  # the other sources go on
        if ending.received is not None:
            raise
        problem = from_exception(error, text)
        if problem is not error:
            problem.__cause__ = error
        return problem


def _on_cluster(work: functools.partial, stream: Iterator[str], settings: Settings) -> Iterator[Result | GdtoolError]:
    """One source a task; a task takes the cores that --threads says, one without it."""
    from gdtool.core import cluster

    threads, address = settings.threads or 1, settings.ray
    assert address is not None
    work.keywords["settings"] = dataclasses.replace(settings, threads=threads, ray=None)
    for result in cluster.each(address, work, stream, threads):
        if isinstance(result, Result):
            log.say(
                f"{result.path}: {result.status}" + (f" in {result.seconds:.1f} s" if result.status == "done" else "")
            )
        yield result


def run_all(
    stage: Stage, arguments: tuple[str, ...], options: Any, flags: dict[str, str | None], settings: Settings
) -> Iterator[Result | GdtoolError]:
    """Run a stage on every source, as they arrive; a source that fails yields its error and the rest go on."""
    stream = sources.incoming(arguments)
    part, parts = settings.shard
    if parts > 1:
        stream = itertools.islice(stream, part - 1, None, parts)
    if stage.gathers:
        given = [sources.resolve(text, stage.reads, stage.name) for text in stream]
        yield run_one(stage, given, options, flags, settings)
        return
    several = settings.several
    if settings.output is not None and not several:
        # -o means the folder itself for one source and a parent for several: look one source ahead.
        first = list(itertools.islice(stream, 2))
        several = len(first) > 1
        stream = itertools.chain(first, stream)
    settings = dataclasses.replace(settings, several=several)
    if stage.dataset and several and settings.output is not None:
        refuse_index(settings.output)
    work = functools.partial(_attempt, stage, options=options, flags=flags, settings=settings)
    done: list[Result] = []
    for result in _on_cluster(work, stream, settings) if settings.ray else map(work, stream):
        if isinstance(result, Result):
            done.append(result)
        yield result
    if stage.dataset and several and settings.output is not None and done and not settings.dry_run:
        # Shards share the index. A cluster's results come in any order.
        with locked(settings.output):
            write_dataset_index(settings.output, done)
