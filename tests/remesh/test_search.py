"""Engines' quads are repaired and judged; whatever an engine does, there is a result."""

import time

import igl
import numpy as np
import pytest

from gdtool.core.child import ChildFailed
from gdtool.geometry import topology
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.topology import triangulated
from gdtool.remesh import pipeline
from gdtool.remesh.engines import candidate as candidates
from gdtool.remesh.engines import search
from gdtool.remesh.engines.candidate import Candidate
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import SnappedQuads, rejection_reason, target_of_quads, uncovered_shares
from gdtool.remesh.fit.surface_projection import ProjectionTarget
from gdtool.remesh.task import Record, RemeshPatch, Request
from tests.geometry.solids import cube, marching, quad_cube, sphere, torus, volume
from tests.remesh.engines import Ended, around, in_this_process, inner_face, is_watertight_manifold


@pytest.mark.parametrize("failure", ["died of SIGSEGV", "ended with exit code 0 and no result"])
def test_dead_engine_is_replaced(monkeypatch, failure):
    monkeypatch.setattr(search, "begin", lambda *_, **__: Ended(ChildFailed(failure)))
    vertices, faces = torus()
    made, record = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=900))
    quads_out = made.faces
    assert record.engine == "pair and split"
    assert any(failure in text for text in record.failed)
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 900 - 1) <= 0.03


@pytest.mark.parametrize("outcome, runs", [("a smaller sphere", 1), ("a crash", 3)])
def test_an_engine_far_from_the_surface_runs_once_and_a_crashing_one_again(monkeypatch, outcome, runs):
    """Another density, or no creases, may avoid a crash; quads too coarse for a part stay so."""
    vertices, faces = sphere(24)
    made, _ = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=1000, engine="split"))
    out, quads_out = made.vertices, made.faces

    def engine(*_):
        if outcome == "a crash":
            raise ChildFailed("died of SIGSEGV")
        return QuadMesh(out / 2, quads_out)

    calls = in_this_process(monkeypatch, engine)
    # Without this, fitting would turn the small sphere into the large one.
    monkeypatch.setattr(
        candidates,
        "snap_to_features",
        lambda mesh, *_: SnappedQuads(
            mesh,
            Constraints.none(len(mesh.vertices)),
            tips=np.zeros(0, int),
            edge=1.0,
            distance_edges=0.0,
            limit_edges=1.0,
            hopeless=True,
        ),
    )
    made, record = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=1000))
    quads_out = made.faces
    assert len(calls) == runs
    assert record.engine == "pair and split"
    assert is_watertight_manifold(quads_out)
    assert outcome == "a crash" or "strays" in record.failed[0]


@pytest.mark.parametrize(
    "tops, wanted, order",
    [((0.3, 1.0), 1000, [1, 0]), ((0.3, 1.0), 1100, [0, 1]), ((0.39, 1.0), 1000, [0, 1]), ((0.3, 0.3), 875, [0, 1])],
    ids=["far", "of another count", "in no doubt", "both far"],
)
def test_a_much_nearer_candidate_goes_before_a_doubtful_one(tops, wanted, order):
    """Candidates are balls without a cap, and whole balls."""
    vertices, faces = sphere(24, 0.4)
    made, _ = pipeline.remesh(TriMesh(vertices, faces), Request(quads=1000, engine="split"))
    out, quads_out = made.vertices, made.faces
    patch = RemeshPatch(TriMesh(vertices, faces), 1000, 0.045, Request(), None)
    attempt = search.EngineAttempt("instant-meshes", 0, (1.0,), 30.0)
    pair = [
        Candidate(
            attempt, 1000, None, topology.compact(QuadMesh(out, quads_out[out[quads_out].mean(1)[:, 2] < height]))
        )
        for height in tops
    ]
    assert [id(candidate) for candidate in search.EngineSearch(patch, Record())._nearer_first(pair, wanted)] == [
        id(pair[k]) for k in order
    ]


