"""What simplify's child runs, with all that it needs, which is read before it is forked."""

from __future__ import annotations

import scipy.sparse.csgraph
import scipy.spatial

from gdtool.geometry.simplify import reduced

__all__ = ["reduced", "scipy"]
