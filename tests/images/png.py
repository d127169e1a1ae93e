"""Build PNG files byte by byte, in forms that an encoder would not write."""

from __future__ import annotations

import struct
import zlib

import numpy as np

GREY, RGB, PALETTE, GREY_ALPHA, RGBA = 0, 2, 3, 4, 6


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(
    width: int, height: int, color: int, bits: int, scanlines: bytes, *, before: bytes = b"", interlaced: bool = False
) -> bytes:
    """Build a PNG of filtered scanlines (each with its filter byte); `before` holds chunks between IHDR and IDAT."""
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, int(interlaced))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + before
        + chunk(b"IDAT", zlib.compress(scanlines))
        + chunk(b"IEND", b"")
    )


def scanlines(image: np.ndarray) -> bytes:
    """Return the unfiltered scanlines of (h, w, c) uint8 or uint16."""
    rows = image.astype(image.dtype.newbyteorder(">")).tobytes()
    stride = len(rows) // len(image)
    return b"".join(b"\0" + rows[i * stride : (i + 1) * stride] for i in range(len(image)))


def adam7(image: np.ndarray) -> bytes:
    """Return the scanlines of an interlaced PNG in seven passes (PNG specification, section 8.2)."""
    passes = ((0, 0, 8, 8), (0, 4, 8, 8), (4, 0, 8, 4), (0, 2, 4, 4), (2, 0, 4, 2), (0, 1, 2, 2), (1, 0, 2, 1))
    parts = [image[y::dy, x::dx] for y, x, dy, dx in passes]
    return b"".join(scanlines(part) for part in parts if part.size)
