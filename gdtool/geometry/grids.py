"""Regular grids of signed distances: layout, narrow bands, extraction of a watertight surface.

A grid's values are signed distances, negative inside. Index (i, j, k) runs along x, y, z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Grid:
    """Sample points origin + step * (i, j, k); origin (3,) world, step world units, shape the number of points."""

    origin: np.ndarray
    step: float
    shape: tuple[int, int, int]

    def points(self, index: np.ndarray) -> np.ndarray:
        """World positions (n, 3) float64 of index (n, 3)."""
        return self.origin + self.step * index

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Fractional index (n, 3) of world points (n, 3)."""
        return (points - self.origin) / self.step


def grid_over(low: np.ndarray, high: np.ndarray, step: float, margin: int, multiple: int = 1) -> Grid:
    """Return the grid of the given step that covers the box low..high and margin points more on each side.

    The number of cells along each axis is a multiple of `multiple`, and the grid is centred on the box.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    cells = np.ceil((high - low) / step).astype(int) + 2 * margin
    cells = -(-cells // multiple) * multiple
    origin = (low + high) / 2 - cells * step / 2
    return Grid(origin, float(step), tuple(int(c) + 1 for c in cells))


def dilate(mask: np.ndarray, steps: int) -> np.ndarray:
    """Boolean grid or image grown by a cube or square of the given half-size."""
    from scipy.ndimage import maximum_filter

    return mask if steps < 1 else maximum_filter(mask, size=2 * steps + 1, mode="constant", cval=0)


def band_cells(inside: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """Cells of a coarse grid that the surface may cross.

    inside (a, b, c) bool at the coarse points, touched (a-1, b-1, c-1) bool: cells known to hold surface. A cell is
    in the band when its corners disagree, when it is touched, or when it neighbours such a cell.
    """
    count = np.zeros(tuple(n - 1 for n in inside.shape), np.int8)
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                count += inside[i : i + count.shape[0], j : j + count.shape[1], k : k + count.shape[2]]
    return dilate(((count > 0) & (count < 8)) | touched, 1)


def fine_points(cells: np.ndarray, factor: int) -> np.ndarray:
    """Boolean grid of the fine points (factor fine steps a coarse cell) that lie in or on the given coarse cells."""
    fine = np.zeros(tuple(n * factor + 1 for n in cells.shape), bool)
    grown = cells
    for axis in range(3):
        grown = np.repeat(grown, factor, axis)
    n = grown.shape
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                fine[i : i + n[0], j : j + n[1], k : k + n[2]] |= grown
    return fine


def sample_trilinear(values: np.ndarray, index: np.ndarray) -> np.ndarray:
    """values (a, b, c) at fractional index (n, 3), clamped to the border -> (n,) float32."""
    from scipy.ndimage import map_coordinates

    return map_coordinates(values, index.T, order=1, mode="nearest", output=np.float32)


def extract(values: np.ndarray, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return the zero surface as a closed mesh: vertices (v, 3) float64 world, faces (f, 3) int32 wound outward.

    Lewiner's marching cubes (topologically consistent) on the grid padded with outside, so that nothing stays open.
    Values nearer to zero than a thousandth of a step are pushed off it: a level equal to a sample makes faces of zero
    area. Empty arrays when nothing is inside.
    """
    from skimage.measure import marching_cubes

    tiny = 1e-3 * grid.step
    padded = np.pad(values, 1, constant_values=grid.step)
    padded = np.where(np.abs(padded) < tiny, np.where(padded < 0, -tiny, tiny), padded).astype(np.float32)
    if not (padded < 0).any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    vertices, faces, _, _ = marching_cubes(padded, 0.0, allow_degenerate=True)
    vertices = (vertices.astype(np.float64) - 1) * grid.step + grid.origin
    faces = np.ascontiguousarray(faces, np.int32)
    if signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1].copy()
    return vertices, faces


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume enclosed by an outward mesh; negative when it is wound inward."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def components(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Label (f,) of the connected piece each face belongs to, from 0."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows = faces[:, [0, 1]].ravel()
    columns = faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(vertex_count, vertex_count))
    _, labels = connected_components(graph, directed=False)
    return np.unique(labels[faces[:, 0]], return_inverse=True)[1]


def keep_faces(vertices: np.ndarray, faces: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mesh of faces where keep (f,) is true, without unused vertices, and the old index of each vertex."""
    faces = faces[keep]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int32), used


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undirected edges (e, 2) and how many faces share each (e,). A closed manifold mesh has 2 everywhere."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1).astype(np.int64)
    key = edges[:, 0] * (int(faces.max()) + 1 if len(faces) else 1) + edges[:, 1]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    return edges[first], count
