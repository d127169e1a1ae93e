"""What the lines of a Wavefront OBJ say: all lines of a kind at once where they are alike, one by one where they are
not."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.memory import require_memory
from gdtool.core.reading import bytes_of, require_regular_file

# Bytes that a byte of the file takes while it is read, with its arrays: measured on grids of 90,000 vertices.
HELD_PER_BYTE = 11
_MOST = 2**31 - 1  # no file has as many vertices


@dataclass(frozen=True)
class ObjLines:
    """v, vt, vn, f, usemtl and mtllib lines; nothing is checked against anything else but that indices count from where
    they stand.

    vertices (v, 3), colors (k, 3) of those vertices that have one, uvs (t, 2) with v up, normals (n, 3), float64.
    corners (c, 3) int64, polygon after polygon: vertex, texture coordinate and normal, from 0, -1 where absent. sizes
    (p,) corners a polygon, at least 3; groups (p,) the material of each, into names, of which "" is the first;
    libraries as they come."""

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
    """Read an OBJ. Raises InputError, with the line that is wrong, and OutputError."""
    require_regular_file(path)
    require_memory(
        path.stat().st_size * HELD_PER_BYTE, path, "its content", "simplify it or split it into several files"
    )
    data = bytes_of(path)
    lines = _at_once(data)
    if lines is None:
        lines = _one_by_one(data.decode("utf-8", "replace"), path)
    if not len(lines.sizes):
        raise InputError(path, "has no faces", "export the model with its faces")
    return lines


@dataclass
class _Names:
    """usemtl and mtllib as they come."""

    places: dict[str, int] = field(default_factory=lambda: {"": 0})
    libraries: list[str] = field(default_factory=list)
    current: int = 0

    def take(self, words: list[str], line: str) -> None:
        if words[0] == "usemtl":
            self.current = self.places.setdefault(" ".join(words[1:]), len(self.places))
        elif words[0] == "mtllib":
            self.libraries.append(line.split(None, 1)[1].strip())


def _one_by_one(text: str, path: Path) -> ObjLines:
    vertices: list[tuple[float, ...]] = []
    colors: list[tuple[float, ...]] = []
    uvs: list[tuple[float, float]] = []
    normals: list[tuple[float, ...]] = []
    corners: list[tuple[int, int, int]] = []
    sizes: list[int] = []
    groups: list[int] = []
    names = _Names()
    carried = ""
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
                names.take(words, line)
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(
                path, f"line {number} is not what OBJ says ({str(error)[:120]})", "correct that line or export it again"
            ) from None
    return ObjLines(
        np.array(vertices, np.float64).reshape(-1, 3),
        np.array(colors, np.float64).reshape(-1, 3),
        np.array(uvs, np.float64).reshape(-1, 2),
        np.array(normals, np.float64).reshape(-1, 3),
        np.array(corners, np.int64).reshape(-1, 3),
        np.array(sizes, np.int64),
        np.array(groups, np.int64),
        tuple(names.places),
        tuple(names.libraries),
    )


def _corner(word: str, counts: tuple[int, int, int]) -> tuple[int, int, int]:
    """v/vt/vn as indices from 0, -1 where absent."""
    out = [-1, -1, -1]
    for i, part in enumerate(word.split("/")):
        if part:
            index = int(part)
            out[i] = index - 1 if index > 0 else counts[i] + index
            if index == 0 or not 0 <= out[i] < _MOST:
                raise ValueError(f"index {index} is out of range")
    if out[0] < 0:
        raise ValueError("a corner has no vertex")
    return out[0], out[1], out[2]


class _Unlike(Exception):
    """Lines of one kind differ, or one is not what it should be."""


def _at_once(data: bytes) -> ObjLines | None:
    """None where lines of one kind are not all alike, or any is wrong: which one, _one_by_one tells."""
    if b"\\\n" in data or b"\r" in data and (b"\\\r" in data or data.count(b"\r") != data.count(b"\r\n")):
        return None
    text = np.frombuffer(data + b"\n", np.uint8)
    ends = np.flatnonzero(text == ord("\n"))
    starts = np.concatenate([[0], ends[:-1] + 1])
    first, second = text[starts], text[np.minimum(starts + 1, len(text) - 1)]
    long = np.isin(second, (ord("t"), ord("n")))
    third = np.where(long, text[np.minimum(starts + 2, len(text) - 1)], second)
    of_v, of_f = first == ord("v"), first == ord("f")
    blank = (first <= ord(" ")) & (first != ord("\n")) & (first != ord("\r"))
    if ((of_v | of_f) & (third != ord(" "))).any() or (of_f & long).any() or blank.any():
        return None
    kinds = {"v": of_v & ~long, "vt": of_v & (second == ord("t")), "vn": of_v & (second == ord("n")), "f": of_f}
    names, at, group = _Names(), [0], [0]
    try:
        for row in np.flatnonzero((first == ord("u")) | (first == ord("m"))).tolist():
            line = data[starts[row] : ends[row]].decode("utf-8", "replace")
            names.take(line.split(), line)
            at.append(row)
            group.append(names.current)
        payloads = {key: _payload(text, starts, ends, kinds[key], len(key)) for key in kinds}
        (vertices, colors), (uvs, _), (normals, _) = (
            _numbers(*payloads[key], width) for key, width in (("v", 3), ("vt", 2), ("vn", 3))
        )
        rows = np.flatnonzero(of_f)
        corners, sizes = _corners(*payloads["f"], [np.cumsum(kinds[key])[rows] for key in ("v", "vt", "vn")])
    except (_Unlike, IndexError):
        return None
    groups = np.array(group, np.int64)[np.searchsorted(at, rows, "right") - 1]
    return ObjLines(vertices, colors, uvs, normals, corners, sizes, groups, tuple(names.places), tuple(names.libraries))


def _payload(
    text: np.ndarray, starts: np.ndarray, ends: np.ndarray, rows: np.ndarray, letters: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the bytes of some lines with their keys, of so many letters, blanked, and where each line begins there."""
    which = np.flatnonzero(rows)
    begin, length = starts[which], ends[which] - starts[which] + 1
    if len(which) and which[-1] - which[0] == len(which) - 1:  # one behind the other
        own, begin = text[begin[0] : begin[0] + length.sum()].copy(), begin - begin[0]
    else:
        own, begin = (
            text[np.repeat(rows, ends - starts + 1)] if len(which) else text[:0].copy(),
            np.cumsum(length) - length,
        )
    for i in range(letters):
        own[begin + i] = ord(" ")
    return own, begin


