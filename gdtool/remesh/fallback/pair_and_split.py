"""Quads without an engine, by a construction that cannot fail: even triangles, joined in pairs, every face cut in
quads.

Quads (split_count(faces, quads), 4) of any triangle mesh, in one way or the other: no piece is lost, closed and
manifold where the triangles are. vertices (v, 3) in a unit box, faces (f, 3); seconds and memory_mb: limits of each run
in a child, whose failure costs evenness alone; meanwhile: called while one works."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gdtool.core.child import ChildFailed, call
from gdtool.core.native import imported
from gdtool.geometry.normals import face_normals
from gdtool.geometry.simplify import simplify
from gdtool.geometry.topology import compact, components, edges_of, handles, invariants, is_manifold
from gdtool.remesh.fit.surface_projection import subdivide
from gdtool.remesh.task import QUADS_OF_A_PIECE

_QUADS_PER_TRIANGLE = 2.25  # of pair_and_split, where most triangles find a partner
_EVEN_COUNT = 0.03  # even_triangles come so near to the number asked for
_FOR_A_HANDLE, _FOR_A_PIECE = 80, 12  # triangles: of fewer, even ones lose some handles or pieces
_NEARER = 0.5  # each length tried brings the logarithm of their number so much nearer, where it can be had
_TRIES = 3
_APART = 1e-6  # of the size, between vertices that coincide


def split_count(faces: np.ndarray, quads: int) -> int:
    """How many quads are made where so many are asked for: enough for every piece."""
    return max(quads, QUADS_OF_A_PIECE * components(faces)[0])


def few_for_even(faces: np.ndarray, quads: int) -> bool:
    """Whether so many quads would be of too few even triangles to keep all pieces and handles."""
    triangles, pieces = quads / _QUADS_PER_TRIANGLE, components(faces)[0]
    return triangles < _FOR_A_PIECE * pieces or triangles < _FOR_A_HANDLE * handles(faces, pieces)


def of_even(
    vertices: np.ndarray,
    faces: np.ndarray,
    quads: int,
    crease_degrees: float,
    seconds: float,
    memory_mb: int,
    meanwhile: Callable[[], object] = lambda: None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Quads of even triangles of the same topology, creases sharper than crease_degrees kept; None where there are none
    that split into so many, as on what is small and intricate."""
    triangles = int(quads / _QUADS_PER_TRIANGLE)
    few_vertices, few = simplify(
        vertices, faces, 2 * triangles, seconds=seconds, careful=True, measured=False, meanwhile=meanwhile
    )[:2]
    try:
        out, found = call(
            even_triangles, few_vertices, few, triangles, crease_degrees, seconds=seconds, memory_mb=memory_mb
        )
    except ChildFailed:
        return None
    if not 2.1 * len(found) <= quads <= 3 * len(found):
        return None
    out, found = compact(out, found)
    return (
        pair_and_split(out, found, quads) if invariants(found) == invariants(faces) and np.isfinite(out).all() else None
    )


def even_triangles(
    vertices: np.ndarray, faces: np.ndarray, triangles: int, crease_degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of even size and shape, about as many as asked: MeshLab's isotropic remeshing (Botsch & Kobbelt 2004,
    "A remeshing approach to multiresolution modeling"). Creases sharper than crease_degrees stay, a tenth of an edge is
    the farthest that the surface moves. Unchecked."""
    pymeshlab = imported("pymeshlab")
    # MeshLab joins vertices that coincide, which closes slits and leaves edges of four faces.
    apart = np.random.default_rng(0).uniform(-1, 1, vertices.shape) * _APART * np.ptp(vertices, 0).max()
    own = np.ascontiguousarray(vertices + apart, np.float64), np.ascontiguousarray(faces, np.int32)
    edge, found, off = (4 / 3**0.5 * face_normals(vertices, faces)[1].sum() / triangles) ** 0.5, faces, np.inf
    for _ in range(4):
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(*own))
        meshes.meshing_isotropic_explicit_remeshing(
            iterations=10,
            targetlen=pymeshlab.PureValue(edge),
            featuredeg=crease_degrees or 180.0,
            checksurfdist=True,
            maxsurfdist=pymeshlab.PureValue(edge / 10),
        )
        mesh = meshes.current_mesh()
        vertices, found = np.asarray(mesh.vertex_matrix()), np.asarray(mesh.face_matrix(), np.int64)
        if abs(len(found) / triangles - 1) < _EVEN_COUNT or not len(found) or invariants(found) != invariants(faces):
            break  # what one length tears, another tears as well
        before, off = off, abs(np.log(len(found) / triangles))
        if off > _NEARER * before:
            break  # so few are not to be had: its creases take more
        edge *= (len(found) / triangles) ** 0.7  # along creases they follow the edge itself
    return vertices, found


def of_own(
    vertices: np.ndarray, faces: np.ndarray, quads: int, seconds: float, meanwhile: Callable[[], object] = lambda: None
) -> tuple[np.ndarray, np.ndarray]:
    """Quads of the mesh's own triangles, cut in four or collapsed to the right number."""
    igl = imported("igl")
    triangles = max(int(quads / _QUADS_PER_TRIANGLE), 4)
    while len(faces) < triangles:
        vertices, faces = (
            np.asarray(x)
            for x in igl.upsample(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64), 1)
        )
    best = None
    for _ in range(_TRIES):
        found = pair_and_split(*_collapsed(vertices, faces, triangles, seconds, meanwhile), quads)
        if best is None or abs(len(found[1]) - quads) < abs(len(best[1]) - quads):
            best = found
        if abs(len(found[1]) / quads - 1) < _EVEN_COUNT:
            break
        # Where they bend too much for pairs there are more quads.
        triangles = max(int(triangles * quads / len(found[1])), 4)
    return best


