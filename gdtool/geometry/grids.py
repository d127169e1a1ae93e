"""Lay out regular grids of signed distances, find the band of cells around the surface, and extract the surface.

A grid's values are signed distances, negative inside. Index (i, j, k) runs along x, y, z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.geometry.meshes import TriMesh


@dataclass(frozen=True)
class Grid:
    """Define a regular grid of sample points: origin + step * (i, j, k), with i, j, k below shape.

    origin (3,) and step in world units; shape: the number of points along each axis.
    """

    origin: np.ndarray
    step: float
    shape: tuple[int, int, int]

    def points(self, index: np.ndarray) -> np.ndarray:
        """Return the world positions (n, 3) float64 of index (n, 3)."""
        return self.origin + self.step * index

    def locate(self, points: np.ndarray) -> np.ndarray:
        """Return the fractional index (n, 3) of world points (n, 3)."""
        return (points - self.origin) / self.step


def grid_over(low: np.ndarray, high: np.ndarray, step: float, margin: int, multiple: int = 1) -> Grid:
    """Return a grid that covers the box from low (3,) to high (3,) and `margin` cells more on each side.

    The number of cells along each axis is a multiple of `multiple`, and the grid is centred on the box.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    cells = np.ceil((high - low) / step).astype(int) + 2 * margin
    cells = -(-cells // multiple) * multiple
    origin = (low + high) / 2 - cells * step / 2
    return Grid(origin, float(step), tuple(int(c) + 1 for c in cells))


def dilate(mask: np.ndarray, steps: int) -> np.ndarray:
    """Dilate a boolean grid or image by a cube or square that reaches `steps` elements to each side."""
    from scipy.ndimage import maximum_filter

    return mask if steps < 1 else maximum_filter(mask, size=2 * steps + 1, mode="constant", cval=0)


def band_cells(inside: np.ndarray, touched: np.ndarray) -> np.ndarray:
    """Return the cells (a-1, b-1, c-1) bool of a coarse grid that the surface may cross.

    inside (a, b, c) bool at the coarse points; touched (a-1, b-1, c-1) bool: cells known to hold surface. A cell is
    in the band when its corners disagree, when it is touched, or when it is next to such a cell.
    """
    count = np.zeros(tuple(n - 1 for n in inside.shape), np.int8)
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                count += inside[i : i + count.shape[0], j : j + count.shape[1], k : k + count.shape[2]]
    return dilate(((count > 0) & (count < 8)) | touched, 1)


def fine_points(cells: np.ndarray, factor: int) -> np.ndarray:
    """Return a boolean grid of the fine points that lie in or on coarse cells (a, b, c) bool.

    factor: fine steps along one side of a coarse cell.
    """
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
    """Interpolate values (a, b, c) at fractional index (n, 3), clamped to the border; (n,) float32."""
    from scipy.ndimage import map_coordinates

    return map_coordinates(values, index.T, order=1, mode="nearest", output=np.float32)


def extract_surface(values: np.ndarray, grid: Grid) -> TriMesh:
    """Extract the surface where values, shaped like the grid, are zero, as a closed mesh.

    vertices float64 in world units, faces int32, counter-clockwise seen from outside; no faces where no value is
    negative. Lewiner's marching cubes (topologically consistent) run on the grid padded with outside values, so that
    the mesh has no boundary. Values nearer to zero than a thousandth of a step are moved to that distance: a sample
    equal to the level makes faces without area.
    """
    from skimage.measure import marching_cubes

    tiny = 1e-3 * grid.step
    padded = np.pad(values, 1, constant_values=grid.step)
    padded = np.where(np.abs(padded) < tiny, np.where(padded < 0, -tiny, tiny), padded).astype(np.float32)
    if not (padded < 0).any():
        return TriMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    vertices, faces, _, _ = marching_cubes(padded, 0.0, allow_degenerate=True)
    vertices = (vertices.astype(np.float64) - 1) * grid.step + grid.origin
    faces = np.ascontiguousarray(faces, np.int32)
    if signed_volume(TriMesh(vertices, faces)) < 0:
        faces = faces[:, ::-1].copy()
    return TriMesh(vertices, faces)


def signed_volume(mesh: TriMesh) -> float:
    """Return the volume that a closed mesh encloses; negative where its faces look inward."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def components(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Return the connected piece (f,) of each face, from 0; faces that share a vertex belong to one piece."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    rows = faces[:, [0, 1]].ravel()
    columns = faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(vertex_count, vertex_count))
    _, labels = connected_components(graph, directed=False)
    return np.unique(labels[faces[:, 0]], return_inverse=True)[1]


def keep_faces(mesh: TriMesh, keep: np.ndarray) -> TriMesh:
    """Return the mesh of the faces where keep (f,) is true, without unused vertices; faces become int32."""
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    return TriMesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32))


def edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the undirected edges (e, 2) of triangles, and how many faces share each (e,); 2 in a closed manifold."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1).astype(np.int64)
    key = edges[:, 0] * (int(faces.max()) + 1 if len(faces) else 1) + edges[:, 1]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    return edges[first], count
