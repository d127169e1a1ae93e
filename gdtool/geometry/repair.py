"""Checks and repairs of triangle meshes before anything native sees them, and the topology that tells whether it worked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.core.errors import InputError
from gdtool.geometry.normals import face_normals
from gdtool.geometry.rows import unique_rows

# Welding joins vertices closer than this share of the longest side: far below any detail, far above rounding.
WELD_SHARE = 1e-7


_FAN = 64  # edges at a vertex; of more a walk around it step by step takes too long
_FEW = 4000  # keys, below which sorting is quicker than building a sparse matrix


@dataclass(frozen=True)
class Edges:
    """Undirected edges of a mesh of triangles and quads.

    ends (e, 2) vertices, lower first; count (e,) faces at it; turned (e,) bool: two faces walk it in one direction.
    half_edge_idx (h,) into ends, half_face (h,) the face, half_ends (h, 2) the directed edge: one row a face corner.
    order (h,) the half edges edge by edge, those of one edge as they come.
    """

    ends: np.ndarray
    count: np.ndarray
    turned: np.ndarray
    half_edge_idx: np.ndarray
    half_face: np.ndarray
    half_ends: np.ndarray
    order: np.ndarray

    def face_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges (k,) with exactly two faces, and those faces (k, 2)."""
        edge_idx = np.flatnonzero(self.count == 2)
        first = (np.cumsum(self.count) - self.count)[edge_idx]
        return edge_idx, self.half_face[self.order[np.stack([first, first + 1], -1)]]


def edges_of(faces: np.ndarray) -> Edges:
    """Edges of faces (f, 3), or (f, 4) where a fourth corner of -1 marks a triangle."""
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


def _counting_order(keys: np.ndarray, width: int) -> np.ndarray:
    """What np.argsort(keys, kind="stable") gives for keys (n,) below width, in linear time: as a sparse matrix' rows."""
    from scipy.sparse import csr_array

    if len(keys) < _FEW or width > 2**31 - 1 or len(keys) > 2**31 - 1:
        return np.argsort(keys, kind="stable")
    where = keys.astype(np.int32), np.arange(len(keys), dtype=np.int32)
    return csr_array((np.ones(len(keys), bool), where), (width, max(len(keys), 1))).indices


def is_watertight(faces: np.ndarray) -> bool:
    """Every edge has exactly two faces, which walk it in opposite directions."""
    faces = np.asarray(faces)
    if not len(faces):
        return False
    if not _plain(faces):
        edges = edges_of(faces)
        return bool((edges.count == 2).all() and not edges.turned.any())
    return _twins(faces) is not None


def _plain(faces: np.ndarray) -> bool:
    """Whether these are triangles (f, 3) that _twins can take."""
    return len(faces) > 0 and faces.shape[1] == 3 and faces.min() >= 0 and max(faces.max(), 3 * len(faces)) < 2**31 - 1


def _twins(faces: np.ndarray) -> np.ndarray | None:
    """(3 f,) the half edge the other way round for each half edge of triangles (f, 3); None where one has none or several.

    In linear time: half edges are the entries of a sparse matrix, whose transpose has the same entries elsewhere.
    """
    from scipy.sparse import csr_array

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


def is_manifold(faces: np.ndarray) -> bool:
    """No edge has more than two faces, and the faces around each vertex form one fan."""
    if not len(faces):
        return False
    if is_watertight(faces) and faces.shape[1] == 3:
        return _vertices_manifold(faces)
    edges = edges_of(faces)
    return bool((edges.count <= 2).all()) and not len(split_vertices(faces))


def split_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices (k,) whose faces form more than one fan (bow-ties)."""
    return np.flatnonzero(corner_fans(faces)[1] > 1)


def corner_fans(faces: np.ndarray, mates: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The fan (f, c) each face corner belongs to (numbered over the mesh), and the number of fans at each vertex.

    Fans go on across edges of exactly two faces, and across mates (k, 2), pairs of half edges that belong together.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = edges_of(faces)
    used = np.asarray(faces) >= 0
    corner_idx = np.full(faces.shape, -1, np.int64)
    corner_idx[used] = np.arange(int(used.sum()))
    vertex_of = np.asarray(faces)[used]
    # Two faces at a manifold edge join their corners at both of its ends. The half edge of a corner starts there.
    keep = edges.count == 2
    first = (np.cumsum(edges.count) - edges.count)[keep]
    one, two = edges.order[first], edges.order[first + 1]
    if mates is not None:
        one, two = np.concatenate([one, mates[:, 0]]), np.concatenate([two, mates[:, 1]])
    after = np.roll(corner_idx, -1, 1)
    if faces.shape[1] == 4:
        triangle = np.asarray(faces)[:, 3] < 0
        after[triangle, 2] = corner_idx[triangle, 0]
    after = after[used]
    rows, columns = [], []
    for a in (one, after[one]):
        for b in (two, after[two]):
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


def without_crumbs(vertices: np.ndarray, faces: np.ndarray, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Without the smallest pieces beyond the number there should be, if they are crumbs: 2 % of the faces or less."""
    count, piece = components(faces)
    if count <= pieces:
        return vertices, faces
    size = np.bincount(piece)
    keep = np.argsort(-size, kind="stable")[:pieces]
    if size[keep].sum() < 0.98 * len(faces):
        return vertices, faces
    return compact(vertices, faces[np.isin(piece, keep)])


