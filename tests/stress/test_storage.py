"""Sweeps of what is read and stored: texture levels, tangent frames, texels' owners, quantisation, sRGB."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdtool.assets.scene import Texture
from gdtool.bake.maps import quantise
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.tangents import corner_tangents
from gdtool.geometry.uv_raster import owner_count
from gdtool.images.color import decode_normal, encode_normal, linear_from_srgb, srgb_from_linear
from gdtool.images.io import read_image, write_png
from gdtool.shading.render.textures import TextureReader
from gdtool.shading.sampling import orthonormal_basis
from tests.geometry.test_uv_raster import exact_owner

settings.register_profile("stress", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("stress")


def test_texture_levels():
    """A texture whose levels hold their own number tells which one is read."""
    reader = TextureReader(Texture(np.zeros((256, 256, 3), np.uint8)))
    top = reader.depth - 1
    reader.level(top)
    reader.levels = [np.full_like(x, k) for k, x in enumerate(reader.levels, 1)]
    widths = np.concatenate([[0.0, 1e-30, math.nan, math.inf], np.geomspace(0.1, 1e9, 4001)])
    got = reader.read(np.full((len(widths), 2), 0.5), widths)[:, 0]
    wanted = np.array([0.0, 0, 0, 1e9, *(float(mpmath.log(w, 2)) + 0.25 for w in widths[4:])])
    low, high = (np.clip(np.floor(wanted + d), 0, top) for d in (-0.01, 0.01))
    assert ((got == low) | (got == high)).all()


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 3), (5, 8), (7, 1), (13, 6), (255, 257), (640, 2)])
def test_levels_of_any_size_are_means_by_area(size, encoding):
    """Each level against the one before, averaged by exact areas in float64; so the last is the mean of the whole."""
    image = np.random.default_rng(0).integers(0, 256, (*size, 4), np.uint8)
    reader = TextureReader(Texture(image, encoding))
    finer = reader.level(0).astype(np.float64)
    mean = finer.mean((0, 1))
    for k in range(1, reader.depth):
        height, width = (max(n // 2, 1) for n in finer.shape[:2])
        wanted = by_area(by_area(finer, height).swapaxes(0, 1), width).swapaxes(0, 1)
        got = reader.level(k)
        assert got.shape == (height, width, 4)
        np.testing.assert_allclose(got, wanted, atol=2e-7)
        finer = got.astype(np.float64)
    np.testing.assert_allclose(finer.reshape(-1, 4), mean[None], atol=1e-6)


def by_area(values: np.ndarray, count: int) -> np.ndarray:
    """(count, ...) means of `values` (n, ...) over equal parts of its rows, rows cut where the parts' borders are."""
    borders = np.arange(count + 1)[:, None] * (len(values) / count)
    row = np.arange(len(values))
    covered = np.clip(np.minimum(borders[1:], row + 1) - np.maximum(borders[:-1], row), 0, None)
    return np.tensordot(covered * (count / len(values)), values, 1)


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("filtering", ["linear", "nearest"])
def test_lookups_stay_within_the_texture_whatever_the_coordinates(wrap, filtering):
    image = np.random.default_rng(0).integers(40, 200, (5, 7, 3), np.uint8)
    reader = TextureReader(Texture(image, wrap_u=wrap, wrap_v=wrap, filter=filtering))
    u, v = (
        x.ravel()
        for x in np.meshgrid(
            *[
                [
                    -1e30,
                    -1e9,
                    -2.0,
                    -1.0,
                    -1e-17,
                    0.0,
                    0.5,
                    1 - 1e-17,
                    1.0,
                    1.5,
                    1e9,
                    1e30,
                    math.nan,
                    math.inf,
                    -math.inf,
                ]
            ]
            * 2
        )
    )
    value = reader.read(np.stack([u, v], 1))
    assert np.isfinite(value).all()
    assert value.min() >= 40 / 255 - 1e-6
    assert value.max() <= 200 / 255 + 1e-6


def test_frames_are_unit_square_and_handed():
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    directions[:12] = [
        [0, 0, 1],
        [0, 0, -1],
        [1e-8, 0, -1],
        [0, -1e-8, -1],
        [1e-4, 1e-4, -1],
        [1, 0, 0],
        [0, 1, 0],
        [-1, 0, 0],
        [0, -1, 0],
        [1, 0, -1e-30],
        [1, 0, -0.0],
        [0.7, 0.7, -1e-12],
    ]
    n = torch.tensor(directions / np.linalg.norm(directions, axis=1, keepdims=True), dtype=torch.float32)
    tangent, bitangent = (
        torch.stack([c.expand(len(n)) for c in v], 1).double() for v in orthonormal_basis(*n.unbind(1))
    )
    normal = n.double()
    for a, b, wanted in (
        (tangent, tangent, 1),
        (bitangent, bitangent, 1),
        (tangent, bitangent, 0),
        (tangent, normal, 0),
        (bitangent, normal, 0),
    ):
        assert float(((a * b).sum(1) - wanted).abs().max()) <= 1e-6
    assert float((torch.linalg.cross(tangent, bitangent) - normal).abs().max()) <= 1e-6