def test_quads_that_leave_out_surface_are_rejected_before_fitting(monkeypatch):
    """Half a ball is rejected, and no other count is requested.

    A whole ball passes, and so does one whose missing cap can be covered by tip extrusion.
    """
    vertices, faces = sphere(24, 0.4)
    made, _ = pipeline.remesh(TriMesh(vertices, faces), Request(quads=1000, engine="split"))
    out, quads_out = made.vertices, made.faces
    patch = RemeshPatch(TriMesh(vertices, faces), 1000, 0.045, Request(), None)
    height = out[quads_out].mean(1)[:, 2]
    reasons = [
        Candidate(
            search.EngineAttempt("instant-meshes", 0, (1.0,), 30.0),
            1000,
            None,
            topology.compact(QuadMesh(out, quads_out[height < most])),
        ).missing_surface(patch)
        for most in (1.0, 0.37, 0.0)
    ]
    assert reasons[:2] == [None, None]
    assert "leaves out 3" in reasons[2]
    calls = in_this_process(monkeypatch, lambda *_: topology.compact(QuadMesh(out, quads_out[height < 0.0])))
    monkeypatch.setattr(candidates, "repair_and_judge", lambda mesh, *_: candidates.JudgedQuads(None, mesh))
    monkeypatch.setattr(search.EngineSearch, "_fit_first_good", None)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=1000))
    assert len(calls) == 1
    assert record.engine == "pair and split"
    assert "leaves out" in record.failed[0]


@pytest.mark.parametrize("thickness, thin", [(0.03, True), (0.05, False)])
def test_subdivision_is_given_up_where_walls_are_thinner_than_quads(thickness, thin):
    vertices, faces = igl.upsample(*cube(), 5)
    vertices = vertices * (0.9, 0.9, thickness)
    patch = RemeshPatch(TriMesh(vertices, faces), 4000, (2 * 0.81 / 4000) ** 0.5, Request(), None)
    assert patch.has_thin_walls == thin
    wedge = vertices.copy()
    wedge[:, 2] *= 0.01 + (wedge[:, 0] + 0.45) / 0.9 * 0.7 / thickness
    assert not RemeshPatch(TriMesh(wedge, faces), 4000, 0.02, Request(), None).has_thin_walls
    # A one-sided sheet is no wall, on neither of its sides.
    assert not RemeshPatch(
        TriMesh(vertices, faces[face_normals(TriMesh(vertices, faces))[0][:, 2] > 0.5]),
        2000,
        patch.edge,
        Request(),
        None,
    ).has_thin_walls
    # A mesh with fewer triangles than quads is not tested.
    assert not RemeshPatch(
        TriMesh(cube()[0] * (0.9, 0.9, thickness), cube()[1]), 4000, patch.edge, Request(), None
    ).has_thin_walls
    assert not RemeshPatch(TriMesh(vertices, faces[:, ::-1]), 4000, patch.edge, Request(), None).has_thin_walls
    # No creases, since the plate's narrow sides would count as narrow strips.
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000, crease_degrees=0.0))
    quads_out = made.faces
    assert is_watertight_manifold(quads_out)
    assert any("walls" in text for text in record.failed) == thin
    assert not (thin and "1 subdivision" in record.engine)


def with_tunnel(vertices, faces, length):
    """Connect two triangles of a ball by a tunnel: the topmost one, and one about `length` away from it."""
    centre = vertices[faces].mean(1)
    top = centre[:, 2].argmax()
    other = np.abs(np.linalg.norm(centre - centre[top], axis=1) - length).argmin()
    a, b = faces[top], faces[other][::-1]
    b = min((np.roll(b, k) for k in range(3)), key=lambda b: np.linalg.norm(vertices[a] - vertices[b], axis=1).sum())
    tube = [[a[k], a[(k + 1) % 3], b[k]] for k in range(3)] + [[a[(k + 1) % 3], b[(k + 1) % 3], b[k]] for k in range(3)]
    return vertices, np.concatenate([np.delete(faces, [top, other], 0), tube])


def bored_ball():
    return marching(lambda x, y, z: np.maximum(np.sqrt(x * x + y * y + z * z) - 0.4, 0.06 - np.hypot(x, y)), 64, 0.5)


@pytest.mark.parametrize("shape, given_up", [("a skin-deep tunnel", True), ("a bore", False)])
def test_only_handles_finer_than_a_quad_may_be_lost(monkeypatch, shape, given_up):
    vertices, faces = sphere(96, 0.4)
    made, _ = pipeline.remesh(TriMesh(vertices, faces), Request(quads=1000, engine="split"))
    out, quads_out = made.vertices, made.faces
    vertices, faces = with_tunnel(vertices, faces, 0.07) if given_up else bored_ball()
    assert topology.is_watertight(faces)
    assert topology.is_manifold(faces)
    assert topology.euler_number(faces) == 0
    in_this_process(monkeypatch, lambda *_: QuadMesh(out, quads_out))  # an engine that returns a ball
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=1000))
    quads_out = made.faces
    assert is_watertight_manifold(quads_out)
    assert (record.engine == "instant-meshes, handles are lost") == given_up
    assert topology.euler_number(quads_out) == (2 if given_up else 0)


