"""Move the extracted mesh onto the measured planes and smooth its unseen parts: the second half of the grid method."""

from __future__ import annotations

import numpy as np

from gdtool.fields.appearance.materials import neighbour_matrix
from gdtool.fields.views.prepared_view import WEAK, PreparedView, hull_distance, tangent_distance
from gdtool.geometry.grids import components, keep_faces, signed_volume
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals, vertex_normals
from gdtool.geometry.topology import edges_of

WAVELENGTH = 36.0  # grid steps: shorter bumps are removed where the normals show none
FOLD_DEGREES = 150.0  # least angle between the normals of a fold's sides
# refine(): rounds in which the planes are looked up anew, weight of bending beside a fully seen vertex's planes, and
# steps of conjugate gradients.
REFINE_ROUNDS, REFINE_SMOOTHNESS, REFINE_ITERATIONS = 2, 0.2, 40
# fit_to_normals(): likewise; the system is worse conditioned, so that it takes more steps.
NORMAL_ROUNDS, NORMAL_BENDING, NORMAL_ITERATIONS = 3, 1.0, 300
_SEEN_FACES = 24  # measured faces that make a piece real
_HOLLOW_FACES = 12  # measured faces that make a hollow real; views see little of it through its mouth


def measured_planes(views: list[PreparedView], vertices: np.ndarray, normals: np.ndarray, reach: float):
    """Compute each vertex's quadratic data term sum w (n·u + s)^2: matrix (v, 3, 3), vector (v, 3) and sum w (v,).

    Planes farther than reach (world units) or turned away from the vertex's normal belong to another surface.
    """
    matrix = np.zeros((len(vertices), 3, 3), np.float32)
    vector = np.zeros((len(vertices), 3), np.float32)
    total = np.zeros(len(vertices), np.float32)
    for view in views:
        if view.planes is None:
            continue
        distance, weight, normal, _ = tangent_distance(view, vertices)
        same = (np.abs(distance) < reach) & (weight > WEAK) & ((normal * normals).sum(1) > 0.5)
        weight = np.where(same, weight, 0.0).astype(np.float32)
        distance = np.where(same, distance, 0.0).astype(np.float32)
        matrix += (weight[:, None] * normal)[:, :, None] * normal[:, None, :]
        vector -= (weight * distance)[:, None] * normal
        total += weight
    return matrix, vector, total


def refine(
    mesh: TriMesh,
    views: list[PreparedView],
    step: float,
    *,
    reach: float,
) -> np.ndarray:
    """Fit vertices to the measured planes of the views, by least squares with the umbrella Laplacian; return (v, 3).

    Seen vertices follow the planes. Unseen ones minimise bending, held close to where carving put them and inside the
    silhouettes.
    """
    vertices, faces = mesh.vertices, mesh.faces
    from scipy.sparse import diags

    umbrella, start = _umbrella(faces, len(vertices)), vertices
    for _ in range(REFINE_ROUNDS):
        matrix, vector, total = measured_planes(views, vertices, vertex_normals(TriMesh(vertices, faces)), reach)
        unseen = np.exp(-10.0 * total)
        bending = diags((REFINE_SMOOTHNESS + unseen).astype(np.float32))
        energy = (umbrella.T @ bending @ umbrella).tocsr().astype(np.float32)
        hold = (0.003 + 0.2 * unseen)[:, None].astype(np.float32)

        def apply(u, matrix=matrix, energy=energy, hold=hold):
            """Multiply moves u (v, 3) by the system's matrix."""
            return np.einsum("vij,vj->vi", matrix, u) + energy @ u + hold * u

        right = vector - energy @ vertices.astype(np.float32) + hold * (start - vertices).astype(np.float32)
        diagonal = np.einsum("vii->vi", matrix) + energy.diagonal()[:, None] + hold
        move = conjugate_gradients(apply, right, diagonal, REFINE_ITERATIONS)
        length = np.linalg.norm(move, axis=1, keepdims=True)
        vertices = vertices + move * np.minimum(1.0, step / np.maximum(length, 1e-12))
    return _undo_folds(_inside_silhouettes(vertices, start, views, 0.25 * step), start, faces)


