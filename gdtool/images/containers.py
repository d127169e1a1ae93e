"""Whole or cut short, still or animated: what an image file's own structure says before a decoder sees it."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from gdtool.core.errors import InputError

PNG = b"\x89PNG\r\n\x1a\n"


def check_container(path: Path, head: bytes, file: BinaryIO) -> None:
    """Raise InputError for an empty, cut or animated file; head is its first 64 bytes, file is open for reading.

    Decoders print to stderr or fill with grey where a file ends early, so this looks first.
    """
    if not head:
        raise InputError(path, "is empty")
    if head.startswith(PNG):
        _check_png(path, file)
    elif head.startswith(b"\xff\xd8\xff"):
        _check_jpeg(path, file)
    elif head.startswith((b"GIF87a", b"GIF89a")):
        raise InputError(path, "is a GIF", "save one frame as PNG")
    elif head[:4] == b"RIFF" and head[8:12] == b"WEBP" and head[12:16] == b"VP8X" and head[20] & 2:
        raise InputError(path, "is an animation", "save one frame as a still")


def _check_png(path: Path, file: BinaryIO) -> None:
    """Each chunk's length and CRC up to IEND (PNG specification, section 5)."""
    file.seek(len(PNG))
    while True:
        header = file.read(8)
        if len(header) < 8:
            raise InputError(path, "is cut short (no end of the PNG)")
        length, kind = struct.unpack(">I4s", header)
        if length >= 1 << 31:
            raise InputError(path, "is damaged (a PNG chunk of impossible length)")
        body = file.read(length)
        crc = file.read(4)
        if len(body) < length or len(crc) < 4:
            raise InputError(path, "is cut short (no end of the PNG)")
        if zlib.crc32(body, zlib.crc32(kind)) != struct.unpack(">I", crc)[0]:
            raise InputError(path, f"is damaged (bad checksum in the PNG's {kind.decode('latin-1')})")
        if kind == b"acTL" and length >= 4 and struct.unpack(">I", body[:4])[0] > 1:
            raise InputError(path, "is an animation", "save one frame as a still")
        if kind == b"IEND":
            return


def _check_jpeg(path: Path, file: BinaryIO) -> None:
    """That the scan begins and an end-of-image marker follows it (ITU-T T.81, annex B)."""
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
                raise InputError(path, "is cut short (no end of the JPEG)")
            return
    raise InputError(path, "is damaged or cut short (the JPEG has no picture)")
