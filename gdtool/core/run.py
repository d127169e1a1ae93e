"""Run a stage on one source: decide where the result goes and whether it is up to date, and publish it at once."""

from __future__ import annotations

import contextlib
import datetime
import functools
import os
import resource
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gdtool import __version__
from gdtool.core import ending, log, sources
from gdtool.core.errors import ResourceError, UsageError, allocation_size, from_os_error
from gdtool.core.folder import Folder, is_folder
from gdtool.core.keys import key_of, option_record, stale_reason
from gdtool.core.manifest import MANIFEST, InputEntry, Manifest, RunRecord, encode, list_files, read_manifest
from gdtool.core.ownership import output_place, refuse_loss, refuse_overlap
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
from gdtool.core.second_inputs import second_inputs
from gdtool.core.sources import Source
from gdtool.core.stage import Inputs, Output, Stage


@dataclass(frozen=True)
class Settings:
    """Hold settings of how to run, which do not change what is made: none of them enters the key."""

    output: Path | None = None
    several: bool = False
    dry_run: bool = False
    force: bool = False
    threads: int = 0
    device: str = "cpu"
    # (i, n): work on the i-th of n parts of the sources, counted from 1.
    shard: tuple[int, int] = (1, 1)
    # Address of a Ray cluster that shares the sources out, for stages that make datasets.
    ray: str | None = None


@dataclass(frozen=True)
class Result:
    """Describe the outcome for one source. path: the finished folder, or the one that would be made."""

    path: Path
    kind: str
    status: Literal["done", "up to date", "would run"]
    seconds: float = 0.0
    skipped: tuple[str, ...] = ()


class ReadInput(NamedTuple):
    """Hold an input of a run: its role in the manifest, the source, and the sha256 of its content."""

    role: str
    source: Source
    digest: str


@dataclass(frozen=True)
class Job:
    """Hold one run of a stage: what it reads, where its result goes, and the key that identifies the result.

    named: the output path as the user names it. target: the path it resolves to, which differs where `named` is a link.
    options: plain values, as the manifest records them. warnings: lines to show before the run.
    """

    stage: Stage
    inputs: Inputs
    read: tuple[ReadInput, ...]
    named: Path
    target: Path
    key: str
    options: dict[str, Any]
    warnings: tuple[str, ...]


def run_one(
    stage: Stage, all_sources: list[Source], options: Any, flags: dict[str, str | None], settings: Settings
) -> Result:
    """Run a stage on one source (or, when it gathers, on all of them) and publish the result.

    flags: the second inputs that the user names.
    """
    named = default_output(stage, all_sources[0], settings.output, settings.several and not stage.gathers)
    target = output_place(named)
    refuse_overlap(target, _paths(all_sources))
    _refuse_other_source(target, stage, all_sources[0], settings.output is not None and not settings.several)
    if settings.dry_run:
        return Result(named, stage.writes, "would run")
    job = _prepare(stage, all_sources, options, flags, named, target)
    start = time.perf_counter()
    with _parents(target), locked(target):
        clear_stale(target)
        digests = [(entry.role, entry.digest) for entry in job.read]
        reason = "asked by --force" if settings.force else stale_reason(target, stage, job.key, job.options, digests)
        if reason is None:
            os.utime(target / MANIFEST)
            log.say(f"{named}: up to date")
            return Result(named, stage.writes, "up to date")
        refuse_loss(target, stage.writes)
        require_replaceable(target)
        log.say(f"{named}: running {stage.name} ({reason})")
        out = _run_and_publish(job, options, settings, start)
    seconds = time.perf_counter() - start
    log.say(f"{named}: done in {seconds:.1f} s" + (f", skipped {len(out.skipped)}" if out.skipped else ""))
    return Result(named, stage.writes, "done", seconds, tuple(f"{s.what}: {s.reason}" for s in out.skipped))


def _prepare(
    stage: Stage, all_sources: list[Source], options: Any, flags: dict[str, str | None], named: Path, target: Path
) -> Job:
    """Find the second inputs, check the options before any work, and compute the key."""
    second = second_inputs(stage, all_sources[0], flags)
    refuse_overlap(target, _paths(second.by_flag.values()))
    inputs = Inputs(all_sources[0], sources.name_of(all_sources[0]), second.by_flag, tuple(all_sources))
    if stage.check is not None:
        stage.check(inputs, options)
    roles: list[tuple[str, Source]] = [("source", source) for source in all_sources]
    roles += [(flag, source) for flag, source in second.by_flag.items() if source is not None]
    read = tuple(ReadInput(role, source, sources.digest(source)) for role, source in roles)
    digests = [(entry.role, entry.digest) for entry in read]
    key = key_of(stage.name, stage.version, option_record(options, None), digests)
    return Job(stage, inputs, read, named, target, key, option_record(options, target), second.warnings)


