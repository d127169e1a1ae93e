"""Answer questions about a mesh from its indices: edges, fans, pieces, whether it is closed and manifold.

A fan is a set of faces around one vertex that are connected by edges. A half edge is one side of an edge: one row for
each corner of each face, directed from that corner to the face's next one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gdtool.geometry.hashing import splitmix64
from gdtool.geometry.meshes import Mesh

_MAX_FAN_STEPS = 64  # edges at a vertex beyond which walking around it step by step takes too long
_CHUNK = 2**14  # triangles at a time, so that intermediate arrays stay in the cache
_MIN_COUNTING_KEYS = 4000  # with fewer keys, sorting is quicker than building a sparse matrix


@dataclass(frozen=True)
class Edges:
    """Hold the undirected edges of a mesh of triangles and quads, and its half edges.

    ends (e, 2): vertices, the lower first; count (e,): number of faces; turned (e,) bool: its two faces traverse it in
    the same direction. half_edge_idx (h,): the edge of each half edge; half_face (h,): its face; half_ends (h, 2): the
    vertices it runs from and to. order (h,): half edges sorted by edge, those of one edge in their order.
    """

    ends: np.ndarray
    count: np.ndarray
    turned: np.ndarray
    half_edge_idx: np.ndarray
    half_face: np.ndarray
    half_ends: np.ndarray
    order: np.ndarray

    def face_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the edges (k,) with exactly two faces, and those faces (k, 2)."""
        edge_idx = np.flatnonzero(self.count == 2)
        first = (np.cumsum(self.count) - self.count)[edge_idx]
        return edge_idx, self.half_face[self.order[np.stack([first, first + 1], -1)]]


def edges_of(faces: np.ndarray) -> Edges:
    """Find the edges of faces (f, 3), or (f, 4) where a fourth corner of -1 marks a triangle."""
    faces = np.asarray(faces, np.int64)
    following = np.roll(faces, -1, 1)
    if faces.shape[1] == 4:
        triangle = faces[:, 3] < 0
        following[triangle, 2] = faces[triangle, 0]
    if faces.min(initial=0) < 0:
        used = faces >= 0
        half_ends = np.stack([faces[used], following[used]], -1)
        half_face = np.repeat(np.arange(len(faces)), used.sum(1))
    else:
        half_ends = np.stack([faces.ravel(), following.ravel()], -1)
        half_face = np.arange(len(half_ends)) // faces.shape[1]
    low, high = np.minimum(half_ends[:, 0], half_ends[:, 1]), np.maximum(half_ends[:, 0], half_ends[:, 1])
    width = int(high.max(initial=0)) + 1
    order = _counting_order(high, width)
    order = order[_counting_order(low[order], width)]
    ends = np.stack([low[order], high[order]], -1)
    new = np.ones(len(ends), bool)
    new[1:] = (ends[1:] != ends[:-1]).any(1)
    first = np.flatnonzero(new)
    count = np.diff(first, append=len(ends))
    half_edge_idx = np.empty(len(ends), np.int64)
    half_edge_idx[order] = np.cumsum(new) - 1
    forward = np.bincount(half_edge_idx, half_ends[:, 0] < half_ends[:, 1], len(first))
    turned = (count == 2) & (forward != 1)
    return Edges(ends[first], count, turned, half_edge_idx, half_face, half_ends, order)


def twins_of(faces: np.ndarray) -> np.ndarray | None:
    """Return for each half edge of triangles (f, 3) the opposite half edge, (3 f,) int32.

    None where a half edge has no opposite or several, and for faces that are not triangles. Takes linear time: half
    edges are the entries of a sparse matrix, and the transpose holds the same entries at the opposite places.
    """
    from scipy.sparse import csr_array

    if not _may_have_twins(faces):
        return None
    start = faces.astype(np.int32).ravel()
    end = np.ascontiguousarray(faces[:, [1, 2, 0]]).astype(np.int32).ravel()
    n = int(start.max()) + 1
    name = np.arange(1, len(start) + 1, dtype=np.int32)
    there, back = (csr_array((name, pair), (n, n)) for pair in ((start, end), (end, start)))
    if there.nnz != len(start) or (there.indptr != back.indptr).any():
        return None
    there.sort_indices()
    back.sort_indices()
    if (there.indices != back.indices).any():
        return None
    out = np.empty(len(start), np.int32)
    out[there.data - 1] = back.data - 1
    return out


def has_even_edge_counts(faces: np.ndarray) -> bool:
    """Tell whether each edge of triangles (f, 3) belongs to an even number of them.

    The exclusive or of a hash of every half edge's ends is 0 then. It is 0 by chance once in 2^64. A consistently
    oriented manifold is watertight where this holds, and this takes a tenth of the time of is_watertight().
    """
    total = np.uint64(0)
    for i in range(0, len(faces), _CHUNK):
        start = np.ascontiguousarray(faces[i : i + _CHUNK].T, np.uint64)
        end = start[[1, 2, 0]]
        key = np.minimum(start, end) << np.uint64(32) | np.maximum(start, end)
        total ^= np.bitwise_xor.reduce(splitmix64(key), axis=None)
    return not total


