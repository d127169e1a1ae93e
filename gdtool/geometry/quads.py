"""Triangles to quads: an engine in a child, its result judged and repaired, fitted to the surface by quad_fit.py, and a chain of fallbacks."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.core.threads import mapped
from gdtool.geometry import repair
from gdtool.geometry.features import find_features
from gdtool.geometry.mesh_quality import scaled_jacobian, valences
from gdtool.geometry.normals import face_normals
from gdtool.geometry.quad_engines import ENGINES
from gdtool.geometry.quad_fit import farthest, finished, fitted, left_out, sticks_out
from gdtool.geometry.quad_shape import Surface, fill_holes, remove_doublets
from gdtool.geometry.quad_split import split_count, split_to_quads
from gdtool.geometry.quad_topology import cancel_irregular
from gdtool.geometry.sharpen import restore_creases
from gdtool.geometry.simplify import simplify

COUNT_TOLERANCE = 0.03
_SMALL_PIECE_QUADS = 48
_TRIES = 3
_CLOSE_EDGES, _LEAST_JACOBIAN = 0.55, 0.2  # nearer and squarer than this, a result is taken without a look at others
_LOST_EDGES, _LOST_SHARE = 0.75, 0.003  # surface so far from the quads is lost on them, and how much of it may be
_MOST_FOLDED = 0.01  # of the quads
_HANDLES, _PIECES = "handles are lost or added", "pieces are lost or joined"
_TOO_COARSE = _STRAYS, _LEAVES_OUT, _STICKS_OUT = "strays", "leaves out", "sticks out"
_MENDINGS = 4  # rounds of filling holes and parting what meets at a vertex
_MOST_PIECES, _ALONE, _FEWEST = 16, 300, 6  # that are remeshed one by one where together they fail; quads of one that is, and of any
_ON_ONE, _MOST_APART = 0.9, 1.5  # of a component's quads lie on the piece that they stand for; edge lengths that a piece strays


@dataclass(frozen=True)
class Request:
    """What is asked for: about `quads` faces; creases sharper than crease_degrees followed; limits of one engine run."""

    quads: int = 20000
    crease_degrees: float = 30.0
    engine: str = "auto"
    smooth_iterations: int = 5
    restore_creases: bool = True
    seconds: float = 120.0
    memory_mb: int = 16000
    threads: int = 1  # pieces that go one by one are done side by side
    least_jacobian: float = -1.0  # a coarser mesh subdivided is passed over where its worst quad is worse


@dataclass
class Record:
    """What was done: the engine whose result was taken, what was tried before and why not, figures, seconds by step."""

    engine: str = ""
    failed: list[str] = field(default_factory=list)
    figures: dict[str, float | int | bool | str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    source: Surface | None = None  # the input with its search tree, built while a child worked

    def clock(self, name: str, start: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def add(self, other: Record) -> None:
        """What was tried, and the seconds, of a part."""
        self.failed += other.failed
        for name, seconds in other.seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def remesh(vertices: np.ndarray, faces: np.ndarray, request: Request) -> tuple[np.ndarray, np.ndarray, Record]:
    """Quads (q, 4) on the surface of a clean triangle mesh (repair.clean), and the record of how.

    vertices (v, 3) in a unit box, faces (f, 3). All faces are quads; closed and manifold where the input is.
    """
    found = _remeshed(vertices, faces, request, careful=False)
    edge = (face_normals(vertices, faces)[1].sum() / request.quads) ** 0.5
    if (error := found[2].figures["simplify_error"]) <= edge:
        return found
    again = _remeshed(vertices, faces, request, careful=True)
    first, record = found[2], again[2]
    first.failed.append(f"simplify: {_STRAYS} {error / edge:.2g} edge lengths from the surface")
    first.add(record)
    record.failed, record.seconds = first.failed, first.seconds
    return again


def _remeshed(vertices: np.ndarray, faces: np.ndarray, request: Request, careful: bool) -> tuple[np.ndarray, np.ndarray, Record]:
    """remesh() of what one way of simplifying leaves: the quick one, or the careful one (simplify.py)."""
    record = Record()
    start = time.perf_counter()
    edge = (face_normals(vertices, faces)[1].sum() / request.quads) ** 0.5

    def prepare_engines() -> None:
        if request.engine != "split":
            prepare("gdtool.geometry.quad_engines", len(_attempts(request.quads, request)[0][2]))

    if len(faces) > _needed(request):
        prepare("gdtool.geometry.simplify")
    else:
        prepare_engines()
    closed = cache(lambda: repair.is_watertight(faces))
    fine_vertices, fine_faces = vertices, faces
    if request.restore_creases and request.crease_degrees > 0 and _median_edge(vertices, faces) < 0.75 * edge:
        fine_vertices, fine_faces, report = restore_creases(vertices, faces, request.crease_degrees)
        record.figures["crease_vertices_restored"] = report["moved"]
    record.clock("restore creases", start)
    # While a child has one core, this process uses another: the search tree of the input, then the deviation from it. The
    # tree is built only once the child has its mesh: building it holds the interpreter's lock.
    fine = cache(lambda: Surface(vertices, faces))

    def meanwhile() -> None:
        prepare_engines()  # not before: their start would slow what this process does alone
        fine()

    coarse = _simplified(vertices, faces, fine_vertices, fine_faces, closed, request, record, careful, meanwhile)
    with ThreadPoolExecutor(1) as beside:
        error = beside.submit(_deviation, fine(), coarse) if coarse[1] is not faces else None
        done = [found for part in _pieces(*coarse, request.quads) for found in _quads_of(*part, False, edge, request, record, fine)]
        record.source = fine()
        record.figures["simplify_error"] = error.result() if error is not None else 0.0
    record.engine = "; ".join(dict.fromkeys(way for _, _, way in done))
    return *_joined([found[:2] for found in done]), record


def _quads_of(vertices: np.ndarray, faces: np.ndarray, quads: int, given_up: bool, edge: float, request: Request, record: Record,
              fine: Callable[[], Surface]) -> list[tuple[np.ndarray, np.ndarray, str]]:
    """Vertices, quads and the way that they were made of a mesh, or of parts of it that were made in different ways.

    given_up: no engine is tried. edge: of a quad; fine: gives the input's Surface.
    """
    if not given_up and quads >= _SMALL_PIECE_QUADS and request.engine != "split":
        found, whole = _by_engines(vertices, faces, quads, edge, request, record, fine)
        if found is not None:
            return [found]
        if repair.components(faces)[0] > 1:
            found, left = _by_pieces(vertices, faces, quads, whole, edge, request, record, fine)
            records = [Record() for _ in left]
            rest = mapped(lambda k: _quads_of(*left[k], edge, request, records[k], fine), range(len(left)), min(request.threads, len(left)))
            out = [] if found is None else [found]
            for own, made in zip(records, rest, strict=True):
                out += made
                record.add(own)
            return out
    start = time.perf_counter()
    split = split_to_quads(vertices, faces, quads, request.crease_degrees, request.seconds, request.memory_mb)
    found = *fitted(*split, vertices, faces, request, fine()), "pair and split"
    record.clock("fallback", start)
    return [found]


def _needed(request: Request) -> int:
    """How many triangles show all that so many quads can."""
    return max(3 * request.quads, 20000)


def _simplified(vertices: np.ndarray, faces: np.ndarray, restored_vertices: np.ndarray, restored_faces: np.ndarray, closed: Callable[[], bool],
                request: Request, record: Record, careful: bool, meanwhile: Callable[[], object]) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with its creases restored as coarse as the quads need, or the mesh as it was where that cannot be done.

    meanwhile: what to do while a child works; may be called more than once.
    """
    start = time.perf_counter()
    needed = _needed(request)
    restored = restored_vertices is not vertices
    found = simplify(restored_vertices, restored_faces, needed, seconds=request.seconds, closed=closed, thorough=not restored, careful=careful,
                     measured=False, meanwhile=meanwhile)
    if restored and (found[3]["method"] == "none" and "failed" in found[3] or closed() and not repair.is_watertight(found[1])):
        # Bevels drawn out where there is no crease make folds that the collapse tears.
        record.failed.append("creases restored: the result cannot be simplified")
        record.figures["crease_vertices_restored"] = 0
        found = simplify(vertices, faces, needed, seconds=request.seconds, closed=closed, careful=careful, measured=False, meanwhile=meanwhile)
    report = found[3]
    record.figures["simplified_to"] = report["faces"]
    if "failed" in report:
        record.failed.append(f"simplify: {report['failed']}")
    record.clock("simplify", start)
    return found[:2]


