"""Project quads onto a triangle mesh: subdivision, constrained smoothing, hole filling and doublet removal."""

from __future__ import annotations

from itertools import pairwise
from typing import overload

import numpy as np

from gdtool.geometry.distance import SearchTree
from gdtool.geometry.mesh_quality import polygon_normals, valences
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.topology import Edges, compact, corner_fans, edges_of
from gdtool.remesh.fit.feature_curves import Constraints, Features, closest_on_segments

_EXACT_EVERY = 5  # steps between two searches for the closest point
_BENT_COSINE = 0.97  # between a quad's normal and the surface's, below which the surface bends under the quad
_DOUBLET_ROUNDS = 8  # of removal; each can make new doublets


class ProjectionTarget(SearchTree):
    """A triangle mesh to project points onto, with its search tree and the normals (f, 3) of its faces."""

    def __init__(self, mesh: TriMesh):
        super().__init__(mesh)
        self.normals = face_normals(self.mesh)[0]


@overload
def subdivide(mesh: QuadMesh) -> tuple[QuadMesh, None]: ...


@overload
def subdivide(mesh: QuadMesh, constraints: Constraints) -> tuple[QuadMesh, Constraints]: ...


def subdivide(mesh: QuadMesh, constraints: Constraints | None = None) -> tuple[QuadMesh, Constraints | None]:
    """Cut each face into one quad per corner: quads into four, triangles into three.

    Returns 4 q + 3 t quads, whose vertices are the old ones, then edge midpoints, then face centres; and the
    constraints with every path edge halved (None without constraints).
    """
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    used = faces >= 0
    centre = np.where(used[..., None], vertices[np.where(used, faces, 0)], 0).sum(1) / used.sum(1)[:, None]
    v, e = len(vertices), len(edges.ends)
    out = np.concatenate([vertices, vertices[edges.ends].mean(1), centre])
    # Half edges come in the order of used corners; the edge before a corner is the previous one of its face.
    next_edge = np.full(faces.shape, -1, np.int64)
    next_edge[used] = edges.half_edge_idx
    previous_edge = np.roll(next_edge, 1, 1)
    triangle = ~used[:, 3]
    previous_edge[triangle, 0] = next_edge[triangle, 2]
    face_idx = np.repeat(np.arange(len(faces)), used.sum(1))
    quads = np.stack([faces[used], v + next_edge[used], v + e + face_idx, v + previous_edge[used]], -1)
    if constraints is None:
        return QuadMesh(out, quads), None
    width = v + 1
    key = edges.ends[:, 0] * width + edges.ends[:, 1]
    path = np.sort(constraints.path, 1)
    edge_idx = np.searchsorted(key, path[:, 0] * width + path[:, 1])
    curve, fixed = np.full(len(out), -1), np.zeros(len(out), bool)
    curve[:v], fixed[:v] = constraints.curve, constraints.fixed
    curve[v + edge_idx] = constraints.path_curve
    halves = np.concatenate([np.stack([path[:, 0], v + edge_idx], -1), np.stack([path[:, 1], v + edge_idx], -1)])
    return QuadMesh(out, quads), Constraints(curve, fixed, halves, np.tile(constraints.path_curve, 2))