def test_tangents_without_texture_area():
    """Faces whose texture coordinates or corners coincide still get a frame: unit, square to the normal, handed."""
    rng = np.random.default_rng(1)
    vertices = np.concatenate([rng.normal(size=(30, 3)), np.zeros((3, 3))])
    faces = np.concatenate([rng.integers(0, 30, (40, 3)), [[30, 31, 32], [0, 0, 1]]])
    normals = rng.normal(size=(33, 3))
    normals[:2] = [[0, 0, -1], [0, 0, 1]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = rng.random((33, 2))
    uv[:15] = 0.25
    out = corner_tangents(TriMesh(vertices, faces), normals, uv, faces).astype(np.float64)
    assert np.isfinite(out).all()
    assert set(np.unique(out[..., 3])) <= {-1.0, 1.0}
    assert np.abs(np.linalg.norm(out[..., :3], axis=-1) - 1).max() <= 1e-6
    assert np.abs((out[..., :3] * normals[faces]).sum(-1)).max() <= 1e-6


# Twelfths of a 12-texel map: corners land on texel borders and centres, edges on rows of centres.
CORNERS = st.tuples(st.integers(0, 48), st.integers(0, 48))


@settings(max_examples=25)
@given(CORNERS)
def test_texels_around_a_shared_vertex_have_one_owner(place):
    """Four triangles about a point of the map, wherever it is, cover each texel once; and as rational arithmetic
    says."""
    uv = np.array([[0, 0], [48, 0], [48, 48], [0, 48], place]) / 48
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    assert (owner_count(uv, faces, 12) == 1).all()
    from gdtool.geometry.uv_raster import rasterize_uv

    np.testing.assert_array_equal(rasterize_uv(uv, faces, 12)[0], exact_owner(uv, faces, 12))


def test_what_is_not_finite_is_not_stored(tmp_path):
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            write_png(tmp_path / "x.png", np.full((2, 2), bad, np.float32))
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize("bits", [8, 16])
def test_quantisation_is_within_half_a_step(bits, tmp_path):
    top = 2**bits - 1
    steps = np.arange(top + 1) / top
    x = np.concatenate([np.random.default_rng(0).random(20_000), steps, [-1.0, 2.0, -np.inf, np.inf]]).astype(
        np.float32
    )
    stored = quantise(x, bits).astype(np.float64) / top
    assert np.abs(stored - np.clip(x.astype(np.float64), 0, 1)).max() <= 0.5 / top + 6e-8
    np.testing.assert_array_equal(quantise(steps.astype(np.float32), bits), np.arange(top + 1))
    image = np.clip(x[:20_000], 0, 1).reshape(100, 200)
    write_png(tmp_path / "x.png", image, bits=bits)
    assert np.abs(read_image(tmp_path / "x.png").reshape(100, 200) / top - image).max() <= 0.5 / top + 6e-8


def test_sixteen_bit_normals_and_depths():
    """8-bit xyz errs by 0.38°, 16 bits by next to nothing; depth over 3 units by 4.6e-5 in 16 bits."""
    n = np.random.default_rng(0).normal(size=(50_000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    worst = {}
    for bits in (8, 16):
        back = decode_normal(quantise(encode_normal(n), bits).astype(np.float64) / (2**bits - 1))
        worst[bits] = np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(back - n, axis=1))).max()
    assert worst[8] < 0.45
    assert worst[16] < 0.0018


def test_srgb_against_forty_digits():
    values = np.concatenate([np.linspace(0, 1, 401), [0.0031308, 0.0031309, 0.04045, 0.04046, 1e-30]]).astype(
        np.float32
    )
    with mpmath.workdps(40):
        encoded = [
            12.92 * mpmath.mpf(float(x))
            if x <= 0.0031308
            else 1.055 * mpmath.mpf(float(x)) ** (mpmath.mpf(1) / mpmath.mpf("2.4")) - 0.055
            for x in values
        ]
        linear = [
            mpmath.mpf(float(x)) / 12.92
            if x <= 0.04045
            else ((mpmath.mpf(float(x)) + 0.055) / 1.055) ** mpmath.mpf("2.4")
            for x in values
        ]
    assert np.abs(srgb_from_linear(values).astype(np.float64) - np.array(encoded, float)).max() <= 3e-7
    assert np.abs(linear_from_srgb(values).astype(np.float64) - np.array(linear, float)).max() <= 3e-7