def components(faces: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of pieces and the piece (f,) of each face; faces that share an edge are of one piece."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if _plain(faces) and (twins := _twins(faces)) is not None:
        return _pieces(twins)
    edges = edges_of(faces)
    # The faces of an edge in a row, each tied to the next: linear in the number of corners, whatever the edges' valence.
    edge, face = edges.half_edge_idx[edges.order], edges.half_face[edges.order]
    tied = edge[1:] == edge[:-1]
    rows, columns = face[:-1][tied], face[1:][tied]
    return connected_components(coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), (len(faces),) * 2), False)


def _pieces(twins: np.ndarray) -> tuple[int, np.ndarray]:
    """components() of triangles that have twins."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    f = len(twins) // 3
    return connected_components(csr_array((np.ones(3 * f, np.int8), twins // 3, np.arange(0, 3 * f + 1, 3)), (f, f)), True, "weak")


def euler_number(faces: np.ndarray) -> int:
    """Vertices that are used, less edges, plus faces."""
    return len(np.unique(faces[faces >= 0])) - len(edges_of(faces).ends) + len(faces)


def topology(faces: np.ndarray) -> tuple[bool, bool, int, int]:
    """Watertight, manifold, pieces, Euler number: what a mesh must not change in when it is made coarser or even."""
    if _plain(faces) and (twins := _twins(faces)) is not None:
        corners = len(np.unique(faces))
        return True, _one_fan_each(faces, twins), _pieces(twins)[0], corners - len(faces) // 2
    return is_watertight(faces), is_manifold(faces), components(faces)[0], euler_number(faces)


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without the vertices that no face uses."""
    used, faces = renumbered(faces, len(vertices))
    return vertices if len(used) == len(vertices) else vertices.take(used, 0), faces


