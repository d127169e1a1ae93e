"""What is stored as a map, what as a factor, and what is left out."""

import numpy as np
import pytest

from gdtool.bake.maps import MapOptions, constant_of, contact_sheet_of, directx, flat_angle, make_maps, quantise
from gdtool.bake.target import Target, texels_of
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.uv_raster import rasterize_uv


@pytest.fixture
def texels():
    """Rasterise a square chart into a map of 64 x 64."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
    uv = np.array([[0.2, 0.8], [0.8, 0.8], [0.8, 0.2], [0.2, 0.2]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    assert (rasterize_uv(uv, faces, 64)[0] >= 0).any()
    return texels_of(Target.of(TriMesh(vertices, faces), uv, faces), 64)


def values(texels, albedo=(0.5, 0.2, 0.1), roughness=0.4, metallic=0.0, normal=(0.0, 0.0, 1.0)):
    """Make values of texels, constant over all of them."""
    n = len(texels)
    fill = lambda v: np.ascontiguousarray(np.broadcast_to(np.asarray(v, np.float32), (n, *np.shape(v))))  # noqa: E731
    return {
        "albedo": fill(albedo),
        "roughness": fill(roughness),
        "metallic": fill(metallic),
        "tangent_normal": fill(normal),
    }


def test_constants_become_factors(texels):
    maps = make_maps(texels, values(texels), np.ones(len(texels), np.float32))
    assert maps.base_color is None
    assert maps.orm is None
    assert maps.normal is None
    np.testing.assert_allclose(maps.factors["base_color"], (0.5, 0.2, 0.1, 1.0), atol=1e-5)
    assert maps.factors["roughness"] == (pytest.approx(0.4),)
    assert maps.factors["metallic"] == (0.0,)
    assert {what for what, _, _ in maps.skipped} == {
        "base_color map",
        "roughness and metallic map",
        "occlusion map",
        "normal map",
    }
    assert contact_sheet_of(maps).dtype == np.uint8


def test_orm_is_packed_as_in_gltf_and_a_constant_channel_is_a_factor(texels):
    inputs = values(texels)
    inputs["roughness"] = np.linspace(0.2, 0.8, len(texels), dtype=np.float32)
    occlusion = np.full(len(texels), 0.5, np.float32)
    maps = make_maps(texels, inputs, occlusion)
    assert maps.factors["roughness"] == (1.0,)
    assert maps.factors["metallic"] == (0.0,)
    inside = maps.orm.reshape(-1, 3)[texels.texel]
    np.testing.assert_array_equal(inside[:, 0], 128)
    np.testing.assert_allclose(inside[:, 1] / 255, inputs["roughness"], atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(inside[:, 2], 255)  # times the factor 0
    assert maps.has_occlusion
    assert maps.has_roughness_metallic


def test_base_color_is_srgb_and_gutters_hold_no_black(texels):
    inputs = values(texels)
    inputs["albedo"][: len(texels) // 2] = (0.2158605, 0.9, 0.9)
    maps = make_maps(texels, inputs)
    stored = maps.base_color.reshape(-1, 3)
    assert stored[texels.texel[0], 0] == 128  # IEC 61966-2-1
    assert maps.base_color.min() > 80
    assert not maps.has_occlusion


def test_alpha_is_kept_and_opaque_alpha_dropped(texels):
    inputs = values(texels)
    inputs["alpha"] = np.ones(len(texels), np.float32)
    assert make_maps(texels, inputs).base_color is None
    inputs["alpha"] = np.where(np.arange(len(texels)) % 2, 1, 0.25).astype(np.float32)
    maps = make_maps(texels, inputs)
    assert maps.base_color.shape[2] == 4
    assert set(np.unique(maps.base_color.reshape(-1, 4)[texels.texel][:, 3])) == {64, 255}


@pytest.mark.parametrize("least", [0.5 / 255, 0.5])
def test_color_that_is_never_seen_darkens_no_neighbour(texels, least):
    """Leaves cut out of black: texels with alpha below the limit are stored in the color of their surroundings."""
    inputs, hidden = values(texels), np.arange(len(texels)) % 5 < 2
    inputs["albedo"][:] = (0.2, 0.5, 0.3)
    inputs["albedo"][hidden] = 0
    inputs["alpha"] = np.where(hidden, 0.9 * least, 1).astype(np.float32)
    stored = make_maps(texels, inputs, options=MapOptions(least_alpha=least)).base_color
    at = stored.reshape(-1, 4)[texels.texel]
    np.testing.assert_array_equal(at[:, :3], np.tile(at[~hidden][0, :3], (len(at), 1)))
    assert stored[..., :3].min() > 100
    np.testing.assert_array_equal(at[:, 3], np.rint(inputs["alpha"] * 255))
    inputs["alpha"][hidden] = 1.1 * least + 0.01  # visible, so the color stays
    at = make_maps(texels, inputs, options=MapOptions(least_alpha=least)).base_color.reshape(-1, 4)[texels.texel]
    assert at[hidden][:, :3].max() == 0


def test_a_normal_map_is_stored_only_where_it_is_not_flat(texels):
    tilt = lambda degrees: (np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees)))  # noqa: E731
    assert make_maps(texels, values(texels, normal=tilt(0.8))).normal is None
    assert make_maps(texels, values(texels, normal=tilt(0.8)), options=MapOptions(normal_map="on")).normal is not None
    assert make_maps(texels, values(texels, normal=tilt(5)), options=MapOptions(normal_map="off")).normal is None
    maps = make_maps(texels, values(texels, normal=tilt(5)), options=MapOptions(bits=16))
    assert maps.normal.dtype == np.uint16
    decoded = maps.normal.reshape(-1, 3)[texels.texel] / 65535 * 2 - 1
    np.testing.assert_allclose(decoded, np.tile(tilt(5), (len(texels), 1)), atol=4e-5)
    assert flat_angle(np.tile(tilt(3), (9, 1))) == pytest.approx(3)


def test_directx_inverts_green_only():
    image = np.array([[[10, 20, 30]]], np.uint8)
    np.testing.assert_array_equal(directx(image), [[[10, 235, 30]]])
    np.testing.assert_array_equal(directx(directx(image)), image)


def test_quantising_rounds_to_the_nearest_step():
    np.testing.assert_array_equal(quantise(np.array([-1, 0, 0.5 / 255 + 1e-6, 1, 2]), 8), [0, 0, 1, 255, 255])
    x = np.linspace(0, 1, 1000)
    assert np.abs(quantise(x, 16) / 65535 - x).max() <= 0.5 / 65535 + 1e-9


def test_constant_of():
    assert constant_of(np.array([0.1, 0.2])) is None
    np.testing.assert_allclose(constant_of(np.array([[0.5, 0.1], [0.502, 0.1]])), [0.501, 0.1])
    assert constant_of(np.zeros((0, 3))) is None
