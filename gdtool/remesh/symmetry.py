"""Quads that are mirror images of each other: one half remeshed, the other reflected, the seam on the plane between
them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.normals import face_normals
from gdtool.geometry.sharpen import restore_creases
from gdtool.remesh.fit.feature_curves import Constraints, Features
from gdtool.remesh.fit.surface_projection import Surface, fill_holes, remove_doublets
from gdtool.remesh.fit.untangle import unfold
from gdtool.remesh.pipeline import remesh
from gdtool.remesh.task import Record, Request

_TOLERANCE_EDGES, _TOLERANCE_SIDE = 0.25, 0.004  # of the quads' side, of the longest side: halves farther apart differ
_SNAP_EDGES = 1e-3  # vertices of the input nearer to the plane, in its own edge lengths, are on it
_SEAM_EDGES = 1.0  # rim vertices of the half farther from the plane, in the quads' side, do not belong to the seam
_LEAST_JACOBIAN = 0.25
_INSIDE_EDGES = 0.05  # other vertices keep this far from the plane
AXES = "xyz"


def mirror_plane(
    vertices: np.ndarray, faces: np.ndarray, quads: int, axes: str = AXES, limit: int = 8000
) -> tuple[int | None, dict[str, float]]:
    """The axis (0, 1, 2) about whose plane through the origin the mesh is its own mirror image, the best of `axes`, or
    None; and for each the largest distance of reflected vertices to the surface.

    vertices (v, 3) in a unit box about the origin. What would be finer than a quarter of one of the quads does not
    count."""
    edge = (face_normals(vertices, faces)[1].sum() / quads) ** 0.5
    surface = Surface(vertices, faces)
    points = vertices[np.unique(faces)]
    points = points[:: max(len(points) // limit, 1)]
    far = {
        AXES[i]: float(surface.closest(points * np.where(np.arange(3) == i, -1.0, 1.0))[0].max())
        for i in range(3)
        if AXES[i] in axes
    }
    best = min(far, key=far.__getitem__)
    return (AXES.index(best) if far[best] <= min(_TOLERANCE_EDGES * edge, _TOLERANCE_SIDE) else None), far


def half_of(vertices: np.ndarray, faces: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """The part of a triangle mesh where the coordinate `axis` is not negative, open along that plane."""
    at = np.ptp(vertices[faces], axis=1).max(1)
    vertices = vertices.copy()
    vertices[np.abs(vertices[:, axis]) < _SNAP_EDGES * np.median(at), axis] = 0.0
    sign = np.sign(vertices[:, axis]).astype(np.int64)
    lowest, highest = sign[faces].min(1), sign[faces].max(1)
    whole, split = faces[(lowest >= 0) & (highest > 0)], faces[(lowest < 0) & (highest > 0)]
    if not len(split):
        return topology.compact(vertices, whole)
    # Each corner on this side, and each crossing of an edge that changes sides, in the order round the face.
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
    more = ring[:, 3] >= 0
    return topology.compact(
        np.concatenate([vertices, added]), np.concatenate([whole, ring[:, :3], ring[more][:, [0, 2, 3]]])
    )


def joined_with_mirror(
    vertices: np.ndarray, quads: np.ndarray, axis: int, edge: float, surface: Surface | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A half of quads (q, 4) and its reflection as one mesh; rim vertices near the plane are drawn onto it and shared.

    Quads that this folds are unfolded on `surface`.
    """
    edges = topology.edges_of(quads)
    rim = np.zeros(len(vertices), bool)
    rim[edges.ends[edges.count == 1].ravel()] = True
    seam = rim & (np.abs(vertices[:, axis]) < _SEAM_EDGES * edge)
    vertices = vertices.copy()
    vertices[:, axis] = np.where(seam, 0.0, np.maximum(vertices[:, axis], _INSIDE_EDGES * edge))
    if surface is not None and scaled_jacobian(vertices, quads).min() < _LEAST_JACOBIAN:
        theirs = topology.edges_of(surface.faces)
        segments = theirs.ends[theirs.count == 1]
        segments = segments[(np.abs(surface.vertices[segments, axis]) < _SNAP_EDGES * edge).all(1)]
        outline = Features(surface.vertices, segments, np.zeros(len(segments), np.int64), np.zeros(0, np.int64))
        free = Constraints.none(len(vertices))
        vertices = unfold(vertices, quads, surface, outline, replace(free, curve=np.where(seam & bool(outline), 0, -1)))
        vertices[:, axis] = np.where(seam, 0.0, np.maximum(vertices[:, axis], _INSIDE_EDGES * edge))
    other = np.flatnonzero(~seam)
    number = np.arange(len(vertices))
    number[other] = len(vertices) + np.arange(len(other))
    reflected = vertices[other] * np.where(np.arange(3) == axis, -1.0, 1.0)
    # Begun one corner later, so that the diagonal from the first corner is reflected too.
    turned = number[quads][:, [0, 3, 2, 1]]
    # A quad with three corners on the seam and its reflection are one quad across it.
    return remove_doublets(np.concatenate([vertices, reflected]), np.concatenate([quads, turned]))


def remesh_mirrored(
    vertices: np.ndarray, faces: np.ndarray, request: Request, axis: int
) -> tuple[np.ndarray, np.ndarray, Record]:
    """As quads.remesh, the quads being their own mirror image about the plane through the origin across `axis`.

    Where the halves do not close, the whole is remeshed as it is, and the record says so (figure "symmetry" is "none").
    """
    edge = (face_normals(vertices, faces)[1].sum() / request.quads) ** 0.5
    fine_vertices, fine_faces, moved = vertices, faces, None
    if request.restore_creases and request.crease_degrees > 0:
        fine_vertices, fine_faces, report = restore_creases(vertices, faces, request.crease_degrees)
        moved = report["moved"]
    half = half_of(fine_vertices, fine_faces, axis)
    out, quads, record = remesh(
        *half,
        replace(request, quads=max(request.quads // 2, 8), restore_creases=False, least_jacobian=_LEAST_JACOBIAN / 2),
    )
    out, quads = joined_with_mirror(out, quads, axis, edge, record.source or Surface(*half))
    if moved is not None:
        record.figures["crease_vertices_restored"] = moved
    fault = None
    if topology.is_watertight(faces):
        out, quads = fill_holes(out, quads)
        fault = None if topology.is_watertight(quads) else "it does not close along the plane"
        fault = fault or (
            None if topology.components(quads)[0] == topology.components(faces)[0] else "pieces are lost or joined"
        )
    if fault is None and not topology.is_manifold(quads):
        fault = "it is not manifold"
    if fault is None and scaled_jacobian(out, quads).min() <= 0 and request.smooth_iterations:
        fault = f"{int((scaled_jacobian(out, quads) <= 0).sum())} quads are folded"
    record.source = None
    if fault is None:
        record.figures["symmetry"] = AXES[axis]
        return out, quads, record
    failed = [*record.failed, f"mirrored about {AXES[axis]}: {fault}"]
    out, quads, record = remesh(vertices, faces, request)
    record.failed[:0] = failed
    record.figures["symmetry"] = "none"
    return out, quads, record
