"""Remesh a symmetric surface: remesh one half, reflect its quads, and join the two at the plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.sharpen import restore_creases
from gdtool.remesh.fit.feature_curves import Constraints, Features
from gdtool.remesh.fit.surface_projection import ProjectionTarget, fill_holes, remove_doublets
from gdtool.remesh.fit.untangle import untangle
from gdtool.remesh.pipeline import remesh
from gdtool.remesh.task import Record, Request

# Halves farther apart than these differ: quad edge lengths, and a share of the longest side.
_TOLERANCE_EDGES, _TOLERANCE_SIDE = 0.25, 0.004
_SNAP_EDGES = 1e-3  # edge lengths of the input: vertices nearer to the plane are put on it
_SEAM_EDGES = 1.0  # quad edge lengths: boundary vertices farther from the plane do not belong to the seam
_MIN_JACOBIAN = 0.25  # worst scaled Jacobian along the seam, below which its quads are untangled
_INSIDE_EDGES = 0.05  # quad edge lengths that vertices off the seam keep from the plane
AXES = "xyz"


def mirror_plane(mesh: TriMesh, quads: int, axes: str = AXES, limit: int = 8000) -> tuple[int | None, dict[str, float]]:
    """Find the axis (0, 1, 2) across whose plane through the origin the mesh is its own mirror image.

    mesh: in a unit box about the origin; quads: how many will be made; axes: those to try; limit: the most vertices to
    measure. Returns the best axis, or None where no axis mirrors the mesh closely enough. Also returns for each axis
    the largest distance from a reflected vertex to the surface. Differences finer than a quarter of a quad do not
    count.
    """
    edge = (mesh.area / quads) ** 0.5
    surface = ProjectionTarget(mesh)
    points = mesh.vertices[np.unique(mesh.faces)]
    points = points[:: max(len(points) // limit, 1)]
    distances = {
        AXES[i]: float(surface.closest(points * np.where(np.arange(3) == i, -1.0, 1.0))[0].max())
        for i in range(3)
        if AXES[i] in axes
    }
    best = min(distances, key=distances.__getitem__)
    return (AXES.index(best) if distances[best] <= min(_TOLERANCE_EDGES * edge, _TOLERANCE_SIDE) else None), distances


def half_mesh(mesh: TriMesh, axis: int) -> TriMesh:
    """Cut a triangle mesh at the plane through the origin and return the half where coordinate `axis` is not negative.

    The half is open along the plane.
    """
    vertices, faces = mesh.vertices, mesh.faces
    extents = np.ptp(vertices[faces], axis=1).max(1)
    vertices = vertices.copy()
    vertices[np.abs(vertices[:, axis]) < _SNAP_EDGES * np.median(extents), axis] = 0.0
    sign = np.sign(vertices[:, axis]).astype(np.int64)
    lowest, highest = sign[faces].min(1), sign[faces].max(1)
    whole, split = faces[(lowest >= 0) & (highest > 0)], faces[(lowest < 0) & (highest > 0)]
    if not len(split):
        return topology.compact(TriMesh(vertices, whole))
    # In order around each cut face: its corners on this side, and where its edges cross the plane.
    following = np.roll(split, -1, 1)
    crosses = sign[split] * sign[following] < 0
    ends = np.sort(np.stack([split[crosses], following[crosses]], -1), 1)
    ends, which = np.unique(ends, axis=0, return_inverse=True)
    low, high = vertices[ends[:, 0]], vertices[ends[:, 1]]
    share = (low[:, axis] / (low[:, axis] - high[:, axis]))[:, None]
    added = low + share * (high - low)
    added[:, axis] = 0.0
    crossing = np.full(split.shape, -1, np.int64)
    crossing[crosses] = len(vertices) + which.ravel()
    ring = np.stack([np.where(sign[split] >= 0, split, -1), crossing], -1).reshape(-1, 6)
    ring = np.take_along_axis(ring, np.argsort(ring < 0, 1, kind="stable"), 1)
    has_four = ring[:, 3] >= 0
    return topology.compact(
        TriMesh(np.concatenate([vertices, added]), np.concatenate([whole, ring[:, :3], ring[has_four][:, [0, 2, 3]]]))
    )


def join_with_mirror(mesh: QuadMesh, axis: int, edge: float, surface: ProjectionTarget | None = None) -> QuadMesh:
    """Join a half of quads and its reflection into one mesh.

    Boundary vertices near the plane move onto it and are shared. Quads that fold in this way are untangled on
    `surface`, unless it is None. edge: length of the quads' sides.
    """
    vertices, quads = mesh.vertices, mesh.faces
    edges = topology.edges_of(quads)
    rim = np.zeros(len(vertices), bool)
    rim[edges.ends[edges.count == 1].ravel()] = True
    seam = rim & (np.abs(vertices[:, axis]) < _SEAM_EDGES * edge)
    vertices = vertices.copy()
    vertices[:, axis] = np.where(seam, 0.0, np.maximum(vertices[:, axis], _INSIDE_EDGES * edge))
    if surface is not None and scaled_jacobian(QuadMesh(vertices, quads)).min() < _MIN_JACOBIAN:
        surface_edges = topology.edges_of(surface.faces)
        segments = surface_edges.ends[surface_edges.count == 1]
        segments = segments[(np.abs(surface.vertices[segments, axis]) < _SNAP_EDGES * edge).all(1)]
        outline = Features(surface.vertices, segments, np.zeros(len(segments), np.int64), np.zeros(0, np.int64))
        free = Constraints.none(len(vertices))
        vertices = untangle(
            QuadMesh(vertices, quads), surface, outline, replace(free, curve=np.where(seam & bool(outline), 0, -1))
        )
        vertices[:, axis] = np.where(seam, 0.0, np.maximum(vertices[:, axis], _INSIDE_EDGES * edge))
    off_seam = np.flatnonzero(~seam)
    mirrored_index = np.arange(len(vertices))
    mirrored_index[off_seam] = len(vertices) + np.arange(len(off_seam))
    reflected = vertices[off_seam] * np.where(np.arange(3) == axis, -1.0, 1.0)
    # Start one corner later, so that the diagonal from the first corner is reflected too.
    mirrored_quads = mirrored_index[quads][:, [0, 3, 2, 1]]
    # A quad with three corners on the seam and its reflection become one quad across the seam.
    return remove_doublets(QuadMesh(np.concatenate([vertices, reflected]), np.concatenate([quads, mirrored_quads])))


def remesh_mirrored(mesh: TriMesh, request: Request, axis: int) -> tuple[QuadMesh, Record]:
    """Remesh as pipeline.remesh does, with quads that are their own mirror image across the axis.

    The plane goes through the origin. Where the halves do not close, the whole is remeshed without symmetry, and the
    record's figure "symmetry" is "none".
    """
    edge = (mesh.area / request.quads) ** 0.5
    sharp, moved = mesh, None
    if request.restore_creases and request.crease_degrees > 0:
        restored = restore_creases(mesh, request.crease_degrees)
        sharp, moved = restored.mesh, restored.moved
    half = half_mesh(sharp, axis)
    half_quads, record = remesh(
        half,
        replace(request, quads=max(request.quads // 2, 8), restore_creases=False, min_jacobian=_MIN_JACOBIAN / 2),
    )
    joined = join_with_mirror(half_quads, axis, edge, record.source or ProjectionTarget(half))
    if moved is not None:
        record.figures["crease_vertices_restored"] = moved
    if topology.is_watertight(mesh.faces):
        joined = fill_holes(joined)
    fault = _seam_fault(joined, mesh.faces, request)
    record.source = None
    if fault is None:
        record.figures["symmetry"] = AXES[axis]
        return joined, record
    failed = [*record.failed, f"mirrored about {AXES[axis]}: {fault}"]
    whole, record = remesh(mesh, request)
    record.failed[:0] = failed
    record.figures["symmetry"] = "none"
    return whole, record


def _seam_fault(joined: QuadMesh, faces: np.ndarray, request: Request) -> str | None:
    """Return what is wrong with the joined halves of a surface with triangles (f, 3); None where they are sound."""
    quads = joined.faces
    if topology.is_watertight(faces):
        if not topology.is_watertight(quads):
            return "it does not close along the plane"
        if topology.components(quads)[0] != topology.components(faces)[0]:
            return "pieces are lost or joined"
    if not topology.is_manifold(quads):
        return "it is not manifold"
    jacobian = scaled_jacobian(joined)
    if jacobian.min() <= 0 and request.smooth_iterations:
        return f"{int((jacobian <= 0).sum())} quads are folded"
    return None
