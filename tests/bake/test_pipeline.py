"""Baking against analytic materials and normals."""

import numpy as np
import pytest

from gdtool.bake.maps import make_maps
from gdtool.bake.occlusion import ambient_visibility, bake_occlusion
from gdtool.bake.pipeline import BakeOptions, bake, occlusion_tracer, vertex_lookup
from gdtool.bake.reproject import Source, cage_offsets
from gdtool.bake.target import Target, corner_normals, points_at, texels_of
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.tangents import decode_tangent_space
from gdtool.geometry.uv_raster import rasterize_uv
from tests.bake.shapes import albedo_of, psnr, sphere, torus, triangles_of, unwrapped


def nearest_on_torus(points, major=0.35, minor=0.14):
    ring = points * (1, 0, 1)
    ring = major * ring / np.linalg.norm(ring, axis=1, keepdims=True)
    normals = points - ring
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return ring + minor * normals, normals


def positions(target, texels):
    return points_at(target, texels.face_idx, texels.barycentric)[0]


@pytest.fixture(scope="module")
def torus_bake():
    fine, fine_quads, fine_normals = torus(240, 140)
    coarse, coarse_quads, _ = torus(36, 18, minor=0.142)
    faces = triangles_of(coarse_quads)
    uv, face_uvs = unwrapped(coarse, faces, 256)
    target = Target.of(TriMesh(coarse, faces), uv, face_uvs)
    texels = texels_of(target, 256)
    source = Source(TriMesh(fine, triangles_of(fine_quads)))
    attributes = {"albedo": albedo_of(fine), "roughness": 0.5 + 0.3 * fine[:, 0], "metallic": np.full(len(fine), 0.25)}
    lookup = vertex_lookup(source, attributes, fine_normals)
    reach = cage_offsets(TriMesh(coarse, faces), source)
    return target, texels, source, lookup, reach, bake(target, texels, source, lookup, reach, BakeOptions(threads=2))


def test_analytic_albedo_within_psnr_bound(torus_bake):
    target, texels, _, _, _, baked = torus_bake
    at, _ = nearest_on_torus(positions(target, texels)[: texels.inside])
    assert psnr(baked.values["albedo"][: texels.inside], albedo_of(at)) > 50
    assert np.abs(baked.values["roughness"][: texels.inside] - (0.5 + 0.3 * at[:, 0])).max() < 0.01
    assert baked.report["nearest_point_share"] < 0.001


def test_constant_bakes_to_itself(torus_bake):
    np.testing.assert_allclose(torus_bake[-1].values["metallic"], 0.25, atol=1e-6)


def test_normal_map_decodes_to_the_fine_normals(torus_bake):
    target, texels, _, _, _, baked = torus_bake
    points, frames = points_at(target, texels.face_idx, texels.barycentric)
    decoded = decode_tangent_space(frames, np.rint((baked.values["tangent_normal"] * 0.5 + 0.5) * 255) / 255 * 2 - 1)
    _, truth = nearest_on_torus(points)
    angle = np.degrees(np.arccos(np.clip((decoded * truth).sum(1), -1, 1)))[: texels.inside]
    assert angle.mean() < 0.5
    assert angle.max() < 4
    flat = frames[..., 2] / np.linalg.norm(frames[..., 2], axis=1, keepdims=True)
    unbaked = np.degrees(np.arccos(np.clip((flat * truth).sum(1), -1, 1)))
    assert angle.mean() < 0.7 * unbaked.mean()
    assert (baked.values["tangent_normal"][:, 2] > 0.7).all()


def test_supersampling_is_nearer_the_texel_mean_and_only_where_values_vary(torus_bake):
    target, texels, source, _, reach, _ = torus_bake

    # The upper half has stripes finer than a texel, whose mean is one half; the lower half is one half everywhere.
    def stripes(places):
        y = source.at(places.face_idx, places.barycentric, source.mesh.vertices)[:, 1:2]
        count = len(places.face_idx)
        return {
            "albedo": np.repeat(np.where(y > 0, (np.sin(900 * y) > 0) * 1.0, 0.5), 3, 1),
            "roughness": np.full(count, 0.5),
            "metallic": np.zeros(count),
            "normal": source.face_normals[places.face_idx],
        }

    single = bake(target, texels, source, stripes, reach).values["albedo"][: texels.inside]
    many = bake(target, texels, source, stripes, reach, BakeOptions(samples=16))
    assert np.abs(many.values["albedo"][: texels.inside] - 0.5).mean() < 0.7 * np.abs(single - 0.5).mean()
    assert 0.4 < many.report["supersampled_share"] < 0.9


def test_thin_wall_does_not_bleed_through():
    # A plate 0.4 % thick, red above and blue below; the baked mesh is off by twice its thickness.
    vertices = np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
    top, bottom = vertices + (0, 0.002, 0), vertices - (0, 0.002, 0)
    up, down = np.array([[0, 2, 1], [0, 3, 2]]), np.array([[4, 5, 6], [4, 6, 7]])
    source = Source(TriMesh(np.concatenate([top, bottom]), np.concatenate([up, down])))
    albedo = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], 4, 0)
    lookup = vertex_lookup(
        source,
        {"albedo": albedo, "roughness": np.ones(8), "metallic": np.zeros(8)},
        np.repeat([[0, 1.0, 0], [0, -1.0, 0]], 4, 0),
    )
    for off in (-0.008, 0.008):
        low = np.concatenate([top + (0, off, 0), bottom - (0, off, 0)])
        uv = np.array(
            [[0.05, 0.1], [0.45, 0.1], [0.45, 0.9], [0.05, 0.9], [0.55, 0.1], [0.95, 0.1], [0.95, 0.9], [0.55, 0.9]]
        )
        faces = np.concatenate([up, down])
        target = Target.of(TriMesh(low, faces), uv, faces)
        texels = texels_of(target, 64)
        baked = bake(target, texels, source, lookup, cage_offsets(TriMesh(low, faces), source))
        expected = np.where((texels.face_idx < 2)[:, None], [1.0, 0, 0], [0, 0, 1.0])
        np.testing.assert_allclose(baked.values["albedo"], expected, atol=1e-6)


