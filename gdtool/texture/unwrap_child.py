"""What unwrap's children run: they import all that it needs before they are called, while others work."""

from __future__ import annotations

import igl
import scipy.sparse.csgraph
import scipy.spatial

from gdtool.texture.unwrap_lay import flatten_all, lay

__all__ = ["flatten_all", "igl", "lay", "scipy"]
