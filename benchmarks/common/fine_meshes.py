"""Make the meshes that remesh and unwrap are measured on: analytic solids and public models, by marching cubes.

Each has vertices (v, 3) in a unit box, about the requested number of triangles (f, 3), and its true creases as segments
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
    """Hold one input mesh, its true creases (s, 2, 3) or None, and the name of the solid or model that it shows."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    creases: np.ndarray | None


def part(x, y, z):
    """Evaluate the signed distance of a sharp machine part: a box with a bore along z and a ball on top."""
    (a, b, c), ball = _PART["half"], _PART["ball"]
    beyond = np.stack([abs(x) - a, abs(y) - b, abs(z) - c])
    box = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(0), 0)
    bored = np.maximum(box, _PART["bore"] - np.hypot(x, y))
    return np.minimum(bored, np.sqrt((x - ball[0]) ** 2 + (y - ball[1]) ** 2 + (z - ball[2]) ** 2) - _PART["radius"])


def bracket(x, y, z):
    """Evaluate the signed distance of a bracket with thin parts and long creases.

    It has two plates at a right angle, a hole in one, and a rib between them.
    """

    def box(cx, cy, cz, a, b, c):
        return np.maximum(np.maximum(abs(x - cx) - a, abs(y - cy) - b), abs(z - cz) - c)

    floor = np.maximum(box(0, -0.5, 0, 0.7, 0.06, 0.5), 0.2 - np.hypot(x - 0.25, z))
    rib = np.maximum(box(-0.35, -0.2, 0, 0.3, 0.3, 0.05), (x + y + 0.35) / 2**0.5)
    return np.minimum(np.minimum(floor, box(-0.64, 0, 0, 0.06, 0.5, 0.5)), rib)


def knobs(x, y, z):
    """Evaluate the signed distance of a ball with smooth bumps, an organic shape without creases."""
    return 0.9 * (np.sqrt(x * x + y * y + z * z) - 0.72 - 0.08 * np.sin(7 * x) * np.sin(6 * y + 1) * np.sin(8 * z + 2))


def rings(x, y, z):
    """Evaluate the signed distance of two linked tori of different thickness: two pieces with one handle each."""
    thick = np.hypot(np.hypot(x - 0.25, y) - 0.5, z) - 0.16
    return np.minimum(thick, np.hypot(np.hypot(x + 0.3, z) - 0.45, y) - 0.1)


SOLIDS: dict[str, Callable] = {"part": part, "bracket": bracket, "knobs": knobs, "rings": rings}


def part_creases(count: int = 800) -> np.ndarray:
    """Compute the true creases (s, 2, 3) of part().

    Where the ball meets the side x = a the angle is about 30 degrees: too small to count as a crease.
    """
    (a, b, c), ball, radius, bore = _PART["half"], np.array(_PART["ball"]), _PART["radius"], _PART["bore"]
    line, turn = np.linspace(-1, 1, count), np.linspace(0, 2 * np.pi, 2 * count)
    straight, around = np.ones(count), np.ones(2 * count)
    curves = [np.stack([bore * np.cos(turn), bore * np.sin(turn), side * c * around], -1) for side in (-1, 1)]
    curves.append(np.stack([ball[0] + radius * np.cos(turn), b * around, radius * np.sin(turn)], -1))
    for s in (-1, 1):
        for t in (-1, 1):
            curves += [
                np.stack([a * line, s * b * straight, t * c * straight], -1),
                np.stack([s * a * straight, b * line, t * c * straight], -1),
                np.stack([s * a * straight, t * b * straight, c * line], -1),
            ]
    segments = np.concatenate([np.stack([p[:-1], p[1:]], 1) for p in curves])
    return segments[abs(part(*segments.mean(1).T)) < 1e-3]


def marched(field: Callable, triangles: int, half: float = 1.06) -> tuple[np.ndarray, np.ndarray]:
    """Extract the surface where field(x, y, z) is zero, as vertices (v, 3) and about `triangles` faces (f, 3).

    field: negative inside. half: half the side of the cube that is sampled. Faces are counter-clockwise seen from
    outside.
    """
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
    """Make a closed surface of about `triangles` faces around any model, open ones included.

    It is the zero set of the distance to the model's surface, signed by the winding number.
    """
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
    is_near = np.zeros(shape, bool)
    for offset in offsets:
        is_near[tuple((corner + offset).T)] = True
    index = np.argwhere(is_near)
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
    surface_points, surface_faces, _, _ = marching_cubes(values, 0.0)
    return surface_points * step + low, surface_faces.astype(np.int64)


def _nearest_sign(
    index: np.ndarray, near_index: np.ndarray, near_inside: np.ndarray, coarse: np.ndarray, block: np.ndarray
) -> np.ndarray:
    """Tell which samples off the surface are inside (n,) bool: as the nearest sample beside the surface is.

    index (n, 3): of the samples. near_index (m, 3), near_inside (m,): samples beside the surface. coarse: signed
    distances of the blocks, and block (n, 3): the block of each sample, for a grid without samples beside a surface.
    """
    from scipy.spatial import cKDTree

    if not len(near_index):
        return coarse[tuple(block.T)] < 0
    return near_inside[cKDTree(near_index).query(index)[1]]


def unit(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Scale vertices (v, 3) so that their bounding box is centred and its longest side 1; also returns that centre and
    side.
    """
    low, high = vertices.min(0), vertices.max(0)
    return (vertices - (low + high) / 2) / (high - low).max(), (low + high) / 2, float((high - low).max())


def models_in(paths: Iterable[Path]) -> list[Path]:
    """List the model files among paths and in the folders among them, sorted; files with "control" in their name are
    left out.
    """
    out = []
    for path in paths:
        files = (
            [path] if path.is_file() else [file for file in sorted(path.rglob("*")) if file.suffix.lower() in SUFFIXES]
        )
        out += [file for file in files if "control" not in file.name]
    return out


def of_solid(name: str, triangles: int, folder: Path) -> Fine:
    """Make the mesh of one of SOLIDS, or read it from the folder of kept meshes."""

    def make() -> tuple[np.ndarray, np.ndarray]:
        return marched(SOLIDS[name], triangles)

    vertices, faces = _kept(folder / f"{name}_{triangles}.npz", make)
    vertices, centre, side = unit(vertices)
    return Fine(name, vertices, faces, (part_creases() - centre) / side if name == "part" else None)


def of_model(path: Path, triangles: int, folder: Path) -> Fine:
    """Make a closed mesh of a model file, or read it from the folder of kept meshes; raises what reading the model
    raises.
    """

    def make() -> tuple[np.ndarray, np.ndarray]:
        from gdtool.assets.load import load_scene

        scene = load_scene(path)
        return solidified(unit(scene.vertices)[0], scene.faces.astype(np.int64), triangles)

    digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    vertices, faces = _kept(folder / f"{path.stem}_{digest}_{triangles}.npz", make)
    return Fine(path.stem, unit(vertices)[0], faces, None)


def _kept(path: Path, make: Callable) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices and faces from a .npz file, or make them and write it."""
    if path.exists():
        with np.load(path) as arrays:
            return arrays["vertices"], _outward(arrays["vertices"], arrays["faces"])
    vertices, faces = make()
    vertices, faces = vertices.astype(np.float64), _outward(vertices, faces).astype(np.int64)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, vertices=vertices, faces=faces)
    return vertices, faces


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Reverse all faces of a closed mesh where they face inward."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return faces if np.einsum("ij,ij->", a, np.cross(b, c)) >= 0 else faces[:, ::-1].copy()
