"""Pieces that nearly touch are remeshed as if each were alone."""

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.remesh import pipeline
from gdtool.remesh.spacing import separate_pieces
from gdtool.remesh.task import Request
from tests.geometry.solids import cube, joined, sphere


def boxes(*sizes_and_centres):
    box, faces = cube()
    return joined(*((box * size + centre, faces) for size, centre in sizes_and_centres))


def test_pieces_are_moved_apart_and_back():
    """Boxes side by side, one inside another, and of different sizes."""
    vertices, faces = boxes(
        ((0.4, 0.3, 0.5), (0, 0, 0)),
        ((0.4, 0.3, 0.5), (0, 0.301, 0)),
        ((0.1, 0.1, 0.1), (0, 0, 0)),
        ((0.9, 0.05, 0.05), (0, 0, 0.4)),
    )
    apart = separate_pieces(TriMesh(vertices, faces), 0.1)
    _, piece = topology.components(faces)
    boxes_of = [
        (apart.mesh.vertices[faces[piece == k]].min((0, 1)), apart.mesh.vertices[faces[piece == k]].max((0, 1)))
        for k in range(4)
    ]
    for i, (low, high) in enumerate(boxes_of):
        for other_low, other_high in boxes_of[:i]:
            assert (np.maximum(low - other_high, other_low - high)).max() >= 0.1 - 1e-9
    assert np.abs(apart.to_original(apart.mesh.vertices) - vertices).max() < 1e-12
    middle = apart.mesh.vertices[faces].mean(1)
    assert np.abs(apart.to_original(middle) - vertices[faces].mean(1)).max() < 1e-12


def test_one_piece_or_pieces_far_apart_are_not_moved():
    assert separate_pieces(TriMesh(*cube()), 0.1) is None
    assert separate_pieces(TriMesh(*boxes((0.3, (0, 0, 0)), (0.3, (0, 0.5, 0)))), 0.1) is None
    assert separate_pieces(TriMesh(*boxes((0.3, (0, 0, 0)), (0.3, (0, 0.5, 0)))), 0.25) is not None


def test_quads_of_one_piece_are_not_fitted_to_another():
    """Two balls, one in the other, a tenth of a quad apart: each keeps its radius.

    If they were not moved apart, the quads of both would lie between the two.
    """
    vertices, faces = joined(sphere(48, 0.4), sphere(48, 0.397))
    made, record = pipeline.remesh(TriMesh(vertices, faces), Request(quads=3000))
    out, quads_out = made.vertices, made.faces
    assert "instant-meshes" in record.engine
    assert scaled_jacobian(QuadMesh(out, quads_out)).min() > 0.2
    assert topology.is_watertight(quads_out)
    count, piece = topology.components(quads_out)
    assert count == 2
    inner, outer = sorted(
        (np.linalg.norm(out[np.unique(quads_out[piece == k])], axis=1) for k in range(2)), key=np.mean
    )
    assert inner.max() < 0.3985 < outer.min()
