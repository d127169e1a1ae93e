"""Time and error of baking at several map sizes, on a torus whose material and normals are known in closed form.

  python benchmarks/bake.py [--sizes 512,1024,2048] [--threads 2]

Seconds are wall clock and, beside it, of the processor: on a busy machine only the second can be compared. Errors are
against the true material at the nearest point of the torus, before the maps are quantised; occlusion has no closed form
and is compared with 1024 rays per texel on a sample of texels.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

MAJOR, MINOR = 0.35, 0.14


def torus(around: int, across: int, minor: float = MINOR):
    """vertices (v, 3), triangles (f, 3), normals (v, 3)."""
    a, b = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    normals = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], -1).reshape(-1, 3)
    centre = MAJOR * np.stack([np.sin(a), 0 * a, np.cos(a)], -1).reshape(-1, 3)
    idx = np.arange(around * across).reshape(around, across)
    quads = np.stack([idx, np.roll(idx, -1, 0), np.roll(np.roll(idx, -1, 0), -1, 1), np.roll(idx, -1, 1)], -1).reshape(-1, 4)
    return centre + minor * normals, np.stack([quads[:, :3], quads[:, [0, 2, 3]]], 1).reshape(-1, 3), normals


def true_place(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest points of the torus (n, 3) and its normals there (n, 3)."""
    ring = points * (1, 0, 1)
    ring = MAJOR * ring / np.linalg.norm(ring, axis=1, keepdims=True)
    normals = (points - ring) / np.linalg.norm(points - ring, axis=1, keepdims=True)
    return ring + MINOR * normals, normals


def albedo_of(points: np.ndarray) -> np.ndarray:
    """(n, 3) linear in [0.05, 0.95]."""
    x, y, z = points.T
    return np.stack([0.5 + 0.4 * np.sin(29 * x + 2 * y), 0.5 + 0.4 * np.sin(28 * z - 3 * x), 0.45 + 0.35 * np.cos(31 * y + 4 * z)], -1)


class Clock:
    """Seconds since the last question: wall clock, and of the processor."""

    def __init__(self):
        self.wall, self.processor = time.perf_counter(), time.process_time()

    def __call__(self) -> tuple[float, float]:
        before = self.wall, self.processor
        self.__init__()
        return self.wall - before[0], self.processor - before[1]


def measure(size: int, threads: int) -> dict[str, float]:
    """One row of the table."""
    import xatlas

    from gdtool.texture.bake import bake, occlusion_tracer, vertex_lookup
    from gdtool.texture.maps import make_maps
    from gdtool.texture.occlusion import bake_occlusion
    from gdtool.texture.reproject import Source, vertex_reach
    from gdtool.texture.target import Target, texels_of

    fine, fine_faces, fine_normals = torus(700, 360)
    coarse, faces, _ = torus(142, 71, minor=MINOR + 0.0004)  # 20,000 triangles, a little off the surface
    _, face_uvs, uv = xatlas.parametrize(coarse.astype(np.float32), faces.astype(np.uint32))
    uv, face_uvs = np.asarray(uv, np.float64) * (1, -1) + (0, 1), face_uvs.astype(np.int64)
    clock = Clock()
    target = Target.of(coarse, faces, uv, face_uvs)
    texels = texels_of(target, size)
    source = Source(fine, fine_faces)
    reach = vertex_reach(coarse, faces, source)
    prepared = clock()
    attributes = {"albedo": albedo_of(fine), "roughness": 0.5 + 0.3 * np.sin(20 * fine[:, 0]), "metallic": (fine[:, 1] > 0) * 1.0}
    baked = bake(target, texels, source, vertex_lookup(source, attributes, fine_normals), reach, threads=threads)
    read = clock()
    trace = occlusion_tracer(target, source, reach, fine_normals, 64, 0, threads)
    occlusion = bake_occlusion(target, texels, baked.positions, baked.normals, trace)
    shadowed = clock()
    make_maps(texels, baked.values, occlusion=occlusion, normal_map="on")
    filled = clock()

    from gdtool.texture.tangents import decode_tangent_space
    from gdtool.texture.target import points_at

    inside = slice(0, texels.inside)
    at, normals = true_place(baked.positions[inside].astype(np.float64))
    some = np.random.default_rng(0).integers(0, texels.inside, 20_000)
    decoded = decode_tangent_space(points_at(target, texels.face_idx[some], texels.barycentric[some])[1], baked.values["tangent_normal"][some])
    angle = np.degrees(np.arccos(np.clip((decoded * normals[some]).sum(1), -1, 1)))
    many = occlusion_tracer(target, source, reach, fine_normals, 1024, 9, threads)(texels.face_idx[some[:2000]], texels.barycentric[some[:2000]])
    error = lambda a, b: -10 * np.log10(np.mean((a - b) ** 2))  # noqa: E731
    return {"size": size, "prepare s": prepared[0], "bake s": read[0], "bake cpu s": read[1], "occlusion s": shadowed[0],
            "occlusion cpu s": shadowed[1], "maps s": filled[0], "maps cpu s": filled[1],
            "albedo dB": error(baked.values["albedo"][inside], albedo_of(at)),
            "roughness dB": error(baked.values["roughness"][inside], 0.5 + 0.3 * np.sin(20 * at[:, 0])), "normal deg": float(angle.mean()),
            "occlusion rms": float(np.sqrt(np.mean((occlusion[some[:2000]] - many) ** 2))),
            "peak MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="512,1024,2048")
    parser.add_argument("--threads", type=int, default=2)
    asked = parser.parse_args()
    for number, row in enumerate(measure(int(size), asked.threads) for size in asked.sizes.split(",")):
        if not number:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
        print("| " + " | ".join(f"{value:g}" if name == "size" else f"{value:.3g}" for name, value in row.items()) + " |", flush=True)