def fit_to_normals(
    mesh: TriMesh,
    views: list[PreparedView],
    step: float,
    *,
    reach: float,
) -> np.ndarray:
    """Fit the edges of a surface fused from disagreeing views to the views' normals; return vertices (v, 3).

    Depths that differ a little from view to view leave bumps, which are low and steep; the normals show none. Every
    vertex moves along its normal, so that edges come to lie across the measured normals, and is held where it was
    (Nehab et al., "Efficiently Combining Positions and Normals for Precise 3D Geometry", 2005). Bumps shorter than
    about WAVELENGTH go. Unseen vertices move along with their neighbours. reach: how far off a view's surface may be
    (world units).
    """
    vertices, faces = mesh.vertices, mesh.faces
    from scipy.sparse import csr_array, diags_array

    start, ends = vertices, edges_of(faces).ends
    a, b = ends.T
    hold = 2 * (2 * np.pi / WAVELENGTH) ** 2
    umbrella = _umbrella(faces, len(vertices))

    def differences(at_a: np.ndarray, at_b: np.ndarray) -> csr_array:
        """Matrix (e, v) of at_a (e,) times the value at an edge's one end less at_b (e,) times that at the other."""
        return csr_array(
            (np.stack([at_a, -at_b], 1).ravel(), ends.ravel(), np.arange(0, 2 * len(ends) + 1, 2)),
            (len(ends), len(vertices)),
        )

    for _ in range(NORMAL_ROUNDS):
        surface = vertex_normals(TriMesh(vertices, faces))
        measured, trust = measured_normals(views, vertices, surface, reach)
        across = measured[a] + measured[b]
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        along = vertices[a] - vertices[b]
        stiff = 1 / np.maximum(np.linalg.norm(along, axis=1) / step, 0.1)
        known = stiff * np.minimum(trust[a], trust[b])
        slant = differences(np.einsum("ei,ei->e", across, surface[a]), np.einsum("ei,ei->e", across, surface[b]))
        level = differences(np.ones(len(ends)), np.ones(len(ends)))
        matrix = (
            slant.T @ diags_array(known) @ slant
            + level.T @ diags_array(stiff - known) @ level
            + NORMAL_BENDING * umbrella.T @ umbrella
        )
        right = (
            -slant.T @ (known * np.einsum("ei,ei->e", across, along))
            - NORMAL_BENDING * umbrella.T @ np.einsum("vi,vi->v", surface, umbrella @ vertices)
            - hold * np.einsum("vi,vi->v", surface, vertices - start)
        )
        move = conjugate_gradients(
            lambda u, matrix=matrix: matrix @ u + hold * u,
            right[:, None],
            (matrix.diagonal() + hold)[:, None],
            NORMAL_ITERATIONS,
        )
        vertices = vertices + np.clip(move, -step, step) * surface
    return _undo_folds(_inside_silhouettes(vertices, start, views, 0.25 * step), start, faces)