def _deviation(fine: Surface, coarse: tuple[np.ndarray, np.ndarray], limit: int = 20000) -> float:
    """Largest distance of the vertices of the input and of the simplified mesh to the other, at most `limit` of each."""
    one, two = fine, Surface(*coarse)
    return float(max(b.closest(a.vertices[::max(len(a.vertices) // limit, 1)])[0].max() for a, b in ((one, two), (two, one))))


def _median_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    step = max(len(faces) // 20000, 1)
    few = faces[::step]
    return float(np.median(np.linalg.norm(vertices[few] - vertices[np.roll(few, 1, 1)], axis=-1)))


def _pieces(vertices: np.ndarray, faces: np.ndarray, quads: int) -> list[tuple[np.ndarray, np.ndarray, int]]:
    """The large pieces as one mesh and the small ones as another, each with its share of the quads by area."""
    count, piece = repair.components(faces)
    area = face_normals(vertices, faces)[1]
    share = np.bincount(piece, area, count) / area.sum()
    small = (share * quads < _SMALL_PIECE_QUADS)[piece]
    if small.all():
        small[:] = False  # many like pieces: the engine may still do; the fallback takes what it loses
    out = []
    for which in (~small, small):
        if which.any():
            own = repair.compact(vertices, faces[which])
            budget = int(round(quads * area[which].sum() / area.sum()))
            if small[which].all():
                # Enough for their shape, out of at most a quarter of all.
                of = np.unique(piece[which])
                enough = np.maximum(quads * share[of], np.minimum(np.bincount(piece, minlength=count)[of] / 2, _SMALL_PIECE_QUADS)).sum()
                budget = max(budget, int(min(enough, quads / 4)), 1)
            out.append((*own, budget))
    if len(out) == 2:  # the asked count holds for the sum
        few = split_count(out[1][1], out[1][2])
        out[0] = (*out[0][:2], max(quads - few, 4))
    return out


def _by_pieces(vertices: np.ndarray, faces: np.ndarray, quads: int, whole: tuple[str, np.ndarray, np.ndarray] | None, edge: float,
               request: Request, record: Record, fine: Callable[[], Surface]) -> tuple[tuple[np.ndarray, np.ndarray, str] | None, list[tuple]]:
    """Of several pieces, those whose quads in an engine's result `whole` stand up to judgement, finished; and what is left to do.

    What is left: (vertices, faces, quads, whether it is given up) of each large piece and, given up, of all others together. What lies close
    together an engine may join, and what is thin it may lose beside the rest, so that it may do better on one piece alone.
    """
    start = time.perf_counter()
    count, piece = repair.components(faces)
    area = np.bincount(piece, face_normals(vertices, faces)[1], count)
    found, good = None, np.zeros(count, bool)
    if whole is not None and count <= quads / _SMALL_PIECE_QUADS:
        parts = [repair.compact(vertices, faces[piece == k]) for k in range(count)]
        judged = [_judged(*part, *parts[k]) if len(part[1]) else ("lost", *part) for k, part in enumerate(_quads_of_pieces(*whole[1:], vertices, faces, piece))]
        good = np.array([fault is None for fault, _, _ in judged])
        if good.any():
            surface = Surface(*repair.compact(vertices, faces[good[piece]]))
            features = find_features(surface.vertices, surface.faces, request.crease_degrees or 181.0, 3 * edge)
            done = finished(*_joined([quads_of[1:] for quads_of, fits in zip(judged, good, strict=True) if fits]), surface, features, 0, request, fine())
            of_piece = _quads_of_pieces(*done, vertices, faces, piece)
            for k in np.flatnonzero(good):
                good[k] = len(of_piece[k][1]) and _fault(*of_piece[k], Surface(*parts[k]), edge, _MOST_APART) is None
            if good.any():
                found = *_joined([of_piece[k] for k in np.flatnonzero(good)]), whole[0]
    left = quads - (len(found[1]) if found is not None else 0)
    waiting = []
    if not good.all():
        share = np.where(good, 0.0, area / area[~good].sum())
        alone = np.argsort(-share, kind="stable")[:_MOST_PIECES]
        least = np.minimum(np.bincount(piece, minlength=count) / 2, quads / _MOST_PIECES)  # enough for its shape
        own = np.maximum(left * share, least)[alone]
        alone, own = alone[(share[alone] > 0) & (own >= _ALONE)], own[(share[alone] > 0) & (own >= _ALONE)]
        rest = ~good
        rest[alone] = False
        if rest.any():
            few = max(int(left * share[rest].sum()), 1)
            waiting.append((*repair.compact(vertices, faces[rest[piece]]), few, True))
            left -= split_count(waiting[0][1], few)
        own = np.maximum((own * (left / max(own.sum(), 1))).round().astype(int), _FEWEST)
        waiting += [(*repair.compact(vertices, faces[piece == k]), int(number), False) for k, number in zip(alone, own, strict=True)]
    record.clock("pieces", start)
    return found, waiting


def _quads_of_pieces(quad_vertices: np.ndarray, quad_faces: np.ndarray, vertices: np.ndarray, faces: np.ndarray,
                     piece: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices and quads of each piece (f,) of the triangles: of the components of a quad mesh those that lie on it; on two, on none."""
    from gdtool.geometry.distance import closest_points

    count, label = repair.components(quad_faces)
    on = piece[closest_points(quad_vertices[quad_faces].mean(1), vertices, faces)[1]]
    share = np.zeros((count, piece.max() + 1))
    np.add.at(share, (label, on), 1)
    owner = np.where(share.max(1) >= _ON_ONE * share.sum(1), share.argmax(1), -1)
    return [repair.compact(quad_vertices, quad_faces[owner[label] == k]) for k in range(piece.max() + 1)]


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Meshes as one."""
    offset = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate([faces + o for (_, faces), o in zip(parts, offset, strict=False)])


def _fault(quad_vertices: np.ndarray, quad_faces: np.ndarray, surface: Surface, edge: float, limit: float) -> str | None:
    """What of finished quads does not do on the surface, or None. limit: edge lengths that they may stray."""
    if (far := farthest(quad_vertices, quad_faces, surface) / edge) > limit:
        return f"{_STRAYS} {far:.2g} edge lengths from the surface"
    if (left := left_out(quad_vertices, quad_faces, surface, _LOST_EDGES * edge)) > _LOST_SHARE:
        return f"{_LEAVES_OUT} {left:.1%} of the surface"
    if (over := sticks_out(quad_vertices, quad_faces, surface) / edge) > limit:
        return f"{_STICKS_OUT} {over:.2g} edge lengths"
    if (folded := float((scaled_jacobian(quad_vertices, quad_faces) <= 0).mean())) > _MOST_FOLDED:
        return f"{folded:.1%} of the quads are folded"
    return None


def _by_engines(vertices: np.ndarray, faces: np.ndarray, quads: int, edge: float, request: Request,
                record: Record, fine: Callable[[], Surface]) -> tuple[tuple[np.ndarray, np.ndarray, str] | None, tuple[str, np.ndarray, np.ndarray] | None]:
    """The first engine's result that stands up to judgement, finished; None when none does. fine gives the input's Surface.

    Of several pieces, too, what an engine made of all of them that does not stand up: the way, its vertices and quads, mended where they could be.
    """
    features = surface = None
    second_best = whole = None
    apart = repair.components(faces)[0] > 1  # what fails together can go piece by piece
    given_up: set[str] = set()
    for engine, subdivisions, factors, degrees in _attempts(quads, request):
        if engine in given_up:
            continue
        label = engine + (f", {subdivisions} subdivision" if subdivisions else "") + ("" if degrees else ", creases left out")
        asked = [quads * factor for factor in factors]
        extra = 0  # quads of the tips that are drawn out of the engine's
        for _ in range(_TRIES):
            start = time.perf_counter()
            way = ENGINES["on few" if engine == "instant-meshes" and subdivisions else engine]
            running = [begin(way, vertices.astype(np.float32), faces.astype(np.int32), max(int(number / 4**subdivisions), 16),
                             degrees, seconds=request.seconds, memory_mb=request.memory_mb) for number in asked]
            if features is None:
                features = find_features(vertices, faces, request.crease_degrees or 181.0, 3 * edge)
                surface = Surface(vertices, faces)
                fine()
            results = []
            for number, child in zip(asked, running, strict=True):
                try:
                    results.append((number, *_judged(*child.result(), vertices, faces)))
                except ChildFailed as failure:
                    record.failed.append(f"{label}: {failure}")
            record.clock("engine", start)
            if not results:
                break
            start, wanted = time.perf_counter(), quads - extra

            def rank(result: tuple, wanted: int = wanted) -> tuple:
                return result[1] is not None, max(abs(len(result[3]) * 4**subdivisions / wanted - 1), COUNT_TOLERANCE), _irregular(result[3])

            results.sort(key=rank)
            number, fault, quad_vertices, quad_faces = results[0]
            count = len(quad_faces) * 4**subdivisions
            off = count / wanted - 1
            if apart and not subdivisions and len(quad_faces):
                whole = label, quad_vertices, quad_faces
            if (fault is None or apart and not subdivisions) and abs(off) > COUNT_TOLERANCE:
                asked = [number * wanted / max(count, 1)]
                continue
            if fault is None:
                # The others of the right count are finished too, until one has no thin quad and leaves no corner out.
                best = None
                for result in [r for r in results if rank(r)[:2] == (False, COUNT_TOLERANCE)]:
                    quad_vertices, quad_faces = finished(*result[2:], surface, features, subdivisions, request, fine())
                    far = farthest(quad_vertices, quad_faces, surface) / edge
                    least = float(scaled_jacobian(quad_vertices, quad_faces).min())
                    good = far < _CLOSE_EDGES and least > _LEAST_JACOBIAN
                    if best is None or good or far - 2 * least < best[0]:
                        best = far - 2 * least, far, least, quad_vertices, quad_faces, result
                    if good or not subdivisions:
                        break
                record.clock("fit", start)
                _, far, least, quad_vertices, quad_faces, taken = best
                if abs(len(quad_faces) / quads - 1) > COUNT_TOLERANCE:
                    given = len(taken[3]) * 4**subdivisions
                    extra, count = len(quad_faces) - given, len(quad_faces)
                    asked = [taken[0] * (quads - extra) / given]
                    continue
                fault = _fault(quad_vertices, quad_faces, surface, edge, 1.0 if subdivisions else 2.0)
                if subdivisions and least < request.least_jacobian:
                    fault = f"has a quad of scaled Jacobian {least:.2g}"
            elif fault == _HANDLES and not subdivisions and second_best is None and abs(off) <= COUNT_TOLERANCE:
                second_best = quad_vertices, quad_faces, f"{label}, {fault}"
            if fault is None:
                return (quad_vertices, quad_faces, label), None
            record.failed.append(f"{label}: {fault}")
            if apart and not subdivisions:
                return None, whole
            # Another density mends a seam of the engine's fields, not a part that is too thin for so many quads.
            if not subdivisions and fault.startswith(_TOO_COARSE):
                given_up.add(engine)
            break
        else:
            record.failed.append(f"{label}: gave {count} faces for {quads}")
            if not subdivisions:
                given_up.add(engine)
    if second_best is not None:
        # Closed and manifold, but a gap or tunnel finer than the quads was bridged or filled: still better than no engine.
        start = time.perf_counter()
        quad_vertices, quad_faces = finished(*second_best[:2], surface, features, 0, request, fine())
        record.clock("fit", start)
        if farthest(quad_vertices, quad_faces, surface) < 2 * edge:
            return (quad_vertices, quad_faces, second_best[2]), None
    return None, whole


def _irregular(faces: np.ndarray) -> int:
    valence, inner = valences(faces, int(faces.max(initial=0)) + 1)
    return int((valence[inner] != 4).sum())


def _attempts(quads: int, request: Request) -> list[tuple[str, int, tuple[float, ...], float]]:
    """(engine, subdivisions after it, factors on the count to try side by side, crease angle it is told), in the order to try.

    A coarser mesh subdivided has a quarter of the irregular vertices; it fails where features are finer than its quads.
    """
    out = []
    engines = ["instant-meshes"] if request.engine == "auto" else [request.engine]
    for engine in engines:
        if engine == "instant-meshes" and quads >= 3000:
            out.append((engine, 1, (1.01, 1.02), request.crease_degrees))
        out.append((engine, 0, (1.0,), request.crease_degrees))
        # Where a seam of the engine's fields fails, it often holds at a slightly different density.
        out.append((engine, 0, (1.02,), request.crease_degrees))
        out.append((engine, 0, (0.98,), 0.0))
    if request.engine == "quadriflow":
        out.append(("instant-meshes", 0, (1.0,), request.crease_degrees))
    return out


def _judged(quad_vertices: np.ndarray, quad_faces: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[str | None, np.ndarray, np.ndarray]:
    """What is wrong with an engine's result, or None, and the result without its small defects."""
    if quad_faces.ndim != 2 or quad_faces.shape[1] != 4 or not len(quad_faces):
        return "no quads", quad_vertices, quad_faces
    if quad_faces.min() < 0 or quad_faces.max() >= len(quad_vertices) or not np.isfinite(quad_vertices).all():
        return "indices or coordinates out of range", quad_vertices, quad_faces
    whole = (np.sort(quad_faces, 1)[:, 1:] != np.sort(quad_faces, 1)[:, :-1]).all(1)
    if not whole.any():
        return "no quads", quad_vertices, quad_faces
    quad_vertices, quad_faces = repair.compact(quad_vertices, quad_faces[whole])
    closed = repair.is_watertight(faces)
    pieces = repair.components(faces)[0]
    for turn in range(_MENDINGS):
        if turn and (not closed or repair.is_watertight(quad_faces)):
            break
        if closed:
            quad_vertices, quad_faces = fill_holes(quad_vertices, quad_faces)
        # What parts where fans met at a vertex, and what lay in a hole as a piece of its own, leave holes to fill.
        quad_vertices, quad_faces = remove_doublets(*repair.one_vertex_per_fan(quad_vertices, quad_faces))
        quad_vertices, quad_faces = cancel_irregular(quad_vertices, quad_faces)
        quad_vertices, quad_faces = repair.without_crumbs(quad_vertices, quad_faces, pieces)
        if not len(quad_faces):
            return "no quads", quad_vertices, quad_faces
    if closed and not repair.is_watertight(quad_faces):
        return "not watertight, though the input is", quad_vertices, quad_faces
    if not repair.is_manifold(quad_faces):
        return "not manifold", quad_vertices, quad_faces
    if repair.components(quad_faces)[0] != pieces:
        return _PIECES, quad_vertices, quad_faces
    if closed and repair.euler_number(quad_faces) != repair.euler_number(faces):
        return _HANDLES, quad_vertices, quad_faces
    return None, quad_vertices, quad_faces