def _average_matrix(pairs: np.ndarray, count: int):
    """Make the sparse (count, count) matrix that averages the neighbours of each vertex; pairs (e, 2) are edges."""
    from scipy.sparse import coo_matrix, diags

    rows = np.concatenate([pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([pairs[:, 1], pairs[:, 0]])
    matrix = coo_matrix((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()
    return (diags(1 / np.maximum(np.asarray(matrix.sum(1)).ravel(), 1)) @ matrix).tocsr()


def project(
    vertices: np.ndarray, surface: ProjectionTarget, features: Features, constraints: Constraints
) -> np.ndarray:
    """Project vertices (v, 3): free ones onto the surface, held ones onto their feature curve; fixed ones stay."""
    return ConstrainedProjector(surface, features, constraints).exact(vertices)


class ConstrainedProjector:
    """A projector for vertices that move in small steps.

    It searches for the closest point once in _EXACT_EVERY steps. Between, a vertex is projected to the plane of its
    last closest triangle, or to the line of its curve's last segment.
    """

    def __init__(self, surface: ProjectionTarget, features: Features, constraints: Constraints):
        self._surface, self._points = surface, features.points
        self._free = np.flatnonzero((constraints.curve < 0) & ~constraints.fixed)
        held = np.flatnonzero(constraints.curve >= 0)
        self._held = held[np.argsort(constraints.curve[held], kind="stable")]  # curve by curve
        curve = constraints.curve[self._held]
        first = np.flatnonzero(np.diff(curve, prepend=-1)).tolist()
        self._curves = [
            (slice(start, end), features.segments[features.curve == curve[start]])
            for start, end in pairwise([*first, len(curve)])
        ]
        self._normals: np.ndarray | None = None
        self._steps = 0
        self.placed: np.ndarray | None = None  # the last result of exact()

    def exact(self, vertices: np.ndarray) -> np.ndarray:
        """Project vertices (v, 3) to their closest points; held ones on their curve; fixed ones stay."""
        out = vertices.copy()
        _, face_idx, point = self._surface.closest(vertices[self._free])
        out[self._free] = point
        self._normals = self._surface.normals[face_idx]
        on_curves, ends = vertices[self._held], np.zeros((len(self._held), 2), np.int64)
        for index, segments in self._curves:
            _, segment, on_curves[index] = closest_on_segments(on_curves[index], self._points, segments)
            ends[index] = segments[segment]
        out[self._held] = on_curves
        line = self._points[ends[:, 1]] - self._points[ends[:, 0]]
        self._lines = line / np.maximum(np.linalg.norm(line, axis=1), 1e-300)[:, None]
        self.placed = out
        return out

    def step(self, moved: np.ndarray, vertices: np.ndarray, last: bool) -> np.ndarray:
        """Project vertices that moved from `vertices`, which lay on the surface, to `moved` (v, 3).

        The closest points are searched in the last step (`last`) and in every few; between, planes and lines
        approximate them.
        """
        self._steps += 1
        if last or self._normals is None or self._steps % _EXACT_EVERY == 0:
            return self.exact(moved)
        out, movement = moved.copy(), moved - vertices
        for index, direction, start, sign in (
            (self._free, self._normals, moved, -1),
            (self._held, self._lines, vertices, 1),
        ):
            out[index] = start[index] + sign * np.einsum("ni,ni->n", movement[index], direction)[:, None] * direction
        return out


def relax(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    iterations: int,
    strength: float = 0.6,
) -> np.ndarray:
    """Smooth vertices along the surface: each moves toward the mean of its neighbours, and back onto the surface."""
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    average = _average_matrix(edges.ends, len(vertices))
    along = _average_matrix(constraints.path, len(vertices)) if len(constraints.path) else None
    held = (constraints.curve >= 0) & ~constraints.fixed
    if along is not None:
        # The end of an open path would shrink back and uncover the feature: it is averaged as a free vertex.
        held &= np.diff(along.indptr) == 2
    still = immovable_vertices(edges, len(vertices), constraints)
    slide = ConstrainedProjector(surface, features, constraints)
    for turn in range(iterations):
        target = average @ vertices
        if along is not None:
            target[held] = (along @ vertices)[held]
        moved = vertices + strength * (target - vertices)
        moved[still] = vertices[still]
        vertices = slide.step(moved, vertices, turn == iterations - 1)
    return vertices


def immovable_vertices(edges: Edges, count: int, constraints: Constraints) -> np.ndarray:
    """Mark the vertices that may not move, (v,) bool.

    They are the fixed ones, and those on boundaries that no curve holds.
    """
    boundary = np.zeros(count, bool)
    boundary[edges.ends[edges.count != 2].ravel()] = True
    return constraints.fixed | (boundary & (constraints.curve < 0))


def surface_normals_below(mesh: QuadMesh, surface: ProjectionTarget) -> np.ndarray:
    """Sample unit normals (f, 3) of the surface under each quad, at its centre.

    Where the surface bends away from the quad's own normal, points half-way to its corners are sampled too.
    """
    vertices, faces = mesh.vertices, mesh.faces
    corners = vertices[faces]
    centre = corners.mean(1, keepdims=True)
    below = surface.normals[surface.closest(centre[:, 0])[1]]
    bent = np.flatnonzero((below * polygon_normals(mesh)[0]).sum(1) < _BENT_COSINE)
    inner = ((corners[bent] + centre[bent]) / 2).reshape(-1, 3)
    below[bent] += surface.normals[surface.closest(inner)[1]].reshape(len(bent), 4, 3).sum(1)
    return below / np.maximum(np.linalg.norm(below, axis=1), 1e-300)[:, None]


class GroupedLists:
    """Values (n,) grouped by key (n,) in 0 ... count - 1, in the order given within each group.

    lists[key] is an array.
    """

    def __init__(self, key: np.ndarray, value: np.ndarray, count: int):
        self.value = value[np.argsort(key, kind="stable")]
        self.start = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=count))])

    def __getitem__(self, key: int) -> np.ndarray:
        return self.value[self.start[key] : self.start[key + 1]]

    def lengths(self, keys: np.ndarray) -> np.ndarray:
        """Return the lengths of the lists of keys (k,)."""
        return self.start[keys + 1] - self.start[keys]

    def rows(self, keys: np.ndarray) -> np.ndarray:
        """Return the lists of keys (k,) as rows of one array; a short row repeats its last value. None may be empty."""
        length = self.lengths(keys)
        return self.value[self.start[keys][:, None] + np.minimum(np.arange(length.max()), length[:, None] - 1)]