def measured_normals(
    views: list[PreparedView], vertices: np.ndarray, normals: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Average the views' normals at vertices: unit normals (v, 3) and their trust (v,) in 0..1, 0 where no view has
    one.

    normals (v, 3): of the surface. A view's surface farther than reach (world units) away, or turned away from them, is
    another surface.
    """
    total = np.zeros((len(vertices), 3))
    for view in views:
        if view.planes is None:
            continue
        distance, weight, normal, _ = tangent_distance(view, vertices)
        same = (np.abs(distance) < reach) & (weight > WEAK) & ((normal * normals).sum(1) > 0.3)
        total += np.where(same, weight, 0.0)[:, None] * normal
    length = np.linalg.norm(total, axis=1)
    return total / np.maximum(length, 1e-12)[:, None], np.clip(length / 0.1, 0, 1)


def normal_deviation_degrees(mesh: TriMesh, views: list[PreparedView], reach: float) -> float:
    """Measure the median degrees between a surface's normals and the views' normals there; 0 where there are none."""
    vertices = mesh.vertices
    surface = vertex_normals(mesh)
    measured, trust = measured_normals(views, vertices, surface, reach)
    cosine = np.einsum("vi,vi->v", measured, surface)[trust > 0.5]
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))) if len(cosine) else 0.0


def _umbrella(faces: np.ndarray, count: int):
    """Sparse (count, count): a vertex less the mean of its neighbours."""
    from scipy.sparse import diags, identity

    graph = neighbour_matrix(faces, count)
    degree = np.asarray(graph.sum(1)).ravel()
    return (identity(count, format="csr", dtype=np.float32) - diags(1 / np.maximum(degree, 1)) @ graph).tocsr()


def conjugate_gradients(apply, right: np.ndarray, diagonal: np.ndarray, iterations: int) -> np.ndarray:
    """Jacobi-preconditioned conjugate gradients from zero, for a symmetric positive operator on (v, 3) arrays."""
    x = np.zeros_like(right)
    r = right.copy()
    z = r / diagonal
    p, rz = z, float((r * z).sum())
    first = rz
    for _ in range(iterations):
        if rz <= 1e-8 * first:
            break
        q = apply(p)
        step = rz / float((p * q).sum())
        x += step * p
        r -= step * q
        z = r / diagonal
        rz, before = float((r * z).sum()), rz
        p = z + rz / before * p
    return x


def _inside_silhouettes(vertices: np.ndarray, start: np.ndarray, views: list[PreparedView], slack: float) -> np.ndarray:
    """Move vertices that left a silhouette by more than slack, and farther than at the start, back along their way."""
    share = np.ones(len(vertices))
    for view in views:
        before, after = hull_distance(view, start), hull_distance(view, vertices)
        limit = np.maximum(before, 0) + slack
        left = np.flatnonzero(after > limit)
        # Of one that began beyond the border of a picture that cuts the object no way is known: all of it.
        known = np.isfinite(before[left])
        begun = np.where(known, before[left], 0.0)
        share[left] = np.minimum(share[left], known * (limit[left] - begun) / (after[left] - begun))
    return start + share[:, None] * (vertices - start)


def _undo_folds(vertices: np.ndarray, start: np.ndarray, faces: np.ndarray, rounds: int = 8) -> np.ndarray:
    """Move vertices of faces that turned over or folded onto a neighbour back half of their way, until no such face is
    left.

    The vertices around them go back less.
    """
    before, _ = face_normals(TriMesh(start, faces))
    beside = edges_of(faces).face_pairs()[1]
    folded_before = _folded(before, beside)
    share = np.ones(len(vertices))
    moved = vertices
    for _ in range(rounds):
        after, _ = face_normals(TriMesh(vertices, faces))
        turned = (before * after).sum(1) < 0
        turned[beside[_folded(after, beside) & ~folded_before]] = True
        if not turned.any():
            break
        less = np.ones(len(vertices))
        for factor in (0.5, 0.7, 0.85):  # ring by ring
            around = faces[turned].ravel()
            less[around] = np.minimum(less[around], factor)
            turned = (less[faces] < 1).any(1)
        share *= less
        vertices = start + share[:, None] * (moved - start)
    return vertices


def _folded(normals: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """Tell which pairs of neighbouring faces (k, 2) lie back to back."""
    return np.einsum("ij,ij->i", normals[beside[:, 0]], normals[beside[:, 1]]) < np.cos(np.radians(FOLD_DEGREES))


def drop_debris(mesh: TriMesh, support: np.ndarray, step: float, hollows: bool = False) -> tuple[TriMesh, int]:
    """Remove bubbles, tiny pieces and pieces without support (v,) from views; also returns the number removed.

    The largest piece always stays. hollows: keep an inner wall that views saw. Use it for views that agree only: others
    see through walls.
    """
    labels, volume = _pieces(mesh)
    held = np.bincount(labels, support[mesh.faces].mean(1) > 0.02)
    # Of a plate seen edge-on only the rim has support: a few faces say that it is there.
    seen = np.where(
        volume > 0, (held > 0.2 * np.bincount(labels)) | (held >= _SEEN_FACES), hollows & (held >= _HOLLOW_FACES)
    )
    keep = (np.abs(volume) > (2 * step) ** 3) & seen
    keep[np.argmax(volume)] = True
    return keep_faces(mesh, keep[labels]), int((~keep).sum())


def keep_pieces(mesh: TriMesh, step: float, share: float = 0.01) -> TriMesh:
    """Keep the pieces with more than `share` of the largest one's volume; bubbles go."""
    labels, volume = _pieces(mesh)
    return keep_faces(mesh, (volume > max(share * volume.max(), (2 * step) ** 3))[labels])


def _pieces(mesh: TriMesh) -> tuple[np.ndarray, np.ndarray]:
    """Label the connected piece of each face (f,) and compute each piece's signed volume."""
    vertices, faces = mesh.vertices, mesh.faces
    labels = components(faces, len(vertices))
    order = np.argsort(labels, kind="stable")
    bounds = np.searchsorted(labels[order], np.arange(int(labels.max()) + 2))
    return labels, np.array(
        [signed_volume(TriMesh(vertices, faces[order[a:b]])) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    )
