"""Stored maps, eight bits with gutters, against an analytic material: their error, and their seams."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.bake.score import Seams
from gdtool.bake.maps import make_maps
from gdtool.bake.pipeline import BakeOptions, bake, vertex_lookup
from gdtool.bake.reproject import Source, cage_offsets
from gdtool.bake.target import Target, points_at, texels_of
from gdtool.geometry.meshes import TriMesh
from gdtool.images.color import srgb_from_linear
from tests.bake.shapes import albedo_of, psnr, torus, triangles_of, unwrapped

SIZE = 1024


def on_torus(points, major=0.35, minor=0.14):
    """Find the nearest points (n, 3) on the analytic torus."""
    ring = points * (1, 0, 1)
    ring = major * ring / np.linalg.norm(ring, axis=1, keepdims=True)
    away = points - ring
    return ring + minor * away / np.linalg.norm(away, axis=1, keepdims=True)


def material(points):
    """Compute the stored values of the analytic material at the torus points nearest to points (n, 3)."""
    at = on_torus(points)
    return {"albedo": srgb_from_linear(albedo_of(at)), "roughness": 0.5 + 0.8 * at[:, 0]}


@pytest.fixture(scope="module")
def stored():
    """Bake a dense torus onto a coarse one: the target, its texels, and the stored maps in [0, 1]."""
    fine, fine_quads, fine_normals = torus(640, 360)
    coarse, quads, _ = torus(60, 30, minor=0.141)
    faces = triangles_of(quads)
    target = Target.of(TriMesh(coarse, faces), *unwrapped(coarse, faces, SIZE))
    texels = texels_of(target, SIZE)
    source = Source(TriMesh(fine, triangles_of(fine_quads)))
    attributes = {"albedo": albedo_of(fine), "roughness": 0.5 + 0.8 * fine[:, 0], "metallic": np.full(len(fine), 0.25)}
    baked = bake(
        target,
        texels,
        source,
        vertex_lookup(source, attributes, fine_normals),
        cage_offsets(TriMesh(coarse, faces), source),
        BakeOptions(threads=2),
    )
    maps = make_maps(texels, baked.values)
    return target, texels, {"albedo": maps.base_color / 255, "roughness": maps.orm[..., 1:2] / 255}


def test_stored_maps_match_the_material_to_55_db(stored):
    target, texels, maps = stored
    true = material(points_at(target, texels.face_idx, texels.barycentric)[0][: texels.inside])
    for name, image in maps.items():
        assert (
            psnr(
                image.reshape(-1, image.shape[2])[texels.texel[: texels.inside]], true[name].reshape(texels.inside, -1)
            )
            >= 55
        )


def test_no_seam_shows(stored):
    """The difference across seams is at most 1.2 times that across other edges; without gutters it is more."""
    target, texels, maps = stored
    seams = Seams(SimpleNamespace(target=target, material=material), SIZE)
    for name, image in maps.items():
        assert seams.ratio(name, image) <= 1.2
        without_gutters = np.zeros_like(image)
        inside = texels.texel[: texels.inside]
        without_gutters.reshape(-1, image.shape[2])[inside] = image.reshape(-1, image.shape[2])[inside]
        assert seams.ratio(name, without_gutters) > 1.2