def faces_around_vertices(faces: np.ndarray, count: int) -> GroupedLists:
    """Group the faces by vertex."""
    return GroupedLists(faces.ravel(), np.arange(faces.size) // faces.shape[1], count)


def neighbours(ends: np.ndarray, count: int) -> GroupedLists:
    """Group the vertices at the other ends of edges (e, 2) by vertex."""
    return GroupedLists(ends.T.ravel(), ends[:, ::-1].T.ravel(), count)


def fill_holes(mesh: QuadMesh, longest: int = 64) -> QuadMesh:
    """Close boundary loops with an even number of edges, at most `longest`, by quads around a new vertex.

    Where two holes meet at a vertex, they are closed separately.
    """
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    border = edges.count[edges.half_edge_idx] == 1
    half = edges.half_ends[border]
    if not len(half):
        return mesh
    fans = corner_fans(faces)[0]
    leaving, arriving = fans.ravel()[border], np.roll(fans, -1, 1).ravel()[border]
    starts: dict[int, list[int]] = {}
    for k, vertex in enumerate(half[:, 0].tolist()):
        starts.setdefault(vertex, []).append(k)
    following: list[int | None] = []
    for k, vertex in enumerate(half[:, 1].tolist()):
        choices = starts.get(vertex, [])
        if len(choices) == 2:  # a hole's boundary arrives on one of the two fans and leaves on the other
            choices = [on for on in choices if leaving[on] != arriving[k]]
        following.append(choices[0] if len(choices) == 1 else None)  # where more holes meet, the way is ambiguous
    new_points: list[np.ndarray] = []
    new_faces: list[list[int]] = []
    seen: set[int] = set()
    for start in range(len(half)):
        loop: list[int] = []
        half_edge: int | None = start
        while half_edge is not None and half_edge not in seen and len(loop) <= longest:
            seen.add(half_edge)
            loop.append(int(half[half_edge, 0]))
            half_edge = following[half_edge]
        if half_edge != start or len(loop) % 2 or not 4 <= len(loop) <= longest or len(set(loop)) < len(loop):
            continue
        loop = loop[::-1]  # the new faces traverse the edges in the opposite direction
        if len(loop) == 4:
            new_faces.append(loop)
            continue
        centre = len(vertices) + len(new_points)
        new_points.append(vertices[loop].mean(0))
        new_faces.extend([centre, loop[i - 1], loop[i], loop[(i + 1) % len(loop)]] for i in range(0, len(loop), 2))
    if not new_faces:
        return mesh
    return QuadMesh(
        np.concatenate([vertices, *(p[None] for p in new_points)]),
        np.concatenate([faces, np.array(new_faces, faces.dtype)]),
    )


def remove_doublets(mesh: QuadMesh) -> QuadMesh:
    """Remove inner vertices with two edges and join their two quads (Daniels et al. 2008, doublet collapse)."""
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(_DOUBLET_ROUNDS):
        valence, inner = valences(faces, len(vertices))
        doublets = np.flatnonzero(inner & (valence == 2))
        if not len(doublets):
            break
        ring = faces_around_vertices(faces, len(vertices))
        dead = np.zeros(len(faces), bool)
        faces = faces.copy()
        touched: set[int] = set()
        for v in doublets.tolist():
            pair = ring[v]
            if len(pair) != 2 or set(faces[pair].ravel().tolist()) & touched:
                continue
            first, second = faces[pair[0]].tolist(), faces[pair[1]].tolist()
            opposite = first[(first.index(v) + 2) % 4], second[(second.index(v) + 2) % 4]
            if opposite[0] == opposite[1]:
                continue
            touched.update(first, second)
            faces[pair[0], first.index(v)] = opposite[1]
            dead[pair[1]] = True
        if not dead.any():
            break
        faces = faces[~dead]
    return compact(QuadMesh(vertices, faces))
