"""Merge small charts with neighbours if the two lie flat together, as tried on a coarse proxy of the surface."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.unwrap.parameterize.flatten import flatten
from gdtool.unwrap.segment.charts import Adjacency, chart_mesh

_MAX_ATTEMPTS = 40  # to merge two charts
_SMALL_SHARE = 0.02  # of the area: charts smaller than this are merged


def merged_stretch_limit(good_stretch: float) -> float:
    """Compute the L2 stretch allowed for a chart merged from two, where good_stretch is good for one."""
    return 1 + 2 * (good_stretch - 1)


def merge_small_charts(
    mesh: QuadMesh,
    label: np.ndarray,
    proxy_mesh: TriMesh,
    good_stretch: float,
) -> np.ndarray:
    """Merge small charts into the neighbour with the longest common seam, where the two lie flat together.

    Both are flattened on proxy_mesh, a coarse mesh of the same surface. Returns labels (f,) of the mesh's faces.
    """
    proxy_mesh = one_vertex_per_fan(proxy_mesh)
    proxy_vertices, proxy = proxy_mesh.vertices, proxy_mesh.faces
    adjacency = Adjacency(QuadMesh(proxy_vertices, np.concatenate([proxy, np.full((len(proxy), 1), -1)], 1)))
    proxy_label = _transfer_labels(mesh, label, proxy_mesh, adjacency)
    total, count, max_stretch = adjacency.area.sum(), int(label.max()) + 1, merged_stretch_limit(good_stretch)
    merged_into = np.arange(count)
    tried: set[tuple[int, int]] = set()
    for _ in range(_MAX_ATTEMPTS):
        a, b = proxy_label[adjacency.pairs].T
        is_seam = (a != b) & (a >= 0) & (b >= 0)
        pair = np.sort(np.stack([a, b], -1)[is_seam], 1)
        if not len(pair):
            break
        key, inverse = np.unique(pair[:, 0] * count + pair[:, 1], return_inverse=True)
        # Seams in the open count ten times those on creases (Adjacency.cost).
        seam = np.bincount(inverse.ravel(), adjacency.cost[is_seam])
        area = np.bincount(proxy_label[proxy_label >= 0], adjacency.area[proxy_label >= 0], count)
        first, second = key // count, key % count
        smaller = np.minimum(area[first], area[second])
        priority = np.where(smaller < _SMALL_SHARE * total, seam / np.sqrt(smaller + 1e-300), 0)
        for k in np.argsort(-priority, kind="stable").tolist():
            if priority[k] > 0 and (int(first[k]), int(second[k])) not in tried:
                break
        else:
            break
        i, j = int(first[k]), int(second[k])
        tried.add((i, j))
        chart = chart_mesh(TriMesh(proxy_vertices, proxy[(proxy_label == i) | (proxy_label == j)]))
        # Flattening may stop as soon as it is good enough.
        if flatten(chart, max_stretch, max_stretch).uv is not None:
            proxy_label[proxy_label == j] = i
            merged_into[merged_into == j] = i
            tried = {pair for pair in tried if i not in pair and j not in pair}
    return merged_into[label]


def _transfer_labels(
    mesh: QuadMesh,
    label: np.ndarray,
    proxy_mesh: TriMesh,
    adjacency: Adjacency,
) -> np.ndarray:
    """Find for each triangle of the proxy the label (t,) of the nearest face that faces the same way.

    The label is -1 outside the largest connected piece of each label.
    """
    from scipy.spatial import cKDTree

    vertices, faces = mesh.vertices, mesh.faces
    proxy_vertices, proxy = proxy_mesh.vertices, proxy_mesh.faces

    normals, area = polygon_normals(mesh)
    # Normals, weighted by this distance, tell the two sides of a thin wall apart.
    normal_weight = 2 * float(np.sqrt(area.mean()))
    centres = vertices[np.where(faces < 0, faces[:, :1], faces)].mean(1)
    tree = cKDTree(np.concatenate([centres, normal_weight * normals], 1))
    proxy_label = label[
        tree.query(np.concatenate([proxy_vertices[proxy].mean(1), normal_weight * adjacency.normals], 1))[1]
    ]
    pieces = adjacency.connected_labels(proxy_label)
    size = np.bincount(pieces, adjacency.area)
    largest = np.zeros(int(label.max()) + 1)
    np.maximum.at(largest, proxy_label, size[pieces])
    return np.where(size[pieces] < largest[proxy_label], -1, proxy_label)