def _collapsed(
    vertices: np.ndarray, faces: np.ndarray, triangles: int, seconds: float, meanwhile: Callable[[], object]
) -> tuple[np.ndarray, np.ndarray]:
    """So many triangles, or a few more: a collapse that loses pieces is tried again more gently before the mesh is
    taken as it is."""
    pieces = components(faces)[0]
    for factor in (1.0, 1.15, 1.3, 1.6, 2.0, 4.0):
        if factor * triangles >= len(faces):
            break
        out, out_faces, _, _ = simplify(
            vertices, faces, int(factor * triangles), seconds=seconds, careful=True, measured=False, meanwhile=meanwhile
        )
        if components(out_faces)[0] == pieces and is_manifold(out_faces) >= is_manifold(faces):
            return out, out_faces
    return vertices, faces


def pair_and_split(vertices: np.ndarray, faces: np.ndarray, quads: int) -> tuple[np.ndarray, np.ndarray]:
    """Quads without any engine: triangles joined in pairs, best first, then every face cut into one quad per corner.

    About quads / 2.2 triangles give exactly `quads` quads. Closed and manifold exactly where the triangles are.
    """
    edges = edges_of(faces)
    edge_idx, pairs = edges.face_pairs()
    ends = edges.ends[edge_idx]
    tips = faces[pairs].sum(2) - ends.sum(1)[:, None]
    corners = np.stack([ends[:, 0], tips[:, 0], ends[:, 1], tips[:, 1]], -1)
    p = vertices[corners]
    after, before = np.roll(p, -1, 1) - p, np.roll(p, 1, 1) - p
    length = np.maximum(np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1), 1e-300)
    cosine = np.abs((after * before).sum(-1) / length).max(1)
    a, b = (
        np.cross(
            vertices[faces[pairs[:, i], 1]] - vertices[faces[pairs[:, i], 0]],
            vertices[faces[pairs[:, i], 2]] - vertices[faces[pairs[:, i], 0]],
        )
        for i in range(2)
    )
    bend = (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-300)
    usable = (bend > 0.5) & ~edges.turned[edge_idx] & (tips[:, 0] != tips[:, 1])
    # Each pair spares two quads: three a triangle apart, four together.
    wanted = max((3 * len(faces) - quads + 1) // 2, 0)
    single = np.ones(len(faces), bool)
    chosen = []
    for i in np.flatnonzero(usable)[np.argsort(cosine[usable] + (1 - bend[usable]), kind="stable")].tolist():
        if len(chosen) >= wanted:
            break
        f, g = pairs[i]
        if single[f] and single[g]:
            single[f] = single[g] = False
            chosen.append(i)
    chosen = np.array(chosen, np.int64)
    mixed = np.full((int(single.sum()) + len(chosen), 4), -1, np.int64)
    mixed[: int(single.sum()), :3] = faces[single]
    if len(chosen):
        first = faces[pairs[chosen, 0]]
        # The first triangle with its tip in front: tip, one end, the other triangle's tip, the other end.
        turn = np.argmax(first == tips[chosen, 0][:, None], 1)
        row = np.arange(len(chosen))
        mixed[int(single.sum()) :] = np.stack(
            [tips[chosen, 0], first[row, (turn + 1) % 3], tips[chosen, 1], first[row, (turn + 2) % 3]], -1
        )
    out, found, _ = subdivide(vertices, mixed)
    return out, found
