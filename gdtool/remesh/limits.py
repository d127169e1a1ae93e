"""Limits of remeshing that the command needs before numpy is imported."""

from __future__ import annotations

COUNT_TOLERANCE = 0.03  # relative error of the number of quads that the command promises
MIN_QUADS, MAX_QUADS = 16, 2_000_000  # that can be requested

QUADS_OF_A_PIECE = 12  # least number of quads for a separate piece: a closed body of fewer loses its shape
TRIANGLES_OF_A_PIECE = 4  # the same for triangles: a tetrahedron

MIN_QUAD_SIZE = 1e-5  # of the longest side: a closed surface would need billions of smaller quads

# Seconds for each quad in the quickest way (paired triangles), with reading and writing: 400,000 quads of
# procedural:7 on two cores of 2.5 GHz.
SECONDS_PER_QUAD = 1.1e-4

# The Python module that each engine needs, and how to get it or do without.
ENGINE_PACKAGES = {
    "instant-meshes": ("pynanoinstantmeshes", "pip install pynanoinstantmeshes, or use --engine split"),
    "quadriflow": ("pyQuadriFlow", "pip install 'gdtool[quadriflow]', or use --engine auto"),
}