def test_torn_output_is_rejected(monkeypatch):
    # Three quads at one edge.
    book = np.array([[0, 1, 2, 3], [0, 1, 4, 5], [1, 0, 6, 7]])
    in_this_process(monkeypatch, lambda *_: QuadMesh(np.random.default_rng(0).random((8, 3)), book))
    vertices, faces = sphere(24)
    made, record = pipeline.remesh(TriMesh(vertices / 2, faces), Request(quads=300))
    quads_out = made.faces
    assert is_watertight_manifold(quads_out)
    assert record.engine == "pair and split"
    assert any("pieces are lost" in text for text in record.failed)


def test_a_hole_with_a_quad_attached_by_one_corner_is_closed():
    vertices, faces = quad_cube(3)
    middle = inner_face(vertices, faces)
    corners, sides = around(faces, middle)
    assert len(corners) == 4
    assert len(sides) == 4
    torn = np.delete(faces, [*corners[1:], *sides], 0)
    fault, mended = candidates.repair_and_judge(QuadMesh(vertices, torn), topology.invariants(faces))
    out, quads_out = mended.vertices, mended.faces
    assert fault is None
    assert is_watertight_manifold(quads_out)
    assert topology.components(quads_out)[0] == 1
    assert len(quads_out) < len(faces)
    assert volume(out, triangulated(quads_out)[0]) == pytest.approx(volume(vertices, triangulated(faces)[0]))


def test_candidates_are_sorted_in_space(monkeypatch):
    """Candidates are sorted in space, whatever the order of the engine's quads."""
    vertices, faces = quad_cube(3)
    rng = np.random.default_rng(1)
    mixed, number = rng.permutation(len(vertices)), np.empty(len(vertices), np.int64)
    number[mixed] = np.arange(len(vertices))
    monkeypatch.setitem(
        candidates.ENGINES, "quadriflow", lambda *_: QuadMesh(vertices[mixed], rng.permutation(number[faces]))
    )
    candidate = candidates.make_candidate(
        TriMesh(vertices, triangulated(faces)[0]), candidates.EngineAttempt("quadriflow", 0, (1.0,), 30.0), len(faces)
    )
    assert candidate.fault is None
    assert len(candidate.mesh.faces) == len(faces)

    def places(v, q):
        return sorted(map(tuple, v[q].reshape(len(q), 12).tolist()))

    assert places(candidate.mesh.vertices, candidate.mesh.faces) == places(vertices, faces)
    ends = topology.edges_of(candidate.mesh.faces).ends
    # In random order the mean is a third of the number of vertices.
    assert np.abs(np.diff(ends, axis=1)).mean() < 0.3 * len(vertices) / 3


def test_output_without_area_is_rejected_as_no_quads():
    vertices, faces = quad_cube(1)
    assert (
        candidates.repair_and_judge(QuadMesh(vertices, faces[:, [0, 1, 1, 0]]), topology.invariants(faces)).fault
        == "no quads"
    )


def test_quads_that_cut_off_edges_are_rejected():
    vertices, faces = quad_cube(3)
    surface, edge = ProjectionTarget(TriMesh(vertices, triangulated(faces)[0])), 0.125 * np.ptp(vertices[:, 0])
    assert rejection_reason(QuadMesh(vertices, faces), surface, edge, 1.0, 0.005)[0] is None
    cut = vertices.copy()
    on_two = np.isclose(np.abs(vertices), np.abs(vertices).max()).sum(1) >= 2  # the cube's twelve edges
    cut[on_two] *= 1 - 0.5 * edge / np.ptp(vertices[:, 0])
    assert rejection_reason(QuadMesh(cut, faces), surface, edge, 1.0, 0.5)[0] is None
    assert rejection_reason(QuadMesh(cut, faces), surface, edge, 1.0, 0.005)[0].startswith("cuts off")


