"""Make quads without an engine, by a construction that cannot fail: pair triangles, then split every face into quads.

The result of any triangle mesh is (split_count(faces, quads), 4) quads, or about as many. No piece is lost; it is
closed and manifold where the triangles are.

Arguments in common: a mesh in a unit box; seconds and memory_mb limit each run in a child process; `meanwhile` is
called while a child works. If a child fails, the quads are only less uniform in size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gdtool.core.child import ChildFailed, call
from gdtool.core.native import imported
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.simplify import SimplifyOptions, simplify
from gdtool.geometry.topology import compact, components, edges_of, handles, invariants, is_manifold
from gdtool.remesh.fit.surface_projection import subdivide
from gdtool.remesh.limits import QUADS_OF_A_PIECE

_QUADS_PER_TRIANGLE = 2.25  # that pair_and_split makes, where most triangles find a partner
_COUNT_TOLERANCE = 0.03  # relative error of the number of triangles, or quads, at which no further try is made
# Isotropic triangles: with fewer, some handles or pieces are lost (benchmarks/remesh/nets.py).
_MIN_TRIANGLES_PER_HANDLE, _MIN_TRIANGLES_PER_PIECE = 80, 12
_MAX_LENGTHS = 4  # edge lengths tried for isotropic triangles
# A try must leave at most this share of the error of log(count); otherwise creases fix the count, and tries end.
_MAX_ERROR_LEFT = 0.5
_MAX_TRIES = 3  # numbers of triangles tried for quads_from_input
_SEPARATION = 1e-6  # of the mesh's size: noise that keeps coincident vertices apart
_MIN_PAIR_COSINE = 0.5  # between the normals of two triangles that may pair
_COLLAPSE_FACTORS = 1.0, 1.15, 1.3, 1.6, 2.0, 4.0  # times the wanted triangles, tried until no piece is lost


def split_count(faces: np.ndarray, quads: int) -> int:
    """Return the number of quads made when `quads` are requested: at least the fewest that the pieces need."""
    return max(quads, QUADS_OF_A_PIECE * components(faces)[0])


def too_few_for_isotropic(faces: np.ndarray, quads: int) -> bool:
    """Return whether isotropic triangles for this many quads are too few to keep all pieces and handles."""
    triangles, pieces = quads / _QUADS_PER_TRIANGLE, components(faces)[0]
    return triangles < _MIN_TRIANGLES_PER_PIECE * pieces or triangles < _MIN_TRIANGLES_PER_HANDLE * handles(
        faces, pieces
    )


def quads_from_isotropic(
    mesh: TriMesh,
    quads: int,
    crease_degrees: float,
    seconds: float,
    memory_mb: int,
    meanwhile: Callable[[], object] = lambda: None,
) -> QuadMesh | None:
    """Make quads from isotropic triangles of the same topology, keeping creases sharper than crease_degrees.

    Returns None where no such triangles split into this many quads, as on small intricate meshes.
    """
    triangles = int(quads / _QUADS_PER_TRIANGLE)
    simplified = simplify(mesh, 2 * triangles, options=_simplify_options(seconds, meanwhile)).mesh
    try:
        isotropic = call(
            isotropic_triangles, simplified, triangles, crease_degrees, seconds=seconds, memory_mb=memory_mb
        )
    except ChildFailed:
        return None
    if not 2.1 * len(isotropic.faces) <= quads <= 3 * len(isotropic.faces):
        return None
    isotropic = compact(isotropic)
    if invariants(isotropic.faces) != invariants(mesh.faces) or not np.isfinite(isotropic.vertices).all():
        return None
    return pair_and_split(isotropic, quads)


def _simplify_options(seconds: float, meanwhile: Callable[[], object]) -> SimplifyOptions:
    """Return the fallback's options for simplifying: keep the topology, do not measure the error."""
    return SimplifyOptions(seconds, topology_first=True, measure_error=False, while_waiting=meanwhile)


def isotropic_triangles(mesh: TriMesh, triangles: int, crease_degrees: float) -> TriMesh:
    """Remesh to about `triangles` triangles of equal size and shape; the result is not checked.

    MeshLab's isotropic remeshing (Botsch & Kobbelt 2004, "A remeshing approach to multiresolution modeling"). Creases
    sharper than crease_degrees stay. The surface moves by a tenth of an edge at most.
    """
    vertices, faces = mesh.vertices, mesh.faces
    pymeshlab = imported("pymeshlab")
    # MeshLab merges coincident vertices, which closes slits and leaves edges with four faces: noise keeps them apart.
    noise = np.random.default_rng(0).uniform(-1, 1, vertices.shape) * _SEPARATION * np.ptp(vertices, 0).max()
    mesh_input = np.ascontiguousarray(vertices + noise, np.float64), np.ascontiguousarray(faces, np.int32)
    edge, faces_out, error = (4 / 3**0.5 * mesh.area / triangles) ** 0.5, faces, np.inf
    for _ in range(_MAX_LENGTHS):
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(*mesh_input))
        meshes.meshing_isotropic_explicit_remeshing(
            iterations=10,
            targetlen=pymeshlab.PureValue(edge),
            featuredeg=crease_degrees or 180.0,
            checksurfdist=True,
            maxsurfdist=pymeshlab.PureValue(edge / 10),
        )
        result = meshes.current_mesh()
        vertices, faces_out = np.asarray(result.vertex_matrix()), np.asarray(result.face_matrix(), np.int64)
        if (
            abs(len(faces_out) / triangles - 1) < _COUNT_TOLERANCE
            or not len(faces_out)
            or invariants(faces_out) != invariants(faces)
        ):
            break  # where one length breaks the topology, another does too
        previous_error, error = error, abs(np.log(len(faces_out) / triangles))
        if error > _MAX_ERROR_LEFT * previous_error:
            break  # the creases alone need more triangles than this
        edge *= (len(faces_out) / triangles) ** 0.7  # not 0.5: along creases the count follows 1 / edge
    return TriMesh(vertices, faces_out)


