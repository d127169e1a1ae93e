"""Remesh a mesh of several connected pieces.

Small pieces are remeshed apart from large ones. Pieces whose quads are rejected are remeshed again, one by one.
"""

from __future__ import annotations

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import closest_points
from gdtool.geometry.meshes import QuadMesh
from gdtool.remesh.engines.candidate import Candidate, repair_and_judge
from gdtool.remesh.fallback.pair_and_split import split_count
from gdtool.remesh.fit.shaping import CUT_OFF, finalize, fit_to_surface, rejection_reason, snap_to_features
from gdtool.remesh.limits import COUNT_TOLERANCE
from gdtool.remesh.task import QuadResult, RemeshPatch

SMALL_PIECE_QUADS = 48  # a piece whose share is fewer quads is small: engines lose such pieces beside large ones
_MAX_SMALL_SHARE = 4  # small pieces together get at most one over this of all quads

_MAX_ALONE = 16  # pieces remeshed one by one, the largest first
_MIN_QUADS_ALONE = 300  # quads of a piece for which an engine is worth a run of its own
_MIN_PIECE_QUADS = 6

# Relative error of a piece's count that is accepted in any case, and at most. What the tolerance of the sum leaves is
# shared by the root of the pieces' counts.
_MIN_TOLERANCE, _MAX_TOLERANCE = 0.02, 0.15
_MAX_MAKE_UP = 0.5  # of the quads of the pieces still to make, that they may have more or fewer than their share

_MIN_SHARE_ON_ONE = 0.9  # of a component's quads lie on the piece it belongs to
_MAX_PIECE_EDGES = 1.5  # edge lengths that an accepted piece may stray


def split_small_pieces(patch: RemeshPatch) -> tuple[RemeshPatch | None, RemeshPatch]:
    """Split a patch into one of its small pieces (None where there are none) and one of its large pieces.

    Each gets its share of the quads by area; small pieces get enough to keep their shape.
    """
    (count, piece), quads = patch.pieces, patch.quads
    share = patch.piece_areas / patch.piece_areas.sum()
    small = share * quads < SMALL_PIECE_QUADS
    # Many pieces of one size: an engine may still work, and the fallback takes what it loses.
    if small.all() or not small.any():
        return None, patch
    by_area = quads * share[small]
    for_shape = np.minimum(np.bincount(piece, minlength=count)[small] / 2, SMALL_PIECE_QUADS)
    enough = np.maximum(by_area, for_shape).sum()
    small_patch = patch.subset(small[piece], max(round(by_area.sum()), int(min(enough, quads / _MAX_SMALL_SHARE)), 1))
    return small_patch, patch.subset(~small[piece], max(quads - small_patch.quads, 4))


def accept_good_pieces(patch: RemeshPatch, whole: Candidate | None) -> tuple[QuadResult | None, np.ndarray]:
    """Judge each piece of an engine's result by itself; return the finalized quads of the good pieces.

    whole: the engine's quads of all pieces. The result is None where no piece is good. Also returns (pieces,) bool: the
    accepted pieces.
    """
    (count, piece), good = patch.pieces, np.zeros(patch.pieces[0], bool)
    if whole is None or count > patch.quads / SMALL_PIECE_QUADS:
        return None, good
    parts = [patch.subset(piece == k, 0) for k in range(count)]
    judged = [
        repair_and_judge(quads, topology.invariants(part.mesh.faces))
        for part, quads in zip(parts, quads_by_piece(whole.mesh, patch), strict=True)
    ]
    good[:] = [quads.fault is None for quads in judged]
    if not good.any():
        return None, good
    fitted = whole.fitted
    if fitted is None or not good.all():
        good_patch = patch.subset(good[piece], patch.quads)
        snapped = snap_to_features(
            concatenate_meshes([quads.mesh for quads in judged if quads.fault is None]),
            good_patch.surface,
            good_patch.features,
            0,
            patch.request,
        )
        fitted = fit_to_surface(snapped, good_patch.surface, good_patch.features, patch.request)
    made = quads_by_piece(finalize(fitted, patch.full_surface(), patch.request), patch)
    for k in np.flatnonzero(good):
        good[k] = (
            len(made[k].faces) > 0
            and rejection_reason(made[k], parts[k].surface, patch.edge, _MAX_PIECE_EDGES, CUT_OFF)[0] is None
        )
    if not good.any():
        return None, good
    result = QuadResult(concatenate_meshes([made[k] for k in np.flatnonzero(good)]), whole.attempt.label)
    missing_quads = patch.quads * patch.piece_areas[~good].sum() / patch.piece_areas.sum()
    if abs(patch.quads - len(result.mesh.faces) - missing_quads) > max(
        COUNT_TOLERANCE * patch.quads, _MAX_MAKE_UP * missing_quads
    ):
        return None, np.zeros_like(good)  # the other pieces could not make up for this count
    return result, good