def test_uncovered_surface_is_measured():
    vertices, faces = cube()
    lid = faces[np.all(vertices[faces][:, :, 2] == vertices[:, 2].max(), 1)]
    open_faces = np.array([f for f in faces.tolist() if f not in lid.tolist()])
    surface = ProjectionTarget(TriMesh(vertices, faces))
    closed, opened = (np.concatenate([f, np.full((len(f), 1), -1)], 1) for f in (faces, open_faces))
    assert uncovered_shares(target_of_quads(QuadMesh(vertices, closed)), surface, (0.1,)) == [0]
    # All of the lid except a strip along its rim.
    assert uncovered_shares(target_of_quads(QuadMesh(vertices, opened)), surface, (0.1, 2.0)) == pytest.approx(
        [0.8**2 / 6, 0], abs=0.02
    )


def test_a_subdivided_result_within_wider_limits_is_taken_if_no_finer_one_comes(monkeypatch):
    """The limits of subdivided results are stricter, since attempts without subdivision follow.

    If all of these fail, a subdivided result within the wider limits is taken.
    """

    engine = candidates.ENGINES["instant-meshes"]

    def torn(mesh, quads, degrees):
        if quads > 2000:
            raise ChildFailed("died of SIGSEGV")
        return engine(mesh, quads, degrees)

    calls = in_this_process(monkeypatch)
    monkeypatch.setitem(candidates.ENGINES, "instant-meshes", torn)
    monkeypatch.setattr(
        candidates,
        "rejection_reason",
        lambda *arguments: ("cuts off 0.7% of the surface" if arguments[-1] < 0.007 else None, 0.5),
    )
    vertices, faces = sphere(96, 0.45)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000))
    quads_out = made.faces
    assert record.engine == "instant-meshes, 1 subdivision"
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 4000 - 1) <= 0.03
    assert "cuts off" in record.failed[0]
    assert "SIGSEGV" in record.failed[1]
    assert sum(not attempt.subdivisions for _, attempt, _ in calls) == 1
    monkeypatch.setattr(candidates, "FAR_SUBDIVIDED", 0.4)  # fitting stops beyond this distance
    assert pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000))[1].engine == "pair and split"
    monkeypatch.undo()
    in_this_process(monkeypatch)
    monkeypatch.setitem(candidates.ENGINES, "instant-meshes", torn)
    monkeypatch.setattr(candidates, "rejection_reason", lambda *arguments: ("cuts off 2% of the surface", 0.5))
    assert pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000))[1].engine == "pair and split"


def test_no_engine_is_started_when_the_time_is_over():
    """The quads are still made, of paired triangles, and the record has the reason."""
    vertices, faces = sphere(96, 0.45)
    start = time.monotonic()
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000, seconds=0.0))
    quads_out = made.faces
    assert record.engine == "pair and split"
    assert record.failed == ["instant-meshes, 1 subdivision: not tried, the time is over"]
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 4000 - 1) <= 0.03
    assert time.monotonic() - start < 30


def test_every_round_requests_two_counts():
    attempt = search._attempts(20000, Request())[0]
    assert len(attempt.counts_around(20000)) == 2
    assert np.mean(attempt.counts_around(20000)) == pytest.approx(20000)
    assert attempt.counts_around(20000)[1] / attempt.counts_around(20000)[0] == pytest.approx(
        attempt.factors[1] / attempt.factors[0]
    )


def test_the_next_request_lies_between_too_few_and_too_many():
    """An engine's count can jump by 5 %.

    A request in proportion to the last answer would repeat a request that gave too many.
    """
    answers = [search.EngineAnswer(19700.0, 20868), search.EngineAnswer(20100.0, 21164)]
    assert search._interpolate_request(answers, 20000) is None
    assert search._interpolate_request(answers, 22000) is None
    answers += [search.EngineAnswer(18691.0, 19164), search.EngineAnswer(19070.0, 18844)]
    assert search._interpolate_request(answers, 20000) == pytest.approx(19186, abs=1)