def test_a_chart_smaller_than_a_texel_has_its_own_color():
    """A blue triangle whose chart covers no texel's centre, beside the chart of a red square: its lookups are blue."""
    vertices = np.array(
        [
            [-0.5, 0, -0.5],
            [0.5, 0, -0.5],
            [0.5, 0, 0.5],
            [-0.5, 0, 0.5],
            [-0.01, 0.3, 0],
            [0, 0.3, 0.01],
            [0.01, 0.3, 0],
        ]
    )
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6]])
    uv = np.array(
        [[0.1, 0.1], [0.5, 0.1], [0.5, 0.5], [0.1, 0.5], *((np.array([[40.1, 20.7], [40.4, 20.7], [40.1, 20.9]])) / 64)]
    )
    target, source = Target.of(TriMesh(vertices, faces), uv, faces), Source(TriMesh(vertices, faces))
    albedo = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], [4, 3], 0)
    lookup = vertex_lookup(
        source, {"albedo": albedo, "roughness": np.ones(7), "metallic": np.zeros(7)}, np.repeat([[0, 1.0, 0]], 7, 0)
    )
    texels = texels_of(target, 64)
    baked = bake(target, texels, source, lookup, cage_offsets(TriMesh(vertices, faces), source))
    image = make_maps(texels, baked.values).base_color
    assert rasterize_uv(uv, faces, 64)[0].max() == 1
    np.testing.assert_array_equal(image[19:23, 39:43], np.broadcast_to([0, 0, 255], (4, 4, 3)))
    np.testing.assert_array_equal(image[7:31, 7:31], np.broadcast_to([255, 0, 0], (24, 24, 3)))


def test_every_covered_texel_is_read_and_ring_texels_continue_the_chart(torus_bake):
    target, texels, _, _, _, baked = torus_bake
    owner, _ = rasterize_uv(target.uv, target.face_uvs, 256)
    np.testing.assert_array_equal(texels.mask(inside_only=True), owner >= 0)
    assert all(np.isfinite(v).all() for v in baked.values.values())
    at, _ = nearest_on_torus(positions(target, texels)[texels.inside :])
    assert psnr(baked.values["albedo"][texels.inside :], albedo_of(at)) > 35


def test_corner_normals_are_smooth_on_a_sphere_and_split_on_a_cube():
    vertices, faces = sphere(4)
    np.testing.assert_allclose(corner_normals(TriMesh(vertices, faces)), 2 * vertices[faces], atol=0.02)
    cube = np.array([[a, b, c] for a in (0, 1.0) for b in (0, 1.0) for c in (0, 1.0)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    normals = corner_normals(TriMesh(cube, triangles_of(quads)))
    np.testing.assert_allclose(np.abs(normals).max(-1), 1, atol=1e-12)
    joined = corner_normals(TriMesh(cube, triangles_of(quads)), crease_degrees=120)
    np.testing.assert_allclose(np.abs(joined), 3**-0.5, atol=1e-9)


def test_ambient_visibility_of_a_plane_a_corner_and_a_box():
    plane = np.array([[-50.0, 0, -50], [50, 0, -50], [50, 0, 50], [-50, 0, 50]])
    wall = np.array([[0.0, 0, -50], [0, 50, -50], [0, 50, 50], [0, 0, 50]])
    quad = np.array([[0, 2, 1], [0, 3, 2]])
    source = Source(TriMesh(np.concatenate([plane, wall]), np.concatenate([quad, quad + 4])))
    points = np.array([[0.05, 0, 0.0], [0.05, 0, 1.0], [0.05, 0, -1.0]])
    up = np.tile([0.0, 1, 0], (3, 1))
    # An infinite wall at right angles hides half of the cosine-weighted hemisphere.
    np.testing.assert_allclose(ambient_visibility(points, up, source.caster, 4096, 0), 0.5, atol=0.01)
    np.testing.assert_allclose(ambient_visibility(points + (25, 0, 0), up, source.caster, 64, 0, reach=1.0), 1)
    vertices, faces = sphere(2)
    inside = Source(TriMesh(vertices, faces[:, ::-1]))
    assert ambient_visibility(np.zeros((1, 3)), np.array([[0, 1.0, 0]]), inside.caster, 64, 0)[0] == 0


def test_occlusion_of_a_torus_agrees_with_many_rays_and_repeats(torus_bake):
    target, texels, source, _, reach, _ = torus_bake
    normals = torus(240, 140)[2]
    run = lambda rays, seed, scale: bake_occlusion(  # noqa: E731
        target, texels, occlusion_tracer(target, source, reach, normals, rays, seed), scale
    )
    first, again = run(64, 3, 4), run(64, 3, 4)
    np.testing.assert_array_equal(first, again)
    truth = run(256, 9, 1)
    difference = (first - truth)[: texels.inside]
    assert np.sqrt((difference**2).mean()) < 0.03
    at = positions(target, texels)
    around = np.linalg.norm(at[:, [0, 2]], axis=1)
    assert first[(around > 0.45) & (np.abs(at[:, 1]) < 0.02)].mean() > 0.97
    assert first[around < 0.23].mean() < 0.75
