"""Small charts joined to neighbours that they lie flat with, tried on a coarse mesh of the surface."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.unwrap.parameterize.flatten import flatten
from gdtool.unwrap.segment.charts import Adjacency, own_corners

_JOINS = 40  # attempts to join two charts
_JOIN_SHARE = 0.02  # charts smaller than this share of the area are joined to others


def joined_stretch(good_stretch: float) -> float:
    """What a chart made of two may stretch, where good_stretch is good for one."""
    return 1 + 2 * (good_stretch - 1)


def joined(
    vertices: np.ndarray,
    faces: np.ndarray,
    label: np.ndarray,
    proxy_vertices: np.ndarray,
    proxy: np.ndarray,
    good_stretch: float,
) -> np.ndarray:
    """Labels (f,) of faces (f, 4) with small charts joined to the neighbour with the longest common seam, where the two
    lie flat together on the proxy, triangles (t, 3) of the same surface."""
    proxy_vertices, proxy = one_vertex_per_fan(proxy_vertices, proxy)
    adjacency = Adjacency(proxy_vertices, np.concatenate([proxy, np.full((len(proxy), 1), -1)], 1))
    place = _brought_over(vertices, faces, label, proxy_vertices, proxy, adjacency)
    total, count, most = adjacency.area.sum(), int(label.max()) + 1, joined_stretch(good_stretch)
    onto = np.arange(count)
    tried: set[tuple[int, int]] = set()
    for _ in range(_JOINS):
        a, b = place[adjacency.pairs].T
        apart = (a != b) & (a >= 0) & (b >= 0)
        pair = np.sort(np.stack([a, b], -1)[apart], 1)
        if not len(pair):
            break
        key, inverse = np.unique(pair[:, 0] * count + pair[:, 1], return_inverse=True)
        # Seams in the open count ten times those on creases (Adjacency.cost).
        seam = np.bincount(inverse.ravel(), adjacency.cost[apart])
        area = np.bincount(place[place >= 0], adjacency.area[place >= 0], count)
        one, two = key // count, key % count
        smaller = np.minimum(area[one], area[two])
        worth = np.where(smaller < _JOIN_SHARE * total, seam / np.sqrt(smaller + 1e-300), 0)
        for k in np.argsort(-worth, kind="stable").tolist():
            if worth[k] > 0 and (int(one[k]), int(two[k])) not in tried:
                break
        else:
            break
        i, j = int(one[k]), int(two[k])
        tried.add((i, j))
        points, triangles = own_corners(proxy_vertices, proxy[(place == i) | (place == j)])
        if flatten(points, triangles, most, most).uv is not None:  # better than good enough is not asked
            place[place == j] = i
            onto[onto == j] = i
            tried = {pair for pair in tried if i not in pair and j not in pair}
    return onto[label]


def _brought_over(
    vertices: np.ndarray,
    faces: np.ndarray,
    label: np.ndarray,
    proxy_vertices: np.ndarray,
    proxy: np.ndarray,
    adjacency: Adjacency,
) -> np.ndarray:
    """(t,) label of the face nearest to each triangle of the proxy and facing like it; -1 beside each label's largest
    piece."""
    from scipy.spatial import cKDTree

    normals, area = polygon_normals(vertices, faces)
    # Opposite sides of a wall thinner than this are told apart by where they face.
    reach = 2 * float(np.sqrt(area.mean()))
    centres = vertices[np.where(faces < 0, faces[:, :1], faces)].mean(1)
    tree = cKDTree(np.concatenate([centres, reach * normals], 1))
    place = label[tree.query(np.concatenate([proxy_vertices[proxy].mean(1), reach * adjacency.normals], 1))[1]]
    pieces = adjacency.connected(place)
    size = np.bincount(pieces, adjacency.area)
    largest = np.zeros(int(label.max()) + 1)
    np.maximum.at(largest, place, size[pieces])
    return np.where(size[pieces] < largest[place], -1, place)
