"""A mesh of several pieces: the small ones apart from the large, and where all fail together, those that fail one by
one."""

from __future__ import annotations

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import closest_points
from gdtool.remesh.engines.candidate import Candidate, judged
from gdtool.remesh.engines.search import Found
from gdtool.remesh.fallback.pair_and_split import split_count
from gdtool.remesh.fit.shaping import CUT_OFF, drawn, fault_of, outlined, settled
from gdtool.remesh.task import COUNT_TOLERANCE, Part

SMALL_PIECE_QUADS = 48
_MOST_ALONE, _ALONE, _FEWEST = 16, 300, 6  # pieces that are remeshed one by one; quads of one that is, and of any
# Of the quads of a piece, that there may be more or fewer in any case, and at most; the rest of the tolerance goes by
# the root of their number.
_SURELY, _MOST_OFF = 0.02, 0.15
_MADE_UP = 0.5  # of the quads of the other pieces, that these may have more or fewer of than their share
# Of a component's quads lie on the piece that they stand for; edge lengths that a piece strays.
_ON_ONE, _MOST_APART = 0.9, 1.5


def by_size(part: Part) -> tuple[Part | None, Part]:
    """The small pieces as one mesh, None where there are none, and the large ones as another, each with its share of
    the quads by area."""
    (count, piece), quads = part.pieces, part.quads
    share = part.piece_areas / part.piece_areas.sum()
    small = share * quads < SMALL_PIECE_QUADS
    if small.all() or not small.any():  # many like pieces: the engine may still do; the fallback takes what it loses
        return None, part
    # Enough for their shape, out of at most a quarter of all.
    own = quads * share[small]
    enough = np.maximum(own, np.minimum(np.bincount(piece, minlength=count)[small] / 2, SMALL_PIECE_QUADS)).sum()
    few = part.of(small[piece], max(round(own.sum()), int(min(enough, quads / 4)), 1))
    return few, part.of(~small[piece], max(quads - few.quads, 4))


def well_made(part: Part, whole: Candidate | None) -> tuple[Found | None, np.ndarray]:
    """Of an engine's quads of all pieces those of the pieces on which they stand up to judgement, finished; which these
    are (pieces,) bool."""
    (count, piece), good = part.pieces, np.zeros(part.pieces[0], bool)
    if whole is None or count > part.quads / SMALL_PIECE_QUADS:
        return None, good
    parts = [part.of(piece == k, 0) for k in range(count)]
    quads = [
        judged(*quads, topology.invariants(own.faces))
        for own, quads in zip(parts, quads_by_piece(whole.vertices, whole.quads, part), strict=True)
    ]
    good[:] = [fault is None for fault, _, _ in quads]
    if not good.any():
        return None, good
    of_these = whole.drawn
    if of_these is None or not good.all():
        these = part.of(good[piece], part.quads)
        outline = outlined(
            *joined([own[1:] for own, fits in zip(quads, good, strict=True) if fits]),
            these.surface,
            these.features,
            0,
            part.request,
        )
        of_these = drawn(outline, these.surface, these.features, part.request)
    made = quads_by_piece(*settled(*of_these, part.fine(), part.request), part)
    for k in np.flatnonzero(good):
        good[k] = (
            len(made[k][1]) > 0 and fault_of(*made[k], parts[k].surface, part.edge, _MOST_APART, CUT_OFF)[0] is None
        )
    if not good.any():
        return None, good
    found = *joined([made[k] for k in np.flatnonzero(good)]), whole.way.label
    rest = part.quads * part.piece_areas[~good].sum() / part.piece_areas.sum()
    if abs(part.quads - len(found[1]) - rest) > max(COUNT_TOLERANCE * part.quads, _MADE_UP * rest):
        return None, np.zeros_like(good)  # the others could not make up for so many or so few
    return found, good


def apart(part: Part, done: np.ndarray, quads: int) -> list[Part]:
    """What is left to do of the pieces that are not done (pieces,) bool, in so many quads: each large one, and, given
    up, all others together.

    What lies close together an engine may join, and what is thin it may lose beside the rest, so that it may do better
    on one piece alone. It comes less near to a count of few; what their counts may be off is shared such that the sum
    of all pieces still holds."""
    if done.all():
        return []
    count, piece = part.pieces
    share = np.where(done, 0.0, part.piece_areas / part.piece_areas[~done].sum())
    least = np.minimum(np.bincount(piece, minlength=count) / 2, part.quads / _MOST_ALONE)  # enough for its shape
    alone = np.argsort(-share, kind="stable")[:_MOST_ALONE]
    own = np.maximum(quads * share, least)[alone]
    large = (share[alone] > 0) & (own >= _ALONE)
    alone, own, rest = alone[large], own[large], ~done
    rest[alone] = False
    out = []
    if rest.any():
        out.append(part.of(rest[piece], max(int(quads * share[rest].sum()), 1), given_up=True))
        quads -= split_count(out[0].faces, out[0].quads)
    own = np.maximum((own * (quads / max(own.sum(), 1))).round().astype(int), _FEWEST)
    spare = max(COUNT_TOLERANCE * part.quads - _SURELY * own.sum(), 0)
    tolerance = np.minimum(_SURELY + spare * np.sqrt(own) / np.sqrt(own).sum() / own, _MOST_OFF)
    return out + [
        part.of(piece == k, int(number), tolerance=float(off))
        for k, number, off in zip(alone, own, tolerance, strict=True)
    ]


def quads_by_piece(vertices: np.ndarray, quads: np.ndarray, part: Part) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices and quads of each piece: of the components of a quad mesh those that lie on it; what lies on two is
    nobody's."""
    (count, piece), (components, label) = part.pieces, topology.components(quads)
    on = piece[closest_points(vertices[quads].mean(1), part.vertices, part.faces)[1]]
    share = np.zeros((components, count))
    np.add.at(share, (label, on), 1)
    owner = np.where(share.max(1) >= _ON_ONE * share.sum(1), share.argmax(1), -1)
    return [topology.compact(vertices, quads[owner[label] == k]) for k in range(count)]


def joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Meshes as one."""
    offset = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(
        [faces + o for (_, faces), o in zip(parts, offset, strict=False)]
    )