def is_watertight(faces: np.ndarray) -> bool:
    """Tell whether every edge has exactly two faces, which traverse it in opposite directions."""
    faces = np.asarray(faces)
    if not len(faces):
        return False
    if _may_have_twins(faces):
        return twins_of(faces) is not None
    edges = edges_of(faces)
    return bool((edges.count == 2).all() and not edges.turned.any())


def is_manifold(faces: np.ndarray) -> bool:
    """Tell whether no edge has more than two faces, and the faces around each vertex form one fan."""
    if not len(faces):
        return False
    if (twins := twins_of(faces)) is not None:
        return has_one_fan_per_vertex(faces, twins)
    return bool((edges_of(faces).count <= 2).all()) and not len(split_vertices(faces))


def split_vertices(faces: np.ndarray) -> np.ndarray:
    """Return the vertices (k,) whose faces form more than one fan (bow-ties)."""
    return np.flatnonzero(corner_fans(faces)[1] > 1)


def corner_fans(
    faces: np.ndarray, mates: np.ndarray | None = None, edges: Edges | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the fan (f, c) of each face corner, numbered over the whole mesh, and the number of fans at each vertex.

    A fan is the faces around a vertex that are connected by edges of exactly two faces. mates (k, 2): further pairs of
    half edges whose faces count as connected. edges: the edges of the faces, where they are known.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = edges or edges_of(faces)
    used = np.asarray(faces) >= 0
    corner_idx = np.full(faces.shape, -1, np.int64)
    corner_idx[used] = np.arange(int(used.sum()))
    vertex_of = np.asarray(faces)[used]
    # Two faces at a manifold edge join their corners at both of its ends. A corner and its half edge share an index.
    keep = edges.count == 2
    first_half = (np.cumsum(edges.count) - edges.count)[keep]
    left, right = edges.order[first_half], edges.order[first_half + 1]
    if mates is not None:
        left, right = np.concatenate([left, mates[:, 0]]), np.concatenate([right, mates[:, 1]])
    after = np.roll(corner_idx, -1, 1)
    if faces.shape[1] == 4:
        triangle = np.asarray(faces)[:, 3] < 0
        after[triangle, 2] = corner_idx[triangle, 0]
    after = after[used]
    rows, columns = [], []
    for a in (left, after[left]):
        for b in (right, after[right]):
            same = vertex_of[a] == vertex_of[b]
            rows.append(a[same])
            columns.append(b[same])
    rows, columns = np.concatenate(rows), np.concatenate(columns)
    n = len(vertex_of)
    _, label = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n)), False)
    _, first_of = np.unique(label, return_index=True)
    fans = np.bincount(vertex_of[first_of], minlength=int(vertex_of.max()) + 1)
    out = np.full(faces.shape, -1, np.int64)
    out[used] = label
    return out, fans


def components(faces: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of pieces and the piece (f,) of each face; faces that share an edge belong to one piece."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if (twins := twins_of(faces)) is not None:
        return _components_of_twins(twins)
    edges = edges_of(faces)
    # The faces of an edge form a chain, each tied to the next: linear in the corners, however many faces an edge has.
    edge, face = edges.half_edge_idx[edges.order], edges.half_face[edges.order]
    tied = edge[1:] == edge[:-1]
    rows, columns = face[:-1][tied], face[1:][tied]
    return connected_components(coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), (len(faces),) * 2), False)


