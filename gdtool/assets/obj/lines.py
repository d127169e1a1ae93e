"""Parse the lines of a Wavefront OBJ file into arrays.

Large files come from exporters that write all lines of a kind alike, so numpy parses each kind at once. Any other file
is parsed line by line, which is slower and tells which line is wrong.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.memory import require_memory
from gdtool.core.reading import bytes_of, require_regular_file

# Peak bytes of reading for each byte of the file, arrays included: measured on grids of 90,000 vertices.
HELD_PER_BYTE = 11
_MAX_INDEX = 2**31 - 1  # indices of a Scene are int32


@dataclass(frozen=True)
class ObjLines:
    """Hold the v, vt, vn, f, usemtl and mtllib lines of a file. Indices may still be out of range.

    vertices (v, 3); colors (k, 3) of the k vertices that have one; uvs (t, 2) with v up; normals (n, 3): all float64.
    corners (c, 3) int64, polygon after polygon: indices of vertex, texture coordinate and normal, counted from 0, -1
    where absent. sizes (p,): corners of each polygon, at least 3. groups (p,): its material's index in names, the first
    of which is "" (none). libraries: the arguments of mtllib lines in order.
    """

    vertices: np.ndarray
    colors: np.ndarray
    uvs: np.ndarray
    normals: np.ndarray
    corners: np.ndarray
    sizes: np.ndarray
    groups: np.ndarray
    names: tuple[str, ...]
    libraries: tuple[str, ...]


def read_lines(path: Path) -> ObjLines:
    """Read an OBJ file. Raises InputError with the number of the line that is wrong, OutputError, ResourceError."""
    require_regular_file(path)
    require_memory(
        path.stat().st_size * HELD_PER_BYTE, path, "its content", "simplify it or split it into several files"
    )
    data = bytes_of(path)
    lines = parse_uniform(data)
    if lines is None:
        lines = parse_each(data.decode("utf-8", "replace"), path)
    if not len(lines.sizes):
        raise InputError(path, "has no faces", "export the model with its faces")
    return lines


@dataclass
class _MaterialNames:
    """Collect usemtl and mtllib lines in order; current is the index of the material in force."""

    indices: dict[str, int] = field(default_factory=lambda: {"": 0})
    libraries: list[str] = field(default_factory=list)
    current: int = 0

    def add_line(self, words: list[str], line: str) -> None:
        """Take a line, given as words too; lines with other keywords are ignored."""
        if words[0] == "usemtl":
            self.current = self.indices.setdefault(" ".join(words[1:]), len(self.indices))
        elif words[0] == "mtllib":
            self.libraries.append(line.split(None, 1)[1].strip())


def parse_each(text: str, path: Path) -> ObjLines:
    """Parse a file line by line. Raises InputError with the number of the line that is wrong."""
    vertices: list[tuple[float, ...]] = []
    colors: list[tuple[float, ...]] = []
    uvs: list[tuple[float, float]] = []
    normals: list[tuple[float, ...]] = []
    corners: list[_Corner] = []
    sizes: list[int] = []
    groups: list[int] = []
    names = _MaterialNames()
    carried = ""  # of lines that end with a backslash, which the next line continues
    for number, line in enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), 1):
        if line.endswith("\\"):
            carried += line[:-1] + " "
            continue
        words, carried = (carried + line).split(), ""
        if not words:
            continue
        key = words[0]
        try:
            if key == "v":
                vertices.append((float(words[1]), float(words[2]), float(words[3])))
                if len(words) >= 7:
                    colors.append((float(words[4]), float(words[5]), float(words[6])))
            elif key == "vt":
                uvs.append((float(words[1]), float(words[2]) if len(words) > 2 else 1.0))
            elif key == "vn":
                normals.append((float(words[1]), float(words[2]), float(words[3])))
            elif key == "f":
                counts = len(vertices), len(uvs), len(normals)
                if len(words) < 4:
                    raise ValueError("a face has fewer than three corners")
                corners += [_corner(word, counts) for word in words[1:]]
                sizes.append(len(words) - 1)
                groups.append(names.current)
            else:
                names.add_line(words, line)
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(
                path, f"line {number} is not valid OBJ ({str(error)[:120]})", "correct that line or export it again"
            ) from None
    return ObjLines(
        np.array(vertices, np.float64).reshape(-1, 3),
        np.array(colors, np.float64).reshape(-1, 3),
        np.array(uvs, np.float64).reshape(-1, 2),
        np.array(normals, np.float64).reshape(-1, 3),
        np.array(corners, np.int64).reshape(-1, 3),
        np.array(sizes, np.int64),
        np.array(groups, np.int64),
        tuple(names.indices),
        tuple(names.libraries),
    )


class _Corner(NamedTuple):
    """Hold the indices of a polygon's corner, counted from 0, -1 where absent."""

    vertex: int
    uv: int
    normal: int


