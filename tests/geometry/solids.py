"""Make closed and open meshes of known shape."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.meshes import QuadMesh


def cube(side: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Make a cube of twelve triangles that face outward, centred at the origin."""
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return (vertices - 0.5) * side, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def quad_cube(rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Make a cube of 6 * 4**rounds quads."""
    from gdtool.remesh.fit.surface_projection import subdivide

    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    mesh = QuadMesh(cube()[0], quads)
    for _ in range(rounds):
        mesh, _ = subdivide(mesh)
    return mesh.vertices, mesh.faces


def quad_torus(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Make a torus of n x n quads, all of whose vertices are regular."""
    u, v = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a, b = 2 * np.pi * u / n, 2 * np.pi * v / n
    points = np.stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)], -1).reshape(-1, 3)
    at = lambda i, j: (i % n) * n + j % n  # noqa: E731
    quads = np.stack([at(u, v), at(u + 1, v), at(u + 1, v + 1), at(u, v + 1)], -1).reshape(-1, 4)
    return points, quads


def marching(field, n: int, half: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Extract the surface where field(x, y, z) is zero, on an n^3 grid over ±half.

    The field is negative inside; faces look outward.
    """
    from skimage.measure import marching_cubes

    line = np.linspace(-half, half, n)
    vertices, faces, _, _ = marching_cubes(field(*np.meshgrid(line, line, line, indexing="ij")), 0.0)
    return vertices * (line[1] - line[0]) - half, faces.astype(np.int64)


def sphere(n: int = 32, radius: float = 0.8, centre=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    return marching(
        lambda x, y, z: np.sqrt((x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2) - radius, n, 1.03
    )


def torus(n: int = 40) -> tuple[np.ndarray, np.ndarray]:
    return marching(lambda x, y, z: np.hypot(np.hypot(x, z) - 0.65, y) - 0.28, n, 1.03)


def lattice(cells: int = 3, n: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Make the solid that Schwarz' P surface bounds inside a cube, with `cells` periods along an edge; three give 28
    handles.
    """

    def field(x, y, z):
        waves = sum(np.cos(np.pi * cells * (axis / 0.9 + 1)) for axis in (x, y, z))
        return np.maximum(waves, 20 * (np.maximum(np.maximum(abs(x), abs(y)), abs(z)) - 0.9))

    return marching(field, n)


def bored_box(n: int = 56) -> tuple[np.ndarray, np.ndarray]:
    """Make a box of half sides 0.8, 0.6, 0.5 with a bore of radius 0.3 along z.

    Its creases are twelve straight ones and two circles.
    """

    def field(x, y, z):
        return np.maximum(np.maximum(np.maximum(abs(x) - 0.8, abs(y) - 0.6), abs(z) - 0.5), 0.3 - np.hypot(x, y))

    return marching(field, n, 1.03)


def rod(sections: int, radius: float = 0.03, height: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Make a cylinder of slivers along z: two fans, and a wall with two triangles for each section."""
    angle = 2 * np.pi * np.arange(sections) / sections
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices = np.concatenate(
        [
            np.c_[ring, np.full(sections, -height / 2)],
            np.c_[ring, np.full(sections, height / 2)],
            [[0, 0, -height / 2], [0, 0, height / 2]],
        ]
    )
    one = np.arange(sections)
    two = (one + 1) % sections
    faces = [
        (one, two, two + sections),
        (one, two + sections, one + sections),
        (two, one, 0 * one + 2 * sections),
        (one + sections, two + sections, 0 * one + 2 * sections + 1),
    ]
    return vertices, np.concatenate([np.stack(face, -1) for face in faces])


def assembly(pins: int, sections: int) -> tuple[np.ndarray, np.ndarray]:
    """Make a disk of radius 1 surrounded by a circle of pins, scaled into a box of side 1."""
    around = 2 * np.pi * np.arange(pins) / pins
    pin = rod(sections)
    vertices, faces = joined(
        rod(64, 1.0, 0.3), *((pin[0] + (1.3 * np.cos(a), 1.3 * np.sin(a), 0), pin[1]) for a in around)
    )
    return vertices / 2.66, faces


def plane(n: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Make an open square of side 1 in z = 0 that faces +z."""
    line = np.linspace(-0.5, 0.5, n + 1)
    x, y = np.meshgrid(line, line)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 2], -1), np.stack([i, i + n + 2, i + n + 1], -1)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], -1), faces


def joined(*meshes) -> tuple[np.ndarray, np.ndarray]:
    offset = np.cumsum([0] + [len(v) for v, _ in meshes])
    return np.concatenate([v for v, _ in meshes]), np.concatenate(
        [f + o for (_, f), o in zip(meshes, offset, strict=False)]
    )


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, :3], faces[:, [0, 2, 3]]])
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def write_obj(path, vertices, faces) -> None:
    lines = ["v {:.17g} {:.17g} {:.17g}".format(*p) for p in vertices] + [
        "f " + " ".join(str(i + 1) for i in face) for face in faces.tolist()
    ]
    path.write_text("\n".join(lines) + "\n")
