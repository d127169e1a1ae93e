"""Several samples per texel: only those on charts count, weighted by alpha."""

import numpy as np
import pytest

from gdtool.bake import supersample
from gdtool.bake.pipeline import BakeOptions, bake, vertex_lookup
from gdtool.bake.reproject import Source, cage_offsets
from gdtool.bake.target import COARSE_TEXEL, Target, samples_for, texels_of
from gdtool.geometry.meshes import TriMesh
from gdtool.images.color import srgb_from_linear
from tests.bake.shapes import albedo_of, torus, triangles_of, unwrapped

SIZE = 32


def test_samples_follow_the_sources_detail():
    assert samples_for(0.01, 0.01) == samples_for(COARSE_TEXEL * 0.01, 0.01) == 1
    assert samples_for(1.01 * COARSE_TEXEL * 0.01, 0.01) == 4


def plate(material, left=4.0, right=28.0, samples=16, threads=1):
    """Bake a plate: values by name, images (SIZE, SIZE, …).

    Its chart spans [left, right] x [4, 28] texels; one unit is a texel. material(x (n,)) replaces values at abscissae
    x.
    """
    vertices = np.array([[left, 0, 4], [right, 0, 4], [right, 0, 28], [left, 0, 28.0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    target, source = (
        Target.of(TriMesh(vertices, faces), vertices[:, [0, 2]] / SIZE, faces),
        Source(TriMesh(vertices, faces)),
    )

    def lookup(places):
        x = source.at(places.face_idx, places.barycentric, source.mesh.vertices)[:, 0]
        plain = {
            "albedo": np.full((len(x), 3), 0.5),
            "roughness": np.full(len(x), 0.5),
            "metallic": np.zeros(len(x)),
            "normal": np.tile([0.0, 1, 0], (len(x), 1)),
        }
        return {name: value.astype(np.float32) for name, value in (plain | material(x)).items()}

    texels = texels_of(target, SIZE)
    baked = bake(
        target, texels, source, lookup, cage_offsets(TriMesh(vertices, faces), source), BakeOptions(samples, threads)
    )
    return {name: texels.image(value) for name, value in baked.values.items()}


def test_a_step_within_a_texel_is_averaged_in_linear_light():
    values = plate(lambda x: {"albedo": np.where(x < 10.25, 1.0, 0.0)[:, None] * [1, 0.5, 0]})
    np.testing.assert_allclose(values["albedo"][15, 9:12], [[1, 0.5, 0], [0.25, 0.125, 0], [0, 0, 0]], atol=1e-5)


def test_averaged_normals_are_unit():
    tilted = np.array([0.6, 0.8, 0])
    values = plate(lambda x: {"normal": np.where(x[:, None] < 10.5, [0, 1.0, 0], tilted)})
    middle = values["tangent_normal"][15, 10]
    assert np.linalg.norm(middle) == pytest.approx(1, abs=1e-6)
    assert np.degrees(np.arccos(middle[2])) == pytest.approx(0.5 * np.degrees(np.arccos(0.8)), abs=0.01)


def test_samples_beside_the_chart_do_not_count():
    # The chart covers the right three quarters of texel 10: samples at 10.375, 10.625 and 10.875.
    values = plate(lambda x: {"roughness": (x - 10) / 2}, left=10.25)
    assert values["roughness"][15, 10] == pytest.approx(0.625 / 2, abs=1e-5)


def test_transparent_color_does_not_count():
    values = plate(
        lambda x: {
            "alpha": np.where(x < 10.5, 1.0, 0.0),
            "albedo": np.where(x[:, None] < 10.5, [0.8, 0.2, 0.1], [0, 0, 0]),
        }
    )
    assert values["alpha"][15, 10] == pytest.approx(0.5, abs=1e-6)
    np.testing.assert_allclose(values["albedo"][15, 10], [0.8, 0.2, 0.1], atol=1e-3)


@pytest.fixture(scope="module")
def ring():
    fine, quads, normals = torus(240, 140)
    coarse, coarse_quads, _ = torus(36, 18, minor=0.142)
    faces = triangles_of(coarse_quads)
    target = Target.of(TriMesh(coarse, faces), *unwrapped(coarse, faces, 128))
    source = Source(TriMesh(fine, triangles_of(quads)))
    attributes = {"albedo": albedo_of(fine), "roughness": (fine[:, 1] > 0.05) * 1.0, "metallic": np.zeros(len(fine))}
    return (
        target,
        texels_of(target, 128),
        source,
        vertex_lookup(source, attributes, normals),
        cage_offsets(TriMesh(coarse, faces), source),
    )


def test_any_number_of_threads_gives_equal_values(ring):
    single, three = (bake(*ring, BakeOptions(4, threads)) for threads in (1, 3))
    assert single.report == three.report
    assert 0.02 < single.report["supersampled_share"] < 0.98
    for name, value in single.values.items():
        np.testing.assert_array_equal(value, three.values[name])


def test_texels_left_with_one_sample_are_within_the_tolerance(ring, monkeypatch):
    texels = ring[1]
    some = bake(*ring, BakeOptions(4)).values
    unvaried = np.setdiff1d(np.arange(texels.inside), supersample.varying(texels, bake(*ring).values))
    monkeypatch.setattr(supersample, "varying", lambda texels, values, threads: np.arange(len(texels)))
    every = bake(*ring, BakeOptions(4)).values
    assert len(unvaried) > 100
    assert (
        np.abs(srgb_from_linear(some["albedo"]) - srgb_from_linear(every["albedo"]))[unvaried].max()
        < supersample.TOLERANCE
    )
    for name in ("roughness", "tangent_normal"):
        assert np.abs(some[name] - every[name])[unvaried].max() < supersample.TOLERANCE
    assert np.abs(some["roughness"] - bake(*ring).values["roughness"]).max() > 0.2
