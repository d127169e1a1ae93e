"""Encode and decode colors and normals."""

import numpy as np
import pytest

from gdtool.images.color import decode_normal, encode_normal, linear_from_srgb, rgba, srgb_from_linear


def test_srgb_known_values():
    # IEC 61966-2-1: mid grey, the knee, the ends
    np.testing.assert_allclose(
        srgb_from_linear(np.array([0, 0.0031308, 0.18, 1.0])), [0, 0.04045, 0.4613561, 1], atol=1e-6
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_srgb_round_trip(dtype):
    x = np.linspace(0, 1, 4097, dtype=dtype)
    back = linear_from_srgb(srgb_from_linear(x))
    assert back.dtype == dtype
    np.testing.assert_allclose(back, x, atol=3e-7 if dtype == np.float32 else 2e-8)


def test_eight_bit_codes_round_trip():
    codes = np.arange(256, dtype=np.uint8)
    linear = linear_from_srgb(codes)
    assert linear.dtype == np.float32
    assert (np.diff(linear) > 0).all()
    np.testing.assert_array_equal(np.rint(srgb_from_linear(linear) * 255), codes)


def test_normals_round_trip():
    n = np.random.default_rng(0).normal(size=(1000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    stored = np.rint(encode_normal(n) * 65535).astype(np.uint16)
    angle = np.degrees(np.arccos(np.clip((decode_normal(stored) * n).sum(1), -1, 1)))
    assert angle.max() < 0.03  # float32 arccos near 1; the stored step is 0.002 degrees


def test_the_middle_value_decodes_to_the_zero_vector():
    for middle in (np.full(3, 0.5), np.full(3, 128, np.uint8), np.full(3, 127, np.uint8), np.full(3, 32768, np.uint16)):
        assert (decode_normal(middle) == 0).all()


def test_rgba_spreads_grey():
    assert rgba(np.full((2, 2), 255, np.uint8)).shape == (2, 2, 4)
    np.testing.assert_allclose(rgba(np.array([[[0, 51]]], np.uint8))[0, 0], [0, 0, 0, 0.2])
    np.testing.assert_allclose(rgba(np.array([[[0, 51, 255]]], np.uint8))[0, 0], [0, 0.2, 1, 1])
