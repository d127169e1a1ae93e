"""Tips and rims that quads leave bare, drawn out of them: what is thinner than a quad an engine cuts short."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gdtool.geometry.distance import closest_points, sample_surface
from gdtool.geometry.topology import components, edges_of, euler_number, triangulated
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.surface_projection import Surface

# Edge lengths from the quads: what belongs to a tip, what is near enough, what makes one.
_BARE, _CLOSE, _STRAYS = 0.5, 0.75, 1.0
_TIP = 1.5  # edge lengths that a tip measures at most which one vertex reaches
_STEP = 1.5  # edge lengths that a tip is drawn out at once
_HELD = 0.75  # of the farthest that a vertex moves: those that move so far stay there
_CROWDED = 0.75  # edge lengths from one that stays: others do not, for what lies between them would have no room
_MOST_STEPS = 24
_POINTS = 20000


def draw_out(
    vertices: np.ndarray,
    faces: np.ndarray,
    constraints: Constraints,
    surface: Surface,
    edge: float,
    most_added: float = 0.03,
) -> tuple[np.ndarray, np.ndarray, Constraints, np.ndarray, float, np.ndarray]:
    """Quads (f, 4) of mean edge length `edge` extruded over what of the surface strays from them, farthest first.

    The vertices (v, 3) nearest to a tip move along it, an edge or two at a time, with the quads around them, and a ring
    of new quads follows each step, as one would model a horn by hand, until most_added of the quads are new: what needs
    more is no matter of tips. A tip that is nearer than an edge takes one vertex and no ring. Closed and manifold as
    before, of as many pieces and handles. Returns vertices, faces, constraints, in which the tips are fixed, the tips'
    vertices (t,), how far the surface was from the quads at most before the last vertices moved, and how far samples
    (n,) spread over its area were."""
    step = max(len(surface.vertices) // _POINTS, 1)
    points = samples = np.concatenate(
        [
            surface.vertices[::step],
            sample_surface(surface.vertices, surface.faces, _POINTS // 2, np.random.default_rng(0))[0],
        ]
    )
    most, given = len(faces) * (1 + most_added), constraints
    triangles, face_idx = triangulated(faces)
    away, nearest, _ = closest_points(points, vertices, triangles)
    of_samples = away, face_idx[nearest]
    for turn in range(_MOST_STEPS):
        if turn:
            triangles, face_idx = triangulated(faces)
            away, nearest = _nearest(points, away, vertices, triangles)
        bare = away > _BARE * edge  # all others will stay near
        points, away, nearest = points[bare], away[bare], nearest[bare]
        if not len(points) or not turn and away.max() < _STRAYS * edge:
            break
        alive = np.ones(len(points), bool)
        for tip in _apart(points, away, edge):
            if away[tip].max() < _CLOSE * edge or len(faces) > most:
                break
            found = _extruded(
                vertices, faces, constraints, points[tip], face_idx[nearest[tip]], away[tip], surface, edge
            )
            if found is None:
                alive[tip] = False
            else:
                vertices, faces, constraints = found
                of_samples = None
        points, away = points[alive], away[alive]
        if not len(points) or len(faces) > most or away.max() < _CLOSE * edge:
            break
    if of_samples is None:
        triangles, face_idx = triangulated(faces)
        away, nearest, _ = closest_points(samples, vertices, triangles)
        of_samples = away, face_idx[nearest]
    vertices, constraints = _reached(vertices, faces, constraints, samples, *of_samples, edge)
    if constraints is not given:
        constraints = _still_paths(constraints, faces)
    before = np.concatenate([given.fixed, np.zeros(len(vertices) - len(given.fixed), bool)])
    return (
        vertices,
        faces,
        constraints,
        np.flatnonzero(constraints.fixed & ~before),
        float(of_samples[0].max()),
        of_samples[0][-(_POINTS // 2) :],
    )


def _reached(
    vertices: np.ndarray,
    faces: np.ndarray,
    constraints: Constraints,
    points: np.ndarray,
    away: np.ndarray,
    nearest: np.ndarray,
    edge: float,
) -> tuple[np.ndarray, Constraints]:
    """Tips that end less than an edge from the quads: the nearest vertex moves there and stays.

    points (n, 3) of the surface, how far each is `away` (n,), and the quad `nearest` (n,) to it.
    """
    bare = (away > _BARE * edge) & (away < _STRAYS * edge)
    points, quads, away = points[bare], nearest[bare], away[bare]
    if not len(points):
        return vertices, constraints
    ends = [tip[away[tip].argmax()] for tip in _apart(points, away, edge) if np.ptp(points[tip], 0).max() < _TIP * edge]
    corner = faces[quads[ends], np.linalg.norm(vertices[faces[quads[ends]]] - points[ends][:, None], axis=-1).argmin(1)]
    moved, first = np.unique(corner, return_index=True)  # the farthest comes first
    out = vertices.copy()
    out[moved] = points[ends][first]
    return out, _extended(constraints, len(vertices), moved, moved)


def _nearest(
    points: np.ndarray, away: np.ndarray, vertices: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How far points (n, 3) are from the triangles (t, 3), and the nearest of these, where most are about `away` (n,):
    of few points only what is as near is searched."""
    from scipy.spatial import cKDTree

    corners = vertices[triangles]
    reach = away.max()
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max()
    near = np.isfinite(cKDTree(points).query(vertices, distance_upper_bound=reach + longest)[0])
    few = np.flatnonzero(near[triangles].any(1))
    if len(few):
        found, nearest, _ = closest_points(points, vertices, triangles[few])
        if found.max() <= reach:
            return found, few[nearest]
    return closest_points(points, vertices, triangles)[:2]