def quads_from_input(
    mesh: TriMesh, quads: int, seconds: float, meanwhile: Callable[[], object] = lambda: None
) -> QuadMesh:
    """Make quads from the input's own triangles, subdivided or collapsed to the right number."""
    vertices, faces = mesh.vertices, mesh.faces
    igl = imported("igl")
    triangles = max(int(quads / _QUADS_PER_TRIANGLE), 4)
    while len(faces) < triangles:
        vertices, faces = (
            np.asarray(x)
            for x in igl.upsample(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64), 1)
        )
    best: QuadMesh | None = None
    for _ in range(_MAX_TRIES):
        made = pair_and_split(_collapsed(TriMesh(vertices, faces), triangles, seconds, meanwhile), quads)
        count = len(made.faces)
        if best is None or abs(count - quads) < abs(len(best.faces) - quads):
            best = made
        if abs(count / quads - 1) < _COUNT_TOLERANCE:
            break
        # Triangles that bend too much stay single and give more quads.
        triangles = max(int(triangles * quads / count), 4)
    assert best is not None  # there is at least one try
    return best


def _collapsed(mesh: TriMesh, triangles: int, seconds: float, meanwhile: Callable[[], object]) -> TriMesh:
    """Collapse to `triangles` triangles, or more where fewer would lose pieces.

    A collapse that loses pieces is repeated with more triangles. Where all lose some, the mesh is returned unchanged.
    """
    pieces = components(mesh.faces)[0]
    for factor in _COLLAPSE_FACTORS:
        if factor * triangles >= len(mesh.faces):
            break
        made = simplify(mesh, int(factor * triangles), options=_simplify_options(seconds, meanwhile)).mesh
        if components(made.faces)[0] == pieces and is_manifold(made.faces) >= is_manifold(mesh.faces):
            return made
    return mesh


def pair_and_split(mesh: TriMesh, quads: int) -> QuadMesh:
    """Join triangles in pairs, best first, then cut every face into one quad per corner.

    Each pair spares two quads, so about quads / 2.2 triangles give exactly `quads` quads. The result is closed and
    manifold exactly where the triangles are.
    """
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    edge_idx, pairs = edges.face_pairs()
    ends = edges.ends[edge_idx]
    tips = faces[pairs].sum(2) - ends.sum(1)[:, None]
    corners = np.stack([ends[:, 0], tips[:, 0], ends[:, 1], tips[:, 1]], -1)
    points = vertices[corners]
    after, before = np.roll(points, -1, 1) - points, np.roll(points, 1, 1) - points
    length = np.maximum(np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1), 1e-300)
    cosine = np.abs((after * before).sum(-1) / length).max(1)
    normal_a, normal_b = (
        np.cross(
            vertices[faces[pairs[:, i], 1]] - vertices[faces[pairs[:, i], 0]],
            vertices[faces[pairs[:, i], 2]] - vertices[faces[pairs[:, i], 0]],
        )
        for i in range(2)
    )
    bend = (normal_a * normal_b).sum(1) / np.maximum(
        np.linalg.norm(normal_a, axis=1) * np.linalg.norm(normal_b, axis=1), 1e-300
    )
    usable = (bend > _MIN_PAIR_COSINE) & ~edges.turned[edge_idx] & (tips[:, 0] != tips[:, 1])
    # Each pair spares two quads: two triangles give three each, a pair gives four.
    wanted_pairs = max((3 * len(faces) - quads + 1) // 2, 0)
    is_single = np.ones(len(faces), bool)
    chosen_pairs: list[int] = []
    for i in np.flatnonzero(usable)[np.argsort(cosine[usable] + (1 - bend[usable]), kind="stable")].tolist():
        if len(chosen_pairs) >= wanted_pairs:
            break
        f, g = pairs[i]
        if is_single[f] and is_single[g]:
            is_single[f] = is_single[g] = False
            chosen_pairs.append(i)
    chosen = np.array(chosen_pairs, np.int64)
    mixed = np.full((int(is_single.sum()) + len(chosen), 4), -1, np.int64)
    mixed[: int(is_single.sum()), :3] = faces[is_single]
    if len(chosen):
        first = faces[pairs[chosen, 0]]
        # Corner order: tip of the first triangle, shared end, tip of the second triangle, other shared end.
        turn = np.argmax(first == tips[chosen, 0][:, None], 1)
        row = np.arange(len(chosen))
        mixed[int(is_single.sum()) :] = np.stack(
            [tips[chosen, 0], first[row, (turn + 1) % 3], tips[chosen, 1], first[row, (turn + 2) % 3]], -1
        )
    return subdivide(QuadMesh(vertices, mixed))[0]
