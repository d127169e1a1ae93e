"""What makes quads out of triangles: engines that run in a killable child, and a construction that cannot fail.

Every engine takes vertices (v, 3) in a unit box and faces (f, 3) and returns vertices and quads (q, 4), unchecked.
"""

from __future__ import annotations

import numpy as np

from gdtool.geometry.normals import face_normals
from gdtool.geometry.quad_shape import subdivide
from gdtool.geometry.repair import compact, components, edges_of, is_manifold, is_watertight

_FACES_PER_QUAD = 4
_EVEN_COUNT = 0.03
_APART = 1e-6


def run_on_few(vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Instant Meshes on a mesh collapsed to what its quads can show, where that keeps the topology: half the time.

    It cuts long edges itself, so its cost follows the vertices that it is given more than those that it makes.
    """
    from gdtool.geometry.simplify import collapse

    if len(faces) > _FACES_PER_QUAD * quads:
        few_vertices, few = compact(*collapse(vertices, faces, _FACES_PER_QUAD * quads, 5.0))
        if _topology(few) == _topology(faces):
            vertices, faces = few_vertices, few
    return run_instant_meshes(vertices, faces, quads, crease_degrees)


def _topology(faces: np.ndarray) -> tuple[bool, bool, int, int]:
    """Watertight, manifold, pieces, Euler number."""
    return is_watertight(faces), is_manifold(faces), components(faces)[0], int(faces.max()) + 1 - len(edges_of(faces).ends) + len(faces)


def run_instant_meshes(vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Instant Meshes (Jakob et al. 2015): a quarter as many mixed faces, then one regular subdivision to pure quads.

    Its deterministic mode, so that equal input gives equal files. Intrinsic smoothing leaves a tenth fewer irregular
    vertices, but its quads keep to creases less well.
    """
    import pynanoinstantmeshes

    out, found = pynanoinstantmeshes.remesh(
        np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.uint32), vertex_count=max(quads // 4, 4), rosy=4, posy=4,
        creaseAngle=float(crease_degrees), align_to_boundaries=bool((edges_of(faces).count == 1).any()), extrinsic=True,
        smooth_iter=0, deterministic=True)
    return np.asarray(out, np.float64), np.asarray(found, np.int64)


def run_quadriflow(vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """QuadriFlow (Huang et al. 2018) through pyQuadriFlow, an optional package. It ends the process on non-manifold input."""
    from pyQuadriFlow import pyQuadriFlow

    found = pyQuadriFlow.pyquadriflow(int(quads), 0, np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32),
                                      crease_degrees > 0, False, False, False, False)
    return np.asarray(found["vertices"], np.float64), np.asarray(found["faces"], np.int64)


def even_triangles(vertices: np.ndarray, faces: np.ndarray, triangles: int, crease_degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of even size and shape, about as many as asked: MeshLab's isotropic remeshing (Botsch & Kobbelt 2004, "A
    remeshing approach to multiresolution modeling"). Creases sharper than crease_degrees stay, a tenth of an edge is the
    farthest that the surface moves. Unchecked."""
    import pymeshlab

    # MeshLab joins vertices that coincide, which closes slits and leaves edges of four faces.
    apart = np.random.default_rng(0).uniform(-1, 1, vertices.shape) * _APART * np.ptp(vertices, 0).max()
    own = np.ascontiguousarray(vertices + apart, np.float64), np.ascontiguousarray(faces, np.int32)
    edge, found = (4 / 3**0.5 * face_normals(vertices, faces)[1].sum() / triangles) ** 0.5, faces
    for _ in range(4):
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(*own))
        meshes.meshing_isotropic_explicit_remeshing(
            iterations=10, targetlen=pymeshlab.PureValue(edge), featuredeg=crease_degrees or 180.0, checksurfdist=True,
            maxsurfdist=pymeshlab.PureValue(edge / 10))
        mesh = meshes.current_mesh()
        vertices, found = np.asarray(mesh.vertex_matrix()), np.asarray(mesh.face_matrix(), np.int64)
        if abs(len(found) / triangles - 1) < _EVEN_COUNT or not len(found):
            break
        edge *= (len(found) / triangles) ** 0.7  # along creases they follow the edge itself
    return vertices, found


ENGINES = {"instant-meshes": "gdtool.geometry.quad_engines:run_instant_meshes", "on few": "gdtool.geometry.quad_engines:run_on_few",
           "quadriflow": "gdtool.geometry.quad_engines:run_quadriflow"}


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
    a, b = (np.cross(vertices[faces[pairs[:, i], 1]] - vertices[faces[pairs[:, i], 0]],
                     vertices[faces[pairs[:, i], 2]] - vertices[faces[pairs[:, i], 0]]) for i in range(2))
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
    mixed[:int(single.sum()), :3] = faces[single]
    if len(chosen):
        first = faces[pairs[chosen, 0]]
        # The first triangle with its tip in front: tip, one end, the other triangle's tip, the other end.
        turn = np.argmax(first == tips[chosen, 0][:, None], 1)
        row = np.arange(len(chosen))
        mixed[int(single.sum()):] = np.stack([tips[chosen, 0], first[row, (turn + 1) % 3], tips[chosen, 1], first[row, (turn + 2) % 3]], -1)
    out, found, _ = subdivide(vertices, mixed)
    return out, found
