"""Meshes that remesh and unwrap are measured on: solids with creases in closed form, and public models, by marching
cubes.

Each comes as vertices (v, 3) in a unit box, triangles (f, 3), about as many as asked, and its true creases as segments
(s, 2, 3), None where they are not known. They are kept in a folder, because making one takes up to half a minute.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gdtool.geometry.meshes import TriMesh

SUFFIXES = (".obj", ".ply", ".stl", ".glb", ".gltf")
_PART = {"half": (0.6, 0.5, 0.45), "bore": 0.28, "ball": (0.3, 0.5, 0.0), "radius": 0.35}
_TRIANGLES_PER_CELL = 2.5  # marching cubes makes about so many per squared step of area


@dataclass(frozen=True)
class Fine:
    """One input; name tells where it is from."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    creases: np.ndarray | None


def part(x, y, z):
    """A sharp part: a box with a bore along z and a ball on top."""
    (a, b, c), ball = _PART["half"], _PART["ball"]
    beyond = np.stack([abs(x) - a, abs(y) - b, abs(z) - c])
    box = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
    bored = np.maximum(box, _PART["bore"] - np.hypot(x, y))
    return np.minimum(bored, np.sqrt((x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2) - _PART["radius"])


def bracket(x, y, z):
    """Two plates at a right angle with a hole in one and a rib between: thin parts, long creases."""

    def box(cx, cy, cz, a, b, c):
        return np.maximum(np.maximum(abs(x - cx) - a, abs(y - cy) - b), abs(z - cz) - c)

    floor = np.maximum(box(0, -0.5, 0, 0.7, 0.06, 0.5), 0.2 - np.hypot(x - 0.25, z))
    rib = np.maximum(box(-0.35, -0.2, 0, 0.3, 0.3, 0.05), (x + y + 0.35) / 2**0.5)
    return np.minimum(np.minimum(floor, box(-0.64, 0, 0, 0.06, 0.5, 0.5)), rib)


def knobs(x, y, z):
    """A ball with smooth bumps: organic, no crease."""
    return 0.9 * (np.sqrt(x * x + y * y + z * z) - 0.72 - 0.08 * np.sin(7 * x) * np.sin(6 * y + 1) * np.sin(8 * z + 2))


def rings(x, y, z):
    """Two linked tori of two thicknesses: genus two, two pieces."""
    one = np.hypot(np.hypot(x - 0.25, y) - 0.5, z) - 0.16
    return np.minimum(one, np.hypot(np.hypot(x + 0.3, z) - 0.45, y) - 0.1)


SOLIDS: dict[str, Callable] = {"part": part, "bracket": bracket, "knobs": knobs, "rings": rings}


def part_creases(count: int = 800) -> np.ndarray:
    """(s, 2, 3) true creases of part; where the ball meets the side x = a the angle is too near 30 degrees to count."""
    (a, b, c), ball, radius, bore = _PART["half"], np.array(_PART["ball"]), _PART["radius"], _PART["bore"]
    line, turn = np.linspace(-1, 1, count), np.linspace(0, 2 * np.pi, 2 * count)
    one, around = np.ones(count), np.ones(2 * count)
    curves = [np.stack([bore * np.cos(turn), bore * np.sin(turn), side * c * around], -1) for side in (-1, 1)]
    curves.append(np.stack([ball[0] + radius * np.cos(turn), b * around, radius * np.sin(turn)], -1))
    for s in (-1, 1):
        for t in (-1, 1):
            curves += [
                np.stack([a * line, s * b * one, t * c * one], -1),
                np.stack([s * a * one, b * line, t * c * one], -1),
                np.stack([s * a * one, t * b * one, c * line], -1),
            ]
    segments = np.concatenate([np.stack([p[:-1], p[1:]], 1) for p in curves])
    return segments[abs(part(*segments.mean(1).T)) < 1e-3]


def marched(field: Callable, triangles: int, half: float = 1.06) -> tuple[np.ndarray, np.ndarray]:
    """Zero set of field(x, y, z), negative inside, as about so many triangles, counter-clockwise from outside."""
    from skimage.measure import marching_cubes

    def at(n: int) -> tuple[np.ndarray, np.ndarray]:
        line = np.linspace(-half, half, n).astype(np.float32)
        values = np.concatenate(
            [field(*np.meshgrid(line[i : i + 16], line, line, indexing="ij")) for i in range(0, n, 16)]
        )
        vertices, faces, _, _ = marching_cubes(values, 0.0)
        return vertices * float(line[1] - line[0]) - half, faces.astype(np.int64)

    n = 64
    return at(int(np.ceil(n * (1.02 * triangles / len(at(n)[1])) ** 0.5)))


def solidified(vertices: np.ndarray, faces: np.ndarray, triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface of about so many triangles around any model: zero set of its distance, signed by winding
    number."""
    from skimage.measure import marching_cubes

    from gdtool.geometry.distance import closest_points, winding_number
    from gdtool.geometry.normals import face_normals

    area = face_normals(TriMesh(vertices, faces))[1].sum()
    step = float((_TRIANGLES_PER_CELL * area / triangles) ** 0.5)
    factor = 8
    low = vertices.min(0) - 3 * step
    blocks = np.ceil((np.ptp(vertices, 0) + 6 * step) / (factor * step)).astype(int)
    shape = blocks * factor + 1

    def signed(points: np.ndarray) -> np.ndarray:
        distance = closest_points(points, TriMesh(vertices, faces))[0]
        return np.where(winding_number(points, TriMesh(vertices, faces)) > 0.5, -distance, distance)

    centre = (
        low
        + (np.stack(np.meshgrid(*(np.arange(b) for b in blocks), indexing="ij"), -1).reshape(-1, 3) + 0.5)
        * factor
        * step
    )
    coarse = signed(centre)
    values = np.repeat(np.repeat(np.repeat(coarse.reshape(blocks), factor, 0), factor, 1), factor, 2).astype(np.float32)
    values = np.pad(values, [(0, 1)] * 3, mode="edge")
    near = np.flatnonzero(abs(coarse) < 0.5 * 3**0.5 * (factor + 2) * step)
    corner = np.stack(np.unravel_index(near, blocks), -1) * factor
    offsets = np.stack(np.meshgrid(*(np.arange(factor + 1),) * 3, indexing="ij"), -1).reshape(-1, 3)
    wanted = np.zeros(shape, bool)
    for offset in offsets:
        wanted[tuple((corner + offset).T)] = True
    index = np.argwhere(wanted)
    # Only samples beside the surface matter: the distance tells which, and only they need a winding number.
    points = low + index * step
    distance = closest_points(points, TriMesh(vertices, faces))[0]
    beside = distance < 2.5 * step
    inside = values[tuple(index.T)] < 0
    inside[beside] = winding_number(points[beside], TriMesh(vertices, faces)) > 0.5
    block = np.minimum(index // factor, blocks - 1)
    inside[~beside] = _nearest_sign(
        index[~beside], index[beside], inside[beside], coarse.reshape(blocks), block[~beside]
    )
    values[tuple(index.T)] = np.where(inside, -distance, distance)
    found, out, _, _ = marching_cubes(values, 0.0)
    return found * step + low, out.astype(np.int64)


def _nearest_sign(
    asked: np.ndarray, known: np.ndarray, inside: np.ndarray, coarse: np.ndarray, block: np.ndarray
) -> np.ndarray:
    """Whether samples off the surface are inside: as the nearest sample beside it is."""
    from scipy.spatial import cKDTree

    if not len(known):
        return coarse[tuple(block.T)] < 0
    return inside[cKDTree(known).query(asked)[1]]


def unit(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices with their bounding box centred and its longest side 1, and that centre and side."""
    low, high = vertices.min(0), vertices.max(0)
    return (vertices - (low + high) / 2) / (high - low).max(), (low + high) / 2, float((high - low).max())


def models_in(places: Iterable[Path]) -> list[Path]:
    """Model files named, and those in folders named, by name; control meshes and parts of others are left out."""
    out = []
    for place in places:
        files = [place] if place.is_file() else [p for p in sorted(place.rglob("*")) if p.suffix.lower() in SUFFIXES]
        out += [p for p in files if "control" not in p.name]
    return out


def of_solid(name: str, triangles: int, folder: Path) -> Fine:
    """One of SOLIDS."""

    def make() -> tuple[np.ndarray, np.ndarray]:
        return marched(SOLIDS[name], triangles)

    vertices, faces = _kept(folder / f"{name}_{triangles}.npz", make)
    vertices, centre, side = unit(vertices)
    return Fine(name, vertices, faces, (part_creases() - centre) / side if name == "part" else None)


def of_model(path: Path, triangles: int, folder: Path) -> Fine:
    """A model file, made solid; raises what reading it raises."""

    def make() -> tuple[np.ndarray, np.ndarray]:
        from gdtool.assets.load import load_scene

        scene = load_scene(path)
        return solidified(unit(scene.vertices)[0], scene.faces.astype(np.int64), triangles)

    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    vertices, faces = _kept(folder / f"{path.stem}_{digest}_{triangles}.npz", make)
    return Fine(path.stem, unit(vertices)[0], faces, None)


def _kept(path: Path, make: Callable) -> tuple[np.ndarray, np.ndarray]:
    if path.exists():
        with np.load(path) as found:
            return found["vertices"], _outward(found["vertices"], found["faces"])
    vertices, faces = make()
    vertices, faces = vertices.astype(np.float64), _outward(vertices, faces).astype(np.int64)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, vertices=vertices, faces=faces)
    return vertices, faces


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces of a closed mesh, all turned if they face inward."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return faces if np.einsum("ij,ij->", a, np.cross(b, c)) >= 0 else faces[:, ::-1].copy()
