"""Run the toy stage with another function: `python -m tests.faults.toy_runs FUNCTION ARGUMENTS`."""

import ctypes
import dataclasses
import sys
import time

from gdtool.core import ending
from gdtool.core.errors import ResourceError
from tests.core import toy


def busy(inputs, options, out):
    """Compute without end."""
    out.path("half.png").write_bytes(b"half")
    while True:
        pass


def native(inputs, options, out):
    """Wait without end in a native call that no signal interrupts, after writing half a result and a workspace."""
    out.path("half.png").write_bytes(b"half")
    (out.workspace / "cache").write_bytes(b"cache")
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)  # all zeros: an open mutex
    for _ in range(2):
        libc.pthread_mutex_lock(mutex)  # the second waits for the first


def late(inputs, options, out):
    """Run native() under a time limit."""
    with ending.time_limit(0.3, ResourceError(inputs.name, "is not done after 0.3 s", "raise --seconds to 1")):
        native(inputs, options, out)


def pooled(inputs, options, out):
    """Wait without end for a thread of a pool."""
    from concurrent.futures import ThreadPoolExecutor

    out.path("half.png").write_bytes(b"half")
    with ThreadPoolExecutor(1) as pool:
        pool.submit(time.sleep, 1000).result()


def resumable(inputs, options, out):
    """Resume from a checkpoint; without one, write it and fail."""
    checkpoint = out.workspace / "checkpoint"
    if not checkpoint.exists():
        checkpoint.write_bytes(b"half")
        raise ValueError("after the checkpoint")
    toy.run(inputs, options, out)


def lost(inputs, options, out):
    """Fail before there is a checkpoint."""
    (out.workspace / "decoded").write_bytes(b"cache")
    raise ValueError("before the checkpoint")


def stage(name):
    """Make the toy stage that runs the function of a name."""
    return dataclasses.replace(toy.STAGE, run=globals()[name], checkpoint="checkpoint")


if __name__ == "__main__":
    from gdtool.commands import main
    from gdtool.commands._stage_command import stage_command

    name = sys.argv.pop(1)
    main(lambda: stage_command(stage(name), "Toy."))
