"""Run a stage on all of its sources, one after the other or on a cluster; a source that fails stops no other."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any

from gdtool.core import ending, log, sources
from gdtool.core.dataset_index import write_dataset_index
from gdtool.core.errors import GdtoolError, from_exception
from gdtool.core.ownership import refuse_index
from gdtool.core.publish import locked
from gdtool.core.run import Result, Settings, run_one
from gdtool.core.stage import Stage

__all__ = ["Result", "Settings", "run_all", "run_one"]


def _attempt(
    stage: Stage, text: str, *, options: Any, flags: dict[str, str | None], settings: Settings
) -> Result | GdtoolError:
    """Run a stage on one source; returns its result, or the error that stopped it."""
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
    """Run one task for each source on a cluster; a task takes --threads cores, or one."""
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
    """Run a stage on every source as it arrives; yields a result or an error for each."""
    stream = sources.incoming(arguments)
    part, parts = settings.shard
    if parts > 1:
        stream = itertools.islice(stream, part - 1, None, parts)
    if stage.gathers:
        gathered = [sources.resolve(text, stage.reads, stage.name) for text in stream]
        yield run_one(stage, gathered, options, flags, settings)
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
            write_dataset_index(settings.output, [result.path for result in done])
