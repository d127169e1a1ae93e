"""Read binary PLY files of triangles as arrays: gdtool's own surfaces, and what most scanners write."""

from __future__ import annotations

import numpy as np

# Numpy's names of PLY's types.
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_binary_ply(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """View the bytes of a PLY as vertex records (v,), with the file's properties as fields, and triangles (f, 3).

    Raises ValueError, with the reason, for any file that is not binary with one vertex element of numbers followed by
    one face element of triangles.
    """
    end = data.find(b"end_header\n")
    header = data[: max(end, 0)].decode("ascii", "replace").split("\n")
    kind = header[1].split() if len(header) > 1 and header[0].strip() == "ply" else []
    if len(kind) != 3 or kind[0] != "format" or kind[1] not in _ORDERS:
        raise ValueError("is not a binary PLY")
    try:
        counts, vertex_type, face_type = _layout(header, _ORDERS[kind[1]])
    except (ValueError, IndexError, KeyError):  # a word missing, no number, a type or a property twice
        raise ValueError("needs one vertex element of numbers and then one face element with one list") from None
    start = end + len(b"end_header\n")
    size = counts["vertex"] * vertex_type.itemsize
    if len(data) - start != size + counts["face"] * face_type.itemsize:
        raise ValueError("does not have the length that its header says (faces must be triangles)")
    vertex = np.frombuffer(data, vertex_type, counts["vertex"], start)
    face = np.frombuffer(data, face_type, counts["face"], start + size)
    if len(face) and (face["count"] != 3).any():
        raise ValueError("has faces that are not triangles")
    return vertex, face["idx"]


def _layout(header: list[str], order: str) -> tuple[dict[str, int], np.dtype, np.dtype]:
    """Parse a header into the counts of elements and the record types of vertices and faces.

    order: the byte order, "<" or ">". Raises ValueError, IndexError or KeyError for any other layout.
    """
    counts: dict[str, int] = {}
    fields, lists, element = [], [], ""
    for line in header:
        words = line.split()
        if words[:1] == ["element"]:
            element, counts[words[1]] = words[1], int(words[2])
        elif words[:1] == ["property"]:
            if (words[1] == "list") != (element == "face"):
                raise ValueError(line)
            if element == "face":
                lists.append((words[2], words[3]))
            else:
                fields.append((words[2], order + _TYPES[words[1]]))
    if list(counts) != ["vertex", "face"] or min(counts.values()) < 0 or not fields or len(lists) != 1:
        raise ValueError(counts)
    face = [("count", order + _TYPES[lists[0][0]]), ("idx", order + _TYPES[lists[0][1]], 3)]
    return counts, np.dtype(fields), np.dtype(face)


def columns(records: np.ndarray, names: str) -> np.ndarray:
    """Stack fields of records, named in one string, as float64 (n, fields)."""
    return np.stack([records[name] for name in names.split()], -1).astype(np.float64)
