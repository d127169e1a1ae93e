"""What remesh's children run beside it, with all that they need, which is read before they are forked."""

from __future__ import annotations

import scipy.sparse.csgraph
import scipy.spatial

from gdtool.core.native import imported
from gdtool.geometry.quad_ahead import finished
from gdtool.geometry.quad_candidate import candidate
from gdtool.geometry.quad_fallback import cut_evened, own_evened, split_evened
from gdtool.geometry.quads import quads_of

igl = imported("igl")  # read before the fork

__all__ = ["candidate", "cut_evened", "finished", "igl", "own_evened", "quads_of", "scipy", "split_evened"]