def renumbered(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of `count` vertices faces use (u,), in order, and the faces by their place among these, int64; -1 stays."""
    out = np.array(faces, np.int64)
    used = np.zeros(count + 1, bool)
    used[out] = True
    used[-1] = False  # where -1, a triangle's fourth corner, points
    places = np.flatnonzero(used)
    if len(places) < count:
        number = np.full(count + 1, -1)
        number[places] = np.arange(len(places))
        out = number.take(out)
    return places, out


def check(vertices: np.ndarray, faces: np.ndarray, subject: object = "mesh") -> None:
    """Raise InputError when there is nothing to work on, an index is out of range or a coordinate is not finite."""
    if not len(faces):
        raise InputError(subject, "has no faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(subject, f"a face refers to vertex {int(faces.max() if faces.min() >= 0 else faces.min())} of {len(vertices)}")
    bad = ~np.isfinite(vertices).all(1)
    if bad.any():
        raise InputError(subject, f"vertex {int(np.argmax(bad))} is not finite ({int(bad.sum())} such)")


def clean(vertices: np.ndarray, faces: np.ndarray, subject: object = "mesh") -> tuple[np.ndarray, np.ndarray, dict[str, int | bool], bool]:
    """A manifold, consistently oriented mesh of the same shape, what had to be done to it, and whether it is watertight.

    vertices (v, 3) float, faces (f, 3). A closed, manifold mesh passes unchanged except for unused vertices. Raises
    InputError (see check), also when all faces have no area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    check(vertices, faces, subject)
    report: dict[str, int | bool] = {}

    def note(name: str, count: int) -> None:
        if count:
            report[name] = int(count)

    used = np.ascontiguousarray(compact(vertices, faces)[0].T)
    extent = float((used.max(1) - used.min(1)).max())
    if not extent > 0:
        raise InputError(subject, "all its faces lie in one point")
    sides = face_normals(vertices / extent, faces)
    if not sides[1].any():
        raise InputError(subject, "no face has an area")
    repeated = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    if repeated.any():
        note("degenerate_faces", repeated.sum())
        faces, sides = faces[~repeated], tuple(side[~repeated] for side in sides)
    if not len(faces):
        raise InputError(subject, "no face has an area")
    twins = _twins(faces) if _plain(faces) else None
    closed = is_watertight(faces) if twins is None else True
    if closed and (_vertices_manifold(faces) if twins is None else _one_fan_each(faces, twins)):
        if _volume(vertices / extent, faces, *sides) < 0:
            report["turned_inside_out"] = True
            faces = faces[:, ::-1].copy()
        return *compact(vertices, faces), report, True
    if not closed:
        # A closed mesh is left as its indices say: welding could join sheets that only touch.
        welded = _weld(vertices, faces, extent * WELD_SHARE)
        note("welded_vertices", len(np.unique(faces)) - len(np.unique(welded)))
        repeated = (welded == np.roll(welded, 1, 1)).any(1)
        note("degenerate_faces", repeated.sum() + report.get("degenerate_faces", 0))
        faces = welded[~repeated]
    _, first, _ = unique_rows(np.sort(faces, 1))
    note("duplicate_faces", len(faces) - len(first))
    faces = faces[np.sort(first)]
    if not len(faces):
        raise InputError(subject, "no face has an area")
    flat = face_normals(vertices / extent, faces)[1] == 0
    if flat.any() and not is_watertight(faces):
        # In a closed mesh a flat face is a seam that keeps it closed.
        note("zero_area_faces", flat.sum())
        faces = faces[~flat]
    vertices, faces = compact(vertices, faces)
    edges = edges_of(faces)
    if (edges.count > 2).any() or edges.turned.any():
        note("nonmanifold_edges", (edges.count > 2).sum())
        note("turned_edges", edges.turned.sum())
        vertices, faces = _split(vertices, faces)
        faces = _oriented(vertices, faces)
    fans, number = corner_fans(faces)
    if (number > 1).any():
        note("nonmanifold_vertices", (number > 1).sum())
        vertices, faces = one_vertex_per_fan(vertices, faces, fans)
    closed = is_watertight(faces)
    if closed and _volume(vertices / extent, faces, *face_normals(vertices / extent, faces)) < 0:
        report["turned_inside_out"] = True
        faces = faces[:, ::-1].copy()
    return vertices, faces, report, closed


def _vertices_manifold(faces: np.ndarray) -> bool:
    """Whether the faces around each vertex of a watertight mesh of triangles (f, 3) form one fan."""
    twins = _twins(faces)
    return not len(split_vertices(faces)) if twins is None else _one_fan_each(faces, twins)


def _one_fan_each(faces: np.ndarray, twins: np.ndarray) -> bool:
    """As _vertices_manifold: whether who walks around each vertex, from an edge that leaves it to the next one, meets all that do."""
    n, start = len(twins), faces.ravel()
    turn = twins.take(np.arange(n, dtype=np.int32).reshape(-1, 3)[:, [2, 0, 1]].ravel())
    number = np.bincount(start)
    one = np.empty(len(number), np.int32)
    one[start] = np.arange(n, dtype=np.int32)
    home = one.take(np.flatnonzero(number))
    left, at, steps = number.take(start.take(home)), turn.take(home), 1
    while len(home) and steps < _FAN:
        back = at == home
        if (left[back] != steps).any():
            return False
        on = np.flatnonzero(~back)
        home, left, at, steps = home.take(on), left.take(on), turn.take(at.take(on)), steps + 1
    if not len(home):
        return True
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    # Around some there are very many: the walks are the cycles of a graph.
    graph = csr_array((np.ones(n, np.int8), turn, np.arange(n + 1)), (n, n))
    return connected_components(graph, True, "strong", return_labels=False) == int((number > 0).sum())


def _volume(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> float:
    """Signed volume within a closed mesh of triangles (f, 3), whose normals (f, 3) and areas (f,) are known."""
    corners = (vertices - vertices[faces[0, 0]]).take(faces[:, 0], 0)
    return float(np.einsum("ij,ij,i", corners, normals, areas, optimize=False) / 3)


def _weld(vertices: np.ndarray, faces: np.ndarray, distance: float) -> np.ndarray:
    """Faces with one index for vertices that round to the same place."""
    grid = np.rint((vertices - vertices.min(0)) / distance)
    _, first, inverse = unique_rows(grid)
    return first[inverse][faces]


def _split(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut along edges of more than two faces, faces that walk an edge alike turned first where that helps."""
    import igl

    faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(faces))[0])
    vertices, faces, _ = igl.split_nonmanifold(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
    return np.asarray(vertices), np.asarray(faces)


def _oriented(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Each closed piece turned to face outward; open ones keep the majority of the directions they had."""
    import igl

    faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(faces))[0]).copy()
    count, piece = components(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    centre = np.stack([np.bincount(piece, a[:, i], count) for i in range(3)], -1) / np.bincount(piece, minlength=count)[:, None]
    volume = np.bincount(piece, np.einsum("ij,ij->i", a - centre[piece], np.cross(b - a, c - a)), count)
    inward = (volume < 0)[piece]
    faces[inward] = faces[inward][:, ::-1]
    return faces


def one_vertex_per_fan(vertices: np.ndarray, faces: np.ndarray, fans: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Bow-tie vertices doubled, so that each fan of faces (f, 3) or (f, 4) has its own; compact."""
    fans = corner_fans(faces)[0] if fans is None else fans
    used = faces >= 0
    _, first, new = np.unique(fans[used], return_index=True, return_inverse=True)
    out = np.full(faces.shape, -1, np.int64)
    out[used] = new.ravel()
    return vertices[faces[used][first]], out