def remaining_patches(patch: RemeshPatch, done: np.ndarray, quads: int) -> list[RemeshPatch]:
    """Make patches of the pieces that are not done: one of each large piece, one of all small pieces together.

    done (pieces,) bool; quads: how many are left for these pieces. The patch of small pieces skips engines. An engine
    often does better on a single piece: among several, it can join pieces that lie close together, and lose thin ones.
    It meets small counts less well, so each piece gets a share of the tolerance such that the sum of all pieces still
    holds.
    """
    if done.all():
        return []
    count, piece = patch.pieces
    share = np.where(done, 0.0, patch.piece_areas / patch.piece_areas[~done].sum())
    # Enough quads for a piece's shape.
    least = np.minimum(np.bincount(piece, minlength=count) / 2, patch.quads / _MAX_ALONE)
    alone = np.argsort(-share, kind="stable")[:_MAX_ALONE]
    counts = np.maximum(quads * share, least)[alone]
    large = (share[alone] > 0) & (counts >= _MIN_QUADS_ALONE)
    alone, counts, is_small = alone[large], counts[large], ~done
    is_small[alone] = False
    patches = []
    if is_small.any():
        patches.append(patch.subset(is_small[piece], max(int(quads * share[is_small].sum()), 1), skip_engines=True))
        quads -= split_count(patches[0].mesh.faces, patches[0].quads)
    counts = np.maximum((counts * (quads / max(counts.sum(), 1))).round().astype(int), _MIN_PIECE_QUADS)
    spare = max(COUNT_TOLERANCE * patch.quads - _MIN_TOLERANCE * counts.sum(), 0)
    tolerance = np.minimum(_MIN_TOLERANCE + spare * np.sqrt(counts) / np.sqrt(counts).sum() / counts, _MAX_TOLERANCE)
    return patches + [
        patch.subset(piece == k, int(number), tolerance=float(error))
        for k, number, error in zip(alone, counts, tolerance, strict=True)
    ]


def quads_by_piece(mesh: QuadMesh, patch: RemeshPatch) -> list[QuadMesh]:
    """Split a quad mesh by the piece of the patch's surface that its connected components lie on.

    A component that lies on two pieces is left out.
    """
    vertices, quads = mesh.vertices, mesh.faces
    (count, piece), (components, label) = patch.pieces, topology.components(quads)
    nearest = piece[closest_points(vertices[quads].mean(1), patch.mesh)[1]]
    share = np.zeros((components, count))
    np.add.at(share, (label, nearest), 1)
    owner = np.where(share.max(1) >= _MIN_SHARE_ON_ONE * share.sum(1), share.argmax(1), -1)
    return [topology.compact(QuadMesh(vertices, quads[owner[label] == k])) for k in range(count)]


def concatenate_meshes(meshes: list[QuadMesh]) -> QuadMesh:
    """Concatenate several meshes into one."""
    offset = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return QuadMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + o for mesh, o in zip(meshes, offset, strict=False)]),
    )