def test_the_first_good_candidate_is_taken(monkeypatch):
    """The first in rank is taken without fitting the other, if it is good.

    The other goes first if the first is not promising. If none is good, the nearest to the surface is taken.
    """
    attempt = search._attempts(20000, Request())[0]
    fitted = []

    def candidate(far, least, wrong=None, outline=0.5):
        quads_out = Candidate(
            attempt,
            1000,
            None,
            QuadMesh(np.zeros((0, 3)), np.zeros((0, 4), int)),
            distance_edges=far,
            min_jacobian=least,
            rejection=wrong,
        )
        quads_out.asked_of_outline = outline
        return quads_out

    def snap_to_features(taken, patch):
        taken.snapped = taken.asked_of_outline
        return taken.snapped < 1

    monkeypatch.setattr(Candidate, "is_promising", snap_to_features)
    monkeypatch.setattr(Candidate, "fit", lambda taken, patch: fitted.append(taken))
    choose = search.EngineSearch(RemeshPatch(TriMesh(*cube()), 1000, 0.1, Request(), None), Record())._fit_first_good
    good, better, far, thin = candidate(0.5, 0.3), candidate(0.1, 0.9), candidate(0.9, 0.5), candidate(0.3, 0.1)
    assert choose([good, better]) is good
    assert fitted == [good]
    assert choose([far, good]) is good
    assert choose([candidate(0.1, 0.9, "leaves out 1 % of the surface"), thin]) is thin
    assert choose([far, thin]) is far
    assert choose([candidate(2.0, 0.5), thin]) is thin
    fitted.clear()
    late = candidate(0.9, 0.3, outline=1.1)
    assert choose([late, good]) is good
    assert fitted == [good]
    late.snapped = None
    fitted.clear()
    assert choose([late, candidate(2.0, 0.5)]) is late
    assert fitted[1] is late
    assert len(fitted) == 2


def test_the_count_includes_tips_before_fitting(monkeypatch):
    """A candidate with too many quads, tips included, is not fitted.

    The next candidate with fewer quads is fitted before a new request is made.
    """
    attempt = search._attempts(20000, Request())[0]
    search_run = search.EngineSearch(RemeshPatch(TriMesh(*cube()), 4000, 0.1, Request(), None), Record())

    def candidate(count, tips, hopeless=False):
        quads_out = Candidate(attempt, count, None, QuadMesh(np.zeros((0, 3)), np.zeros((count // 4, 4), int)))
        quads_out.traced = SnappedQuads(
            QuadMesh(np.zeros((0, 3)), np.zeros((count + tips, 4), int)),
            None,
            np.zeros(0, int),
            0.1,
            0.0,
            1.0,
            hopeless,
        )
        return quads_out

    monkeypatch.setattr(Candidate, "snap", lambda taken, patch: setattr(taken, "snapped", taken.traced))
    plain, far, fewer = candidate(4000, 0), candidate(4100, 100), candidate(3900, 100)
    assert next(search_run._with_right_count([plain, far], 0)) is plain
    assert far.snapped is None
    assert list(search_run._with_right_count([far, fewer, candidate(4080, 100)], 0)) == [fewer]
    assert search_run._fit_first_good(search_run._with_right_count([far, plain := candidate(4060, 0)], 0)) is None
    assert plain.snapped is None
    assert list(search_run._with_right_count([hopeless := candidate(4100, 100, hopeless=True)], 0)) == [hopeless]


def test_subdivision_is_not_tried_where_creases_are_closer_than_a_quad(monkeypatch):
    """A plate hardly thicker than a quad: only full density is requested, and both rims are met."""
    calls = in_this_process(monkeypatch)
    vertices, faces = cube()
    vertices = vertices * (1, 0.8, 0.02)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=8000))
    out, quads_out = made.vertices, made.faces
    assert all(not attempt.subdivisions for _, attempt, _ in calls)
    assert "not tried, its quads are wider" in record.failed[0]
    assert record.engine == "instant-meshes"
    assert is_watertight_manifold(quads_out)
    corners = vertices[np.abs(vertices[:, None] - out[None]).max(-1).min(1) < 1e-9]
    assert len(corners) == 8
    assert uncovered_shares(
        target_of_quads(QuadMesh(out, quads_out)), ProjectionTarget(TriMesh(vertices, faces)), (0.005,)
    ) == [0.0]


@pytest.mark.parametrize("memory_mb, least, most", [(16000, 2000, 2500), (500, 500, 500)])
def test_an_engine_has_its_own_memory_limit_within_the_requests(monkeypatch, memory_mb, least, most):
    """The limit follows the number of quads and triangles, because Instant Meshes fills some holes for ever."""
    limits = []

    def begin(*_, memory_mb, **options):
        limits.append(memory_mb)
        return Ended(ChildFailed("ran out"))

    monkeypatch.setattr(search, "begin", begin)
    vertices, faces = sphere(48, 0.45)
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=4000, memory_mb=memory_mb))
    quads_out = made.faces
    assert limits
    assert all(least <= limit <= most for limit in limits)
    assert record.engine == "pair and split"
    assert is_watertight_manifold(quads_out)
