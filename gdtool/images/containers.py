"""Check the structure of an image file before a decoder sees it: is it complete, and a single still picture?"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from gdtool.core.errors import InputError, ResourceError

MAX_SIDE = 16384  # pixels
MAX_FILE_BYTES = 2 << 30  # of an image file: twice what the largest picture takes as stored
_BLOCK = 1 << 20  # bytes of a PNG's chunk at a time

COPY = "copy or download it again"

PNG = b"\x89PNG\r\n\x1a\n"


def check_container(path: Path, head: bytes, file: BinaryIO) -> None:
    """Raise InputError for an empty, truncated or animated file.

    Raises ResourceError for a PNG of too many pixels, or a file of too many bytes (MAX_FILE_BYTES). head: the first 64
    bytes. file: open for reading. Decoders print to stderr or fill with grey where a file ends early, so the structure
    is checked first.
    """
    if not head:
        raise InputError(path, "is empty", COPY)
    size = os.fstat(file.fileno()).st_size
    if size > MAX_FILE_BYTES:
        raise ResourceError(
            path,
            f"is a file of {size / 2**30:.1f} GiB, more than {MAX_FILE_BYTES >> 30} for a picture",
            "scale it down",
        )
    if head.startswith(PNG):
        _check_png(path, file)
    elif head.startswith(b"\xff\xd8\xff"):
        _check_jpeg(path, file)
    elif head.startswith((b"GIF87a", b"GIF89a")):
        raise InputError(path, "is a GIF", "save one frame as PNG")
    elif head[:4] == b"RIFF" and head[8:12] == b"WEBP" and head[12:16] == b"VP8X" and head[20] & 2:
        raise InputError(path, "is an animation", "save one frame as a still image")


def suffix_of(head: bytes) -> str:
    """Return the suffix of the format that the first bytes of an image belong to.

    Under a name with this suffix OpenImageIO tries that format first. Only then does its message say why decoding
    fails.
    """
    if head[:4] == b"RIFF":
        return ".webp" if head[8:12] == b"WEBP" else ""
    signatures = {
        PNG: ".png",
        b"\xff\xd8\xff": ".jpg",
        b"II*\0": ".tif",
        b"MM\0*": ".tif",
        b"v/1\x01": ".exr",
        b"#?": ".hdr",
        b"BM": ".bmp",
    }
    return next((suffix for signature, suffix in signatures.items() if head.startswith(signature)), "")


def _check_png(path: Path, file: BinaryIO) -> None:
    """Check each chunk's length and CRC up to IEND (PNG specification, section 5)."""
    file.seek(len(PNG))
    while True:
        header = file.read(8)
        if len(header) < 8:
            raise InputError(path, "is cut short (no end of the PNG)", COPY)
        length, kind = struct.unpack(">I4s", header)
        if length >= 1 << 31:
            raise InputError(path, "is damaged (a PNG chunk of impossible length)", COPY)
        body = file.read(min(length, _BLOCK))
        checksum, left = zlib.crc32(body, zlib.crc32(kind)), length - len(body)
        while left and (block := file.read(min(left, _BLOCK))):
            checksum, left = zlib.crc32(block, checksum), left - len(block)
        crc = file.read(4)
        if left or len(crc) < 4:
            raise InputError(path, "is cut short (no end of the PNG)", COPY)
        if checksum != struct.unpack(">I", crc)[0]:
            raise InputError(
                path,
                f"is damaged (bad checksum in the PNG's "
                f"{kind.decode() if kind.isalpha() and kind.isascii() else 'chunks'})",
                COPY,
            )
        if kind == b"IHDR" and length >= 8 and max(struct.unpack_from(">II", body)) > MAX_SIDE:
            raise ResourceError(
                path,
                "is {}x{} pixels, more than {} a side".format(*struct.unpack_from(">II", body), MAX_SIDE),
                "scale it down",
            )
        if kind == b"acTL" and length >= 4 and struct.unpack(">I", body[:4])[0] > 1:
            raise InputError(path, "is an animation", "save one frame as a still image")
        if kind == b"IEND":
            return


def _check_jpeg(path: Path, file: BinaryIO) -> None:
    """Check that the scan begins and an end-of-image marker follows it (ITU-T T.81, annex B)."""
    file.seek(0)
    content = file.read()
    at = 2
    while at + 4 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker == 0xD9:
            break
        at += 2 + struct.unpack_from(">H", content, at + 2)[0]
        if marker == 0xDA:
            if content.find(b"\xff\xd9", at) < 0:
                raise InputError(path, "is cut short (no end of the JPEG)", COPY)
            return
    raise InputError(path, "is damaged or cut short (the JPEG has no picture)", COPY)