def triangulated(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut quads (f, 4) along corners 0 and 2; a fourth corner of -1 marks a triangle.

    Returns triangles (t, 3) int32 and the face (t,) int32 that each comes from, in the order of the faces.
    """
    quads = np.flatnonzero(faces[:, 3] >= 0)
    if not len(quads):
        return faces[:, :3].astype(np.int32), np.arange(len(faces), dtype=np.int32)
    triangles = np.concatenate([faces[:, :3], faces[quads][:, [0, 2, 3]]])
    face_idx = np.concatenate([np.arange(len(faces)), quads])
    order = np.argsort(face_idx, kind="stable")
    return triangles[order].astype(np.int32), face_idx[order].astype(np.int32)


def euler_number(faces: np.ndarray) -> int:
    """Return Euler's number: the vertices that faces use, less the edges, plus the faces."""
    return len(np.unique(faces[faces >= 0])) - len(edges_of(faces).ends) + len(faces)


def handles(faces: np.ndarray, pieces: int, edges: Edges | None = None) -> int:
    """Return how many handles a manifold of `pieces` connected pieces has; it may have boundary loops.

    The number follows from Euler's formula. edges: the edges of the faces, where they are known.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = edges_of(faces) if edges is None else edges
    rim = edges.ends[edges.count == 1]
    corners, local = np.unique(rim, return_inverse=True)
    start, end = local.reshape(-1, 2).T
    loops = (
        connected_components(coo_matrix((np.ones(len(start)), (start, end)), (len(corners),) * 2), False)[0]
        if len(rim)
        else 0
    )
    return pieces - (loops + len(np.unique(faces[faces >= 0])) - len(edges.ends) + len(faces)) // 2


class Invariants(NamedTuple):
    """Hold the topological properties that simplification and remeshing must keep."""

    watertight: bool
    manifold: bool
    pieces: int
    euler_number: int


def invariants(faces: np.ndarray) -> Invariants:
    """Compute the invariants of faces (f, 3) or (f, 4)."""
    if (twins := twins_of(faces)) is not None:
        corners = len(np.unique(faces))
        return Invariants(
            True, has_one_fan_per_vertex(faces, twins), _components_of_twins(twins)[0], corners - len(faces) // 2
        )
    return Invariants(is_watertight(faces), is_manifold(faces), components(faces)[0], euler_number(faces))


def has_repeated_corner(faces: np.ndarray) -> np.ndarray:
    """Return (f,) bool: which triangles (f, 3) have a vertex twice."""
    return (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])


def compact(mesh: Mesh) -> Mesh:
    """Drop the vertices that no face uses; faces become int64, and vertices are the same array where all are used."""
    vertices = mesh.vertices
    used, faces = renumbered(mesh.faces, len(vertices))
    return replace(mesh, vertices=vertices if len(used) == len(vertices) else vertices.take(used, 0), faces=faces)


def renumbered(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return which of `count` vertices the faces use (u,), rising, and the faces as indices into these, int64.

    -1, a triangle's fourth corner, stays.
    """
    out = np.array(faces, np.int64)
    used = np.zeros(count + 1, bool)
    used[out] = True
    used[-1] = False  # the element that -1 marks
    used_idx = np.flatnonzero(used)
    if len(used_idx) < count:
        new_idx = np.full(count + 1, -1)
        new_idx[used_idx] = np.arange(len(used_idx))
        out = new_idx.take(out)
    return used_idx, out


def _may_have_twins(faces: np.ndarray) -> bool:
    """Tell whether these are triangles (f, 3) whose indices twins_of() can handle: not negative, and 32 bits wide."""
    return len(faces) > 0 and faces.shape[1] == 3 and faces.min() >= 0 and max(faces.max(), 3 * len(faces)) < 2**31 - 1


def _counting_order(keys: np.ndarray, width: int) -> np.ndarray:
    """Return the stable sorting order (n,) of keys (n,) that are integers below width, in linear time.

    The result is that of np.argsort(keys, kind="stable"). Many keys are sorted as the row indices of a sparse matrix,
    few by numpy.
    """
    from scipy.sparse import csr_array

    if len(keys) < _MIN_COUNTING_KEYS or width > 2**31 - 1 or len(keys) > 2**31 - 1:
        return np.argsort(keys, kind="stable")
    entries = keys.astype(np.int32), np.arange(len(keys), dtype=np.int32)
    return csr_array((np.ones(len(keys), bool), entries), (width, max(len(keys), 1))).indices


def _components_of_twins(twins: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of pieces and the piece (f,) of each triangle of a mesh with an opposite to each half edge.

    twins (3 f,): these opposites, as from twins_of().
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    f = len(twins) // 3
    return connected_components(
        csr_array((np.ones(3 * f, np.int8), twins // 3, np.arange(0, 3 * f + 1, 3)), (f, f)), True, "weak"
    )


def has_one_fan_per_vertex(faces: np.ndarray, twins: np.ndarray) -> bool:
    """Tell whether the faces around each vertex of triangles (f, 3) form one fan.

    twins (3 f,): the opposite of each half edge, as from twins_of(). Walks around all vertices at once, from one half
    edge that leaves the vertex to the next; with one fan the walk meets all half edges that leave it before it comes
    back.
    """
    n, start = len(twins), faces.ravel()
    next_around = twins.take(np.arange(n, dtype=np.int32).reshape(-1, 3)[:, [2, 0, 1]].ravel())
    leaving_count = np.bincount(start)
    last_leaving = np.empty(len(leaving_count), np.int32)
    last_leaving[start] = np.arange(n, dtype=np.int32)
    home = last_leaving.take(np.flatnonzero(leaving_count))
    expected, at, steps = leaving_count.take(start.take(home)), next_around.take(home), 1
    while len(home) and steps < _MAX_FAN_STEPS:
        is_back = at == home
        if (expected[is_back] != steps).any():
            return False
        walking = np.flatnonzero(~is_back)
        home, expected, at = home.take(walking), expected.take(walking), next_around.take(at.take(walking))
        steps += 1
    if not len(home):
        return True
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    # Some vertices have very many edges. The walks are the cycles of a graph, one for each fan.
    graph = csr_array((np.ones(n, np.int8), next_around, np.arange(n + 1)), (n, n))
    return connected_components(graph, True, "strong", return_labels=False) == int((leaving_count > 0).sum())