def _run_and_publish(job: Job, options: Any, settings: Settings, start: float) -> Output:
    """Run the stage into a folder beside the target, and put that in the target's place. The lock must be held.

    What the run wrote is removed where it fails, but a workspace that a later run can go on from is kept.
    """
    stage, target = job.stage, job.target
    partial, workspace = partial_path(target, job.key), workspace_path(target, job.key)
    out = Output(partial, workspace, settings.threads or os.cpu_count() or 1, settings.device)
    with (
        ending.guaranteed_clean_up(functools.partial(_drop_workspace, stage, workspace)),
        ending.guaranteed_clean_up(functools.partial(remove_tree, partial)),
    ):
        for text in job.warnings:
            out.warn(text)
        try:
            partial.mkdir()
            _run_stage(job, options, out)
            (partial / MANIFEST).write_bytes(encode(_manifest(job, out, start)))
            refuse_loss(target, stage.writes)  # again: the run may have taken hours
            publish(partial, target)
            clear_workspaces(target)
        except BaseException as error:
            if _is_resumable(stage, workspace):
                log.say(f"{job.named}: what is done so far is kept in {workspace}; the same command goes on from it")
            if isinstance(error, OSError):
                raise from_os_error(error, target) from error
            raise
    return out


def _run_stage(job: Job, options: Any, out: Output) -> None:
    """Call the stage. Raises ResourceError where it runs out of memory."""
    try:
        job.stage.run(job.inputs, options, out)
    except MemoryError as error:
        raise ResourceError(
            job.inputs.name,
            f"{job.stage.name} ran out of memory{allocation_size(error)}",
            "lower the resolution or free memory",
        ) from None
    if out.content is None:
        raise RuntimeError(f"{job.stage.name} gave no content")


def _manifest(job: Job, out: Output, start: float) -> Manifest:
    """Describe the finished folder."""
    entries = [
        InputEntry(role, sources.relative_to(source.path if isinstance(source, Folder) else source, job.target), digest)
        for role, source, digest in job.read
    ]
    return Manifest(
        kind=job.stage.writes,
        name=job.inputs.name,
        stage=job.stage.name,
        stage_version=job.stage.version,
        tool_version=__version__,
        key=job.key,
        options=job.options,
        inputs=tuple(entries),
        content=out.content,
        skipped=tuple(out.skipped),
        warnings=tuple(out.warnings),
        files=list_files(out.folder),
        run=_record(out, start),
    )


def default_output(stage: Stage, source: Source, output: Path | None, several: bool) -> Path:
    """Return the folder of the result.

    Without -o it lies beside the source folder; for files and datasets it is ./<name>.asset/<kind> in the working
    directory. -o names the folder itself for one source, and the parent of <name>.asset/<kind> for several.
    """
    name = sources.name_of(source)
    if output is not None:
        return output / f"{name}.asset" / stage.writes if several else output
    if isinstance(source, Folder) and source.kind != "dataset":
        return source.path.parent / stage.writes
    return Path(f"{name}.asset") / stage.writes


def _refuse_other_source(target: Path, stage: Stage, source: Source, chosen: bool) -> None:
    """Raise UsageError where the default output folder holds the result of another source."""
    if chosen or stage.gathers or isinstance(source, Folder) or not is_folder(target):
        return
    before = next((entry.path for entry in read_manifest(target).inputs if entry.role == "source"), None)
    here = source if isinstance(source, str) else os.path.realpath(source)
    there = before if before is None or before.startswith("procedural:") else os.path.realpath(target / before)
    if there is not None and there != here:
        raise UsageError(target, f"was made from another source ({before})", "name an output folder with -o")


def _is_resumable(stage: Stage, workspace: Path) -> bool:
    """Tell whether the same run can go on from its workspace."""
    return bool(stage.checkpoint) and (workspace / stage.checkpoint).is_file()


def _drop_workspace(stage: Stage, workspace: Path) -> None:
    """Remove a workspace that no run can go on from."""
    if not _is_resumable(stage, workspace):
        remove_tree(workspace)


def _paths(inputs: Iterable[Source | None]) -> list[Path]:
    """Return the paths of inputs, without those of generated objects."""
    return [
        source.path if isinstance(source, Folder) else source for source in inputs if isinstance(source, (Folder, Path))
    ]


@contextlib.contextmanager
def _parents(target: Path) -> Iterator[None]:
    """Make the folders above target; those that stay empty, because the run failed, are removed again."""
    missing = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)

    def remove_empty() -> None:
        with contextlib.suppress(OSError):
            for folder in missing:
                folder.rmdir()

    with ending.guaranteed_clean_up(remove_empty):
        yield


def _record(out: Output, start: float) -> RunRecord:
    """Record the seconds of each step, the memory and the time of day."""
    finished = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    seconds = {name: round(value, 4) for name, value in out.seconds.items()}
    return RunRecord(seconds, round(time.perf_counter() - start, 4), round(_peak_memory_mb(), 1), finished)


def _peak_memory_mb() -> float:
    """Return the largest resident set of this process or of one of its children, in MB."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    try:
        # Not RUSAGE_SELF: it also counts the memory of the process that started gdtool by exec.
        status = Path("/proc/self/status").read_text()
        largest = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return max(largest, children)