def _corner(word: str, counts: tuple[int, int, int]) -> _Corner:
    """Parse v/vt/vn. counts: the v, vt and vn lines so far, from whose end negative indices count."""
    indices = [-1, -1, -1]
    for i, part in enumerate(word.split("/")):
        if part:
            index = int(part)
            indices[i] = index - 1 if index > 0 else counts[i] + index
            if index == 0 or not 0 <= indices[i] < _MAX_INDEX:
                raise ValueError(f"index {index} is out of range")
    if indices[0] < 0:
        raise ValueError("a corner has no vertex")
    return _Corner(*indices)


class _NotUniformError(Exception):
    """Report that lines of one kind differ in form, or that one of them is wrong."""


class _Payload(NamedTuple):
    """Hold the lines of one kind: their bytes, keywords replaced by blanks, and the offset of each line in them."""

    text: np.ndarray
    begins: np.ndarray


def parse_uniform(data: bytes) -> ObjLines | None:
    """Parse all lines of a kind at once; None where they differ in form or one is wrong (`parse_each` tells which)."""
    if b"\\\n" in data or b"\r" in data and (b"\\\r" in data or data.count(b"\r") != data.count(b"\r\n")):
        return None
    text = np.frombuffer(data + b"\n", np.uint8)
    ends = np.flatnonzero(text == ord("\n"))
    starts = np.concatenate([[0], ends[:-1] + 1])
    first, second = text[starts], text[np.minimum(starts + 1, len(text) - 1)]
    two_letters = np.isin(second, (ord("t"), ord("n")))
    after_keyword = np.where(two_letters, text[np.minimum(starts + 2, len(text) - 1)], second)
    is_v, is_f = first == ord("v"), first == ord("f")
    indented = (first <= ord(" ")) & (first != ord("\n")) & (first != ord("\r"))
    if ((is_v | is_f) & (after_keyword != ord(" "))).any() or (is_f & two_letters).any() or indented.any():
        return None
    kinds = {"v": is_v & ~two_letters, "vt": is_v & (second == ord("t")), "vn": is_v & (second == ord("n")), "f": is_f}
    # Line numbers from which a material is in force, and that material.
    names, material_rows, material_of_row = _MaterialNames(), [0], [0]
    try:
        for row in np.flatnonzero((first == ord("u")) | (first == ord("m"))).tolist():
            line = data[starts[row] : ends[row]].decode("utf-8", "replace")
            names.add_line(line.split(), line)
            material_rows.append(row)
            material_of_row.append(names.current)
        payloads = {key: _payload(text, starts, ends, kinds[key], len(key)) for key in kinds}
        (vertices, colors), (uvs, _), (normals, _) = (
            _numbers(payloads[key], width) for key, width in (("v", 3), ("vt", 2), ("vn", 3))
        )
        rows = np.flatnonzero(is_f)
        corners, sizes = _corners(payloads["f"], [np.cumsum(kinds[key])[rows] for key in ("v", "vt", "vn")])
    except (_NotUniformError, IndexError):
        return None
    groups = np.array(material_of_row, np.int64)[np.searchsorted(material_rows, rows, "right") - 1]
    return ObjLines(
        vertices, colors, uvs, normals, corners, sizes, groups, tuple(names.indices), tuple(names.libraries)
    )


