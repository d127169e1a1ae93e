"""Limit the memory that the content of one input may take, before it is read.

A small file can stand for a large result: a compressed picture, a mesh that many nodes use, a sparse archive. Readers
predict the bytes that they will hold, copies included, and ask here first.
"""

from __future__ import annotations

import os

from gdtool.core.errors import ResourceError

# The other half is left to the stage, which holds the input and the result at the same time.
SHARE = 0.5


def max_input_bytes() -> int:
    """Return the most bytes that reading one input may take.

    This is the share SHARE (one half) of the machine's memory, or of the limit on the address space (RLIMIT_AS) where
    that is smaller.
    """
    most = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        import resource
    except ImportError:  # Windows
        return int(most * SHARE)
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return int(SHARE * (most if limit == resource.RLIM_INFINITY else min(most, limit)))


def require_memory(size: int, subject: object, what: str, cure: str, most: int | None = None) -> None:
    """Raise ResourceError where the content of an input is predicted to take more memory than one input may.

    size: the predicted bytes. subject: the input. what: the part of the input that takes them, for the message. most: a
    limit in bytes, where it should be smaller than max_input_bytes().
    """
    limit = max_input_bytes() if most is None else min(most, max_input_bytes())
    if size > limit:
        raise ResourceError(
            subject,
            f"{what} would take {size / 2**30:.1f} GiB of memory, more than the {limit / 2**30:.1f} GiB for one input",
            cure,
        )
