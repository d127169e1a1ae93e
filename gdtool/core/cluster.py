"""Run one task for each source on a Ray cluster, as many at a time as the cluster has cores for."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gdtool.core.errors import GdtoolError, ResourceError

# Tasks waiting on top of those that run, so that no core waits for this process; more would only take memory.
AHEAD = 2


def each(address: str, work: Callable[[str], Any], texts: Iterator[str], cores: int) -> Iterator[Any]:
    """Run work(text) for every text on the cluster at address; yields the results in the order in which they are done.

    address: "local" starts Ray on this machine; else the address that `ray start` printed, "auto", or ray://HOST:PORT.
    work: pickled, and run in this process's working folder, which all nodes must share; it has to return its errors,
    not raise them. cores: how many processor cores each task takes. Where a worker process dies (a native crash, no
    memory) the result is a GdtoolError. Raises ResourceError where Ray is not installed or no cluster answers.
    """
    ray = _connected(address)
    try:
        task = ray.remote(num_cpus=cores, max_retries=1)(_work_in_folder)
        folder = str(Path.cwd())
        waiting: dict[Any, str] = {}
        for text in texts:
            waiting[task.remote(folder, work, text)] = text
            full = len(waiting) >= _task_slots(ray, cores)
            while full or _any_done(ray, waiting):
                yield _next(ray, waiting)
                full = len(waiting) >= _task_slots(ray, cores)
        while waiting:
            yield _next(ray, waiting)
    finally:
        # Also when the reader stops early: tasks that nobody waits for end with their driver.
        ray.shutdown()


def _connected(address: str) -> Any:
    """Import Ray and connect it to the cluster. Raises ResourceError."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        import ray
    except ImportError:
        raise ResourceError("--ray", "needs the package ray", "pip install 'gdtool[ray]'") from None
    try:
        _require_listener(address)
        ray.init(
            None if address == "local" else address,
            log_to_driver=False,
            logging_level="ERROR",
            **({"include_dashboard": False} if address == "local" else {}),
        )
    except (RuntimeError, ValueError, OverflowError, OSError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise ResourceError(
            f"--ray {address}",
            f"no cluster answers ({reason[:100]})",
            "start one with `ray start --head`, or use --ray local",
        ) from None
    return ray


def _require_listener(address: str) -> None:
    """Raise OSError where no process listens at HOST:PORT; Ray itself would retry for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()


def _task_slots(ray: Any, cores: int) -> int:
    """Return how many tasks may be submitted at a time.

    These are one for each `cores` cores of the cluster, and two more (AHEAD) that wait. A cluster may grow, so the
    cores are counted at each call.
    """
    return max(int(ray.cluster_resources().get("CPU", 1)) // cores, 1) + AHEAD


def _any_done(ray: Any, waiting: dict[Any, str]) -> bool:
    """Tell, without waiting, whether a task has ended."""
    return bool(waiting) and bool(ray.wait(list(waiting), num_returns=1, timeout=0)[0])


def _next(ray: Any, waiting: dict[Any, str]) -> Any:
    """Wait for a task to end; returns its result, or a GdtoolError where its worker process died."""
    (done,), _ = ray.wait(list(waiting), num_returns=1)
    text = waiting.pop(done)
    try:
        return ray.get(done)
    except ray.exceptions.RayError as error:
        lines = (str(error).strip() or type(error).__name__).splitlines()
        # A traceback says it on its last line, Ray itself on its first.
        reason = lines[-1 if isinstance(error, ray.exceptions.RayTaskError) else 0]
        return GdtoolError(text, f"its worker on the cluster failed ({reason[:120]})", "run it alone to see why")


def _work_in_folder(folder: str, work: Callable[[str], Any], text: str) -> Any:
    """Run work in `folder`, the working folder of the process that submitted the task: relative paths refer to it."""
    from gdtool.core import log

    log.level = log.QUIET
    try:
        os.chdir(folder)
    except OSError:
        return ResourceError(folder, "is not there on a node of the cluster", "work in a folder that all nodes share")
    return work(text)
