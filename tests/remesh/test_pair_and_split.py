"""The fallback without an engine: triangles are paired and split into quads."""

import numpy as np
import pytest

from gdtool.geometry import simplify, topology
from gdtool.geometry.mesh_quality import distance_figures, polygon_normals, shape_figures
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.remesh import pipeline
from gdtool.remesh.fallback import pair_and_split as fallback
from gdtool.remesh.fallback import smoothed
from gdtool.remesh.fallback.pair_and_split import pair_and_split
from gdtool.remesh.fit import shaping
from gdtool.remesh.fit.feature_curves import NO_FEATURES
from gdtool.remesh.fit.surface_projection import ProjectionTarget
from gdtool.remesh.task import RemeshPatch, Request
from tests.geometry.solids import cube, joined, rod, sphere, torus, volume
from tests.remesh.engines import is_watertight_manifold


def test_pairing_gives_the_requested_count_exactly():
    vertices, faces = sphere(24)
    for count in (3 * len(faces) - 500, int(2.2 * len(faces))):
        made = pair_and_split(TriMesh(vertices, faces), count)
        out, quads_out = made.vertices, made.faces
        assert abs(len(quads_out) - count) <= 1
        assert is_watertight_manifold(quads_out)
        assert volume(out, quads_out) > 0


def test_the_fallback_takes_the_coarsest_collapse_that_keeps_all_pieces(monkeypatch):
    """The gentler steps keep the small piece: a third more quads than requested, but fewer than of the whole mesh."""
    small, large = sphere(8), sphere(24)
    vertices, faces = joined((small[0] * 0.1 + 3, small[1]), large)
    tried = []

    def losing(mesh, target, **options):
        tried.append(target)
        keeps = target > 1000
        options = simplify.SimplifyOptions(measure_error=False)
        made = simplify.simplify(TriMesh(*large), target - (len(small[1]) if keeps else 0), options=options)
        both = TriMesh(*joined(small, (made.mesh.vertices, made.mesh.faces)))
        return made._replace(mesh=both) if keeps else made

    monkeypatch.setattr(fallback, "simplify", losing)
    requested = 1800  # 800 triangles; 1.15 times as many lose the piece, 1.3 times keep it
    made = fallback.quads_from_input(TriMesh(vertices, faces), requested, 60.0)
    quads_out = made.faces
    assert tried[:3] == [800, 919, 1040]
    assert topology.components(quads_out)[0] == 2
    assert requested < len(quads_out) < 1.5 * requested < 1.8 * len(faces)


def test_isotropic_remeshing_stops_when_the_count_improves_no_more(monkeypatch):
    """A cube has twelve triangles whatever their edge length; on a sphere any number can be reached."""
    import pymeshlab

    runs, mesh_set = [], pymeshlab.MeshSet
    monkeypatch.setattr(pymeshlab, "MeshSet", lambda: runs.append(1) or mesh_set())
    cubes = joined(*((cube()[0] + (3 * i, 0, 0), cube()[1]) for i in range(20)))
    assert len(fallback.isotropic_triangles(TriMesh(*cubes), 100, 30.0).faces) == 240
    assert len(runs) == 2
    runs.clear()
    assert abs(len(fallback.isotropic_triangles(TriMesh(*sphere(24)), 500, 30.0).faces) / 500 - 1) < 0.05
    assert 1 <= len(runs) <= 4


@pytest.mark.parametrize(
    "mesh, quads, few",
    [
        (sphere(24), 100, False),
        (sphere(24), 20, True),
        (torus(24), 200, False),
        (torus(24), 120, True),
        (joined(*[sphere(8)] * 9), 260, False),
        (joined(*[sphere(8)] * 9), 240, True),
    ],
)
def test_isotropic_remeshing_is_skipped_for_too_few_triangles(monkeypatch, mesh, quads, few):
    """At least twelve triangles are needed for a piece, and eighty for a handle."""
    calls = []
    monkeypatch.setattr(smoothed, "quads_from_isotropic", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(smoothed, "split_count", lambda faces, quads: quads)
    patch = RemeshPatch(TriMesh(*mesh), quads, 0.1, Request(quads=quads), lambda: ProjectionTarget(TriMesh(*mesh)))
    made = smoothed.split(patch)
    faces = made.faces
    assert fallback.too_few_for_isotropic(mesh[1], quads) == few
    assert len(calls) == (not few)
    assert topology.is_watertight(faces)


def test_the_fallback_corrects_its_count_for_unpaired_triangles():
    """Pins of few triangles: those that bend too much stay single, so fewer triangles are used."""
    vertices, faces = joined(*((pin[0] + (0.3 * k, 0, 0), pin[1]) for k, pin in enumerate([rod(24)] * 8)))
    made = fallback.quads_from_input(TriMesh(vertices, faces), 400, 60.0)
    quads_out = made.faces
    assert abs(len(quads_out) / 400 - 1) < 0.1
    assert topology.components(quads_out)[0] == 8
    assert topology.is_watertight(quads_out)


@pytest.mark.parametrize("shape", ["slivers", "coincident"])
def test_splitting_makes_square_quads_of_any_triangles(shape):
    """Triangles on which engines fail: long slivers, and sheets that touch without being joined."""
    if shape == "slivers":
        vertices, faces = cube()
        vertices = vertices * (1, 0.4, 0.15)  # twelve triangles
    else:
        vertices, faces = joined(cube(), cube())
        vertices = vertices.copy()
        vertices[8:, 0] += np.ptp(vertices[:8, 0])  # shares a side with the first
    vertices = vertices / np.ptp(vertices, 0).max()
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=3000, engine="split"))
    out, quads_out = made.vertices, made.faces
    assert record.engine == "pair and split"
    assert is_watertight_manifold(quads_out)
    assert abs(len(quads_out) / 3000 - 1) <= 0.03
    assert topology.components(quads_out)[0] == topology.components(faces)[0]
    figures = shape_figures(QuadMesh(out, quads_out))
    assert figures["jacobian_mean"] > 0.85
    assert figures["folded_share"] == 0
    assert figures["angle_deviation_deg"] < 18
    assert (
        distance_figures(TriMesh(out, triangulated(quads_out)[0]), TriMesh(vertices, faces), 5000)["hausdorff"] < 0.01
    )


def test_quads_without_area_are_smoothed_while_their_neighbours_stay(monkeypatch):
    """All vertices are to keep their original positions, except those of a quad without area."""
    vertices, faces = sphere(24, 0.5)
    made = pair_and_split(TriMesh(vertices, faces), 600)
    split, quad_faces = made.vertices, made.faces
    a, b, c, d = quad_faces[100]
    split[b], split[d] = split[a], split[c]
    assert polygon_normals(QuadMesh(split, quad_faces))[1][100] < 1e-12
    monkeypatch.setattr(shaping, "_abandoning_faces", lambda *arguments: np.arange(len(quad_faces)))
    surface, request = ProjectionTarget(TriMesh(vertices, faces)), Request(quads=600)
    out = shaping.keep_better_vertices(
        QuadMesh(split, quad_faces),
        *shaping.smoothed(QuadMesh(split, quad_faces), surface, NO_FEATURES, request),
        surface,
        request,
        surface,
    )
    edge = (polygon_normals(QuadMesh(out, quad_faces))[1].sum() / len(quad_faces)) ** 0.5
    assert polygon_normals(QuadMesh(out, quad_faces))[1].min() > 1e-4 * edge**2
    touched = np.isin(quad_faces, quad_faces[100]).any(1)
    unmoved = np.setdiff1d(quad_faces[~touched], quad_faces[touched])
    assert np.array_equal(out[unmoved], split[unmoved])