def _apart(points: np.ndarray, away: np.ndarray, edge: float) -> list[np.ndarray]:
    """Indices of the points of each tip, those that hang together; the tip that is farthest away first."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(edge, output_type="ndarray")
    count, label = connected_components(
        coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(points),) * 2), False
    )
    tips = [np.flatnonzero(label == k) for k in range(count)]
    return sorted(tips, key=lambda tip: -away[tip].max())


def _extruded(
    vertices: np.ndarray,
    faces: np.ndarray,
    constraints: Constraints,
    points: np.ndarray,
    quads: np.ndarray,
    away: np.ndarray,
    surface: Surface,
    edge: float,
) -> tuple[np.ndarray, np.ndarray, Constraints] | None:
    """One tip drawn out: points (n, 3) of it, the quad (n,) nearest to each, and how far away (n,); None where no disc
    of quads lies under it."""
    corner = faces[quads, np.linalg.norm(vertices[faces[quads]] - points[:, None], axis=-1).argmin(1)]
    # The farthest point within a step of each vertex, or the nearest where all are farther.
    order = np.argsort(np.where(away <= _STEP * edge, -away, away), kind="stable")
    moving, first = np.unique(corner[order], return_index=True)
    target = points[order[first]]
    farthest = np.array([corner[order[0]]])
    for cap, aim in ((moving, target), (farthest, points[order[:1]])):
        patch = np.isin(faces, cap).any(1)
        loop = _border(faces, patch, cap)
        if loop is not None:
            break
    else:
        return None
    shift = np.zeros_like(vertices)
    shift[cap] = aim - vertices[cap]
    length = np.linalg.norm(shift[cap], axis=1)
    rings = max(round(length.max() / edge), 1)
    base = loop[:, 0]
    for vertex in base.tolist():
        near = np.intersect1d(faces[patch & (faces == vertex).any(1)], cap)
        shift[vertex] = shift[near].mean(0) if len(near) else 0
    share = np.arange(1, rings + 1)[:, None, None] / (rings + 1)
    new = surface.closest((vertices[base] + share * shift[base]).reshape(-1, 3))[2]
    ring = np.concatenate([base, len(vertices) + np.arange(len(new))]).reshape(rings + 1, -1)
    after = np.roll(ring, -1, 1)
    sides = np.stack([ring[:-1], after[:-1], after[1:], ring[1:]], -1).reshape(-1, 4)
    lifted = np.arange(len(vertices))
    lifted[base] = ring[-1]
    faces = np.concatenate([np.where(patch[:, None], lifted[faces], faces), sides])
    vertices = np.concatenate([vertices, new])
    vertices[cap] = aim
    held = [k for k in np.argsort(-length, kind="stable") if length[k] > _HELD * length.max()]
    return vertices, faces, _extended(constraints, len(vertices), cap, cap[_sparse(aim, held, _CROWDED * edge)])


def _sparse(points: np.ndarray, order: list[int], distance: float) -> list[int]:
    """Of the points (n, 3) in that order those that are farther than `distance` from all before them that are taken."""
    out: list[int] = []
    for k in order:
        if (np.linalg.norm(points[out] - points[k], axis=1) > distance).all():
            out.append(k)
    return out


def _border(faces: np.ndarray, patch: np.ndarray, cap: np.ndarray) -> np.ndarray | None:
    """The directed edges (n, 2) around a patch of the faces, in a row; None unless it is a disc that the vertices `cap`
    alone lie inside."""
    own = faces[patch]
    edges = edges_of(own)
    half = edges.half_ends[edges.count[edges.half_edge_idx] == 1]
    # Inner edges of two quads, a rim that no vertex lies on twice, one piece without handles.
    if (
        (edges.count > 2).any()
        or edges.turned.any()
        or len(np.unique(half[:, 0])) < len(half)
        or np.isin(half, cap).any()
    ):
        return None
    if components(own)[0] != 1 or euler_number(own) != 1 or len(np.unique(own)) != len(half) + len(cap):
        return None
    following = dict(half.tolist())
    loop = [int(half[0, 0])]
    while (on := following[loop[-1]]) != loop[0]:
        loop.append(on)
        if len(loop) > len(half):
            return None
    return np.stack([loop, np.roll(loop, -1)], -1) if len(loop) == len(half) else None


def _extended(constraints: Constraints, count: int, moved: np.ndarray, fixed: np.ndarray) -> Constraints:
    """The constraints for so many vertices, without what held those that moved, their paths as they were; `fixed` hold
    still."""
    curve, still = np.full(count, -1), np.zeros(count, bool)
    curve[: len(constraints.curve)], still[: len(constraints.fixed)] = constraints.curve, constraints.fixed
    curve[moved], still[moved], still[fixed] = -1, False, True
    return replace(constraints, curve=curve, fixed=still)


def _still_paths(constraints: Constraints, faces: np.ndarray) -> Constraints:
    """Of the paths those edges that are still there, and still held at both ends."""
    ends, path, width = edges_of(faces).ends, np.sort(constraints.path, 1), len(constraints.curve) + 1
    kept = np.isin(path[:, 0] * width + path[:, 1], ends[:, 0] * width + ends[:, 1]) & (
        constraints.curve[path] >= 0
    ).all(1)
    return replace(constraints, path=constraints.path[kept], path_curve=constraints.path_curve[kept])
