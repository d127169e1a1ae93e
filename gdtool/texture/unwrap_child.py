"""What unwrap's children run, with all that it needs, which is read before they are forked, while others work."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read as NumPy is imported: several children share the cores

import scipy.sparse.csgraph
import scipy.spatial

from gdtool.core.native import imported
from gdtool.texture.unwrap_lay import flatten_all, lay_next

igl = imported("igl")  # read before the fork

__all__ = ["flatten_all", "igl", "lay_next", "scipy"]