def _payload(text: np.ndarray, starts: np.ndarray, ends: np.ndarray, rows: np.ndarray, letters: int) -> _Payload:
    """Copy the bytes of the lines where rows (lines,) is true, and replace their keywords by blanks.

    starts, ends (lines,): byte offsets of the lines in text. letters: the length of the keyword.
    """
    which = np.flatnonzero(rows)
    begins, lengths = starts[which], ends[which] - starts[which] + 1
    if len(which) and which[-1] - which[0] == len(which) - 1:  # consecutive lines
        copy, begins = text[begins[0] : begins[0] + lengths.sum()].copy(), begins - begins[0]
    elif len(which):
        copy, begins = text[np.repeat(rows, ends - starts + 1)], np.cumsum(lengths) - lengths
    else:
        copy = text[:0].copy()
    for i in range(letters):
        copy[begins + i] = ord(" ")
    return _Payload(copy, begins)


def _words(text: np.ndarray) -> np.ndarray:
    """Find where each word of some bytes begins."""
    inside = text > ord(" ")
    inside[1:] &= ~inside[:-1]  # safe in place: numpy copies operands that overlap
    return np.flatnonzero(inside)


def _word_table(words: np.ndarray, begins: np.ndarray) -> np.ndarray | None:
    """Arrange words (w,) as (lines, words of a line); None where lines have different numbers of words."""
    if not len(begins) or len(words) % len(begins):
        return None
    table = words.reshape(len(begins), -1)
    return None if not table.size or (table[:, 0] < begins).any() or (table[:-1, -1] >= begins[1:]).any() else table


def _parsed(text: np.ndarray, kind: type, count: int) -> np.ndarray:
    """Parse bytes as `count` numbers. Raises _NotUniformError."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            numbers: np.ndarray = np.fromstring(text.tobytes(), kind, sep=" ")
        except (DeprecationWarning, ValueError):
            raise _NotUniformError from None
    if len(numbers) != count:
        raise _NotUniformError
    return numbers


def _numbers(payload: _Payload, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Parse the first `width` numbers of each line as (lines, width), float64.

    Also returns the fourth to sixth numbers (lines, 3), the colors of vertices, where every line has six; else (0, 3).
    """
    if not len(payload.begins):
        return np.empty((0, width)), np.empty((0, 3))
    table = _word_table(_words(payload.text), payload.begins)
    if table is None or table.shape[1] < width:
        raise _NotUniformError
    numbers = _parsed(payload.text, np.float64, table.size).reshape(table.shape)
    return numbers[:, :width].copy(), numbers[:, 3:6].copy() if table.shape[1] >= 6 else np.empty((0, 3))


# Columns of ObjLines.corners that a corner fills, by its count of numbers, slashes, and slashes that follow a slash:
# v, v/vt, v//vn, v/vt/vn.
_CORNER_COLUMNS = {(1, 0, 0): [0], (2, 1, 0): [0, 1], (2, 2, 1): [0, 2], (3, 2, 0): [0, 1, 2]}


def _corners(payload: _Payload, counts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Parse face lines into corners (c, 3) and sizes (p,) of ObjLines.

    counts: for v, vt and vn, how many such lines come before each face line.
    """
    text = payload.text
    words = _words(text)
    if (table := _word_table(words, payload.begins)) is not None:
        sizes = np.full(len(payload.begins), table.shape[1])
    else:
        sizes = np.diff(np.searchsorted(words, payload.begins), append=len(words))
    if (sizes < 3).any():
        raise _NotUniformError
    if not len(words):
        return np.empty((0, 3), np.int64), sizes
    slash = text == ord("/")
    slashes, double_slashes, parts = int(slash.sum()), 0, words
    if slashes:
        double_slashes = int((slash[1:] & slash[:-1]).sum())
        text[slash] = ord(" ")
        parts = _words(text)
    per_corner, odd = divmod(len(parts), len(words))
    if odd or slashes % len(words) or double_slashes % len(words) or (parts[:: per_corner or 1] != words).any():
        raise _NotUniformError
    columns = _CORNER_COLUMNS.get((per_corner, slashes // len(words), double_slashes // len(words)))
    if columns is None:
        raise _NotUniformError
    numbers = _parsed(text, np.int64, len(parts)).reshape(-1, per_corner)
    corners = np.full((len(words), 3), -1, np.int64)
    for column, indices in zip(columns, numbers.T, strict=True):
        if (indices < 0).any():
            corners[:, column] = np.where(indices > 0, indices - 1, indices + np.repeat(counts[column], sizes))
        else:
            corners[:, column] = indices - 1
        if (indices == 0).any() or (corners[:, column] < 0).any() or indices.max() >= _MAX_INDEX:
            raise _NotUniformError
    return corners, sizes
