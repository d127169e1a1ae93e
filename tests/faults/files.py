"""Make files for the tests, and read what runs leave."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.folders.mesh import write_obj
from gdtool.geometry.meshes import QuadMesh

CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float) - 0.5
QUADS = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]], np.int32)


def quad_cube(path: Path, cells: int) -> Path:
    """Write a closed cube of 6 cells² quads as .obj; remesh copies it when asked for that many faces."""
    index: dict[tuple[int, int, int], int] = {}
    quads = []
    for axis in range(3):
        for side in (0, cells):
            for i in range(cells):
                for j in range(cells):
                    ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
                    ring = ring if side else ring[::-1]
                    corners = []
                    for u, v in ring:
                        corner = [0, 0, 0]
                        corner[axis], corner[(axis + 1) % 3], corner[(axis + 2) % 3] = side, u, v
                        corners.append(index.setdefault(tuple(corner), len(index)))
                    quads.append(corners)
    write_obj(path, QuadMesh(np.array(list(index), float) / cells, np.array(quads, np.int32)))
    return path


def lines_of(stderr: str) -> list[str]:
    """Return the error lines of stderr; fails on a traceback."""
    assert "Traceback" not in stderr, stderr
    return [line for line in stderr.splitlines() if line.startswith("gdtool: ")]


def leftovers(folder: Path) -> list[str]:
    """List what runs must not leave behind: partial folders, workspaces, locks."""
    return sorted(str(p) for p in folder.rglob(".*") if p.suffix in (".partial", ".work", ".lock", ".old"))