def _words(payload: np.ndarray) -> np.ndarray:
    """Where each word begins."""
    inside = payload > ord(" ")
    inside[1:] &= ~inside[:-1]  # read before it is written: numpy copies what overlaps
    return np.flatnonzero(inside)


def _alike(words: np.ndarray, begin: np.ndarray) -> np.ndarray | None:
    """Return the words (w,) of each of the lines (lines, words of each); None where some have more than others."""
    if not len(begin) or len(words) % len(begin):
        return None
    table = words.reshape(len(begin), -1)
    return None if not table.size or (table[:, 0] < begin).any() or (table[:-1, -1] >= begin[1:]).any() else table


def _parsed(payload: np.ndarray, kind: type, count: int) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            out = np.fromstring(payload.tobytes(), kind, sep=" ")
        except (DeprecationWarning, ValueError):
            raise _Unlike from None
    if len(out) != count:
        raise _Unlike
    return out


def _numbers(payload: np.ndarray, begin: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first `width` numbers of each line, and the fourth to sixth where there are so many, (lines, width)
    and (lines or 0, 3)."""
    if not len(begin):
        return np.empty((0, width)), np.empty((0, 3))
    table = _alike(_words(payload), begin)
    if table is None or table.shape[1] < width:
        raise _Unlike
    found = _parsed(payload, np.float64, table.size).reshape(table.shape)
    return found[:, :width].copy(), found[:, 3:6].copy() if table.shape[1] >= 6 else np.empty((0, 3))


def _corners(payload: np.ndarray, begin: np.ndarray, counts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """corners and sizes of ObjLines; counts: how many v, vt and vn each of the lines has before it."""
    words = _words(payload)
    if (table := _alike(words, begin)) is not None:
        sizes = np.full(len(begin), table.shape[1])
    else:
        sizes = np.diff(np.searchsorted(words, begin), append=len(words))
    if (sizes < 3).any():
        raise _Unlike
    if not len(words):
        return np.empty((0, 3), np.int64), sizes
    slash = payload == ord("/")
    slashes, double, parts = int(slash.sum()), 0, words
    if slashes:
        double = int((slash[1:] & slash[:-1]).sum())
        payload[slash] = ord(" ")
        parts = _words(payload)
    each, odd = divmod(len(parts), len(words))
    if odd or (parts[:: each or 1] != words).any():
        raise _Unlike
    # So many slashes as numbers need between them, or two in a row in each word.
    columns = {(1, 0, 0): [0], (2, 1, 0): [0, 1], (2, 2, 1): [0, 2], (3, 2, 0): [0, 1, 2]}.get(
        (each, *(n / len(words) for n in (slashes, double)))
    )
    if columns is None:
        raise _Unlike
    found = _parsed(payload, np.int64, len(parts)).reshape(-1, each)
    out = np.full((len(words), 3), -1, np.int64)
    for column, given in zip(columns, found.T, strict=True):
        out[:, column] = (
            np.where(given > 0, given - 1, given + np.repeat(counts[column], sizes)) if (given < 0).any() else given - 1
        )
        if (given == 0).any() or (out[:, column] < 0).any() or given.max() >= _MOST:
            raise _Unlike
    return out, sizes
