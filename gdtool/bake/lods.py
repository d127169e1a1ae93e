"""Make coarser levels of an unwrapped mesh that share its maps, by decimation that preserves UV seams.

A point of a coarse level has about the same texture coordinates as the nearest point of the full mesh. So all levels
use the same maps; `drift` measures the difference.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gdtool.bake.target import Target
from gdtool.core.child import ChildFailed, call
from gdtool.core.ending import temporary_folder
from gdtool.core.native import imported
from gdtool.core.threads import mapped
from gdtool.geometry.meshes import TriMesh

# The largest mean drift of a level, as a share of the extent: with more, a level reads the maps of other parts.
MAX_DRIFT = 0.02
# A level with more triangles than requested is kept if it has less than this share of those of the level before.
MAX_SHARE = 0.9
# The most triangles of a level, as a multiple of those requested, without a warning.
MAX_EXCESS = 1.5


@dataclass
class Levels:
    """Coarser levels of detail, finest first.

    report: figures for the report. skipped: (what, why) of each level that was left out.
    """

    targets: list[Target] = field(default_factory=list)
    report: dict[str, float] = field(default_factory=dict)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def make_levels(target: Target, count: int, threads: int = 1) -> Levels:
    """Make coarser levels of a target, `count` with the full one, each of half the triangles of the one before.

    Levels that cannot be made, are hardly coarser, or drift too far on the maps are left out.
    """
    counts = [max(len(target.mesh.faces) >> k, 4) for k in range(1, count)]
    out, previous = Levels(), len(target.mesh.faces)
    # Each level is made by a child process: threads only wait for them.
    for wanted, (level, why) in zip(counts, mapped(lambda n: coarser(target, n), counts, threads), strict=True):
        reached = 0 if level is None else len(level.mesh.faces)
        if reached > max(MAX_SHARE * previous, MAX_EXCESS * wanted):
            level, why = None, f"it cannot have fewer than {reached} triangles without tearing a seam"
        if level is None:
            out.skipped.append((f"level of {wanted} triangles", why))
            continue
        drifted = drift(level, target)
        if drifted["drift_mean"] > MAX_DRIFT:
            why = f"its surface would drift on the maps by {100 * drifted['drift_mean']:.1f} % of the extent"
            out.skipped.append((f"level of {wanted} triangles", why))
            continue
        previous = reached
        if previous > MAX_EXCESS * wanted:
            out.warnings.append(f"the level of {wanted} triangles has {previous}: fewer would tear a seam")
        out.targets.append(level)
        name = f"lod{len(out.targets)}"
        out.report[f"{name}_triangles"] = reached
        out.report |= {f"{name}_{figure}": value for figure, value in drifted.items()}
    return out


def collapse_textured(
    mesh: TriMesh, corner_uvs: np.ndarray, target_faces: int, folder: str
) -> tuple[TriMesh, np.ndarray]:
    """Collapse edges by quadrics of position and texture coordinates, seams kept; runs in a child process.

    MeshLab's filter, after Garland & Heckbert 1998. corner_uvs (t, 3, 2): texture coordinates of the faces' corners.
    folder holds temporary files; the parent removes it, since a killed child cannot. Returns a mesh of about
    target_faces triangles, and its corners' texture coordinates.
    """
    from gdtool.images.io import write_png

    pymeshlab = imported("pymeshlab")
    # The filter wants a mesh with a texture, which only a file can give it.
    write_png(Path(folder, "blank.png"), np.zeros((2, 2, 3), np.uint8))
    Path(folder, "full.mtl").write_text("newmtl one\nmap_Kd blank.png\n")
    lines = ["mtllib full.mtl", "usemtl one", *(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist())]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in corner_uvs.reshape(-1, 2).tolist()]
    lines += [
        "f " + " ".join(f"{v + 1}/{3 * k + i + 1}" for i, v in enumerate(face))
        for k, face in enumerate(mesh.faces.tolist())
    ]
    path = Path(folder, "full.obj")
    path.write_text("\n".join(lines) + "\n")
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    meshes.meshing_decimation_quadric_edge_collapse_with_texture(
        targetfacenum=target_faces,
        preserveboundary=True,
        preservenormal=True,
        optimalplacement=True,
        planarquadric=True,
    )
    made = meshes.current_mesh()
    return (
        TriMesh(np.asarray(made.vertex_matrix()), np.asarray(made.face_matrix(), np.int64)),
        np.asarray(made.wedge_tex_coord_matrix()).reshape(-1, 3, 2),
    )


def coarser(target: Target, target_faces: int, seconds: float = 120.0) -> tuple[Target | None, str]:
    """Decimate a target to about target_faces triangles, in a child process with a time limit in seconds.

    It keeps more triangles where fewer would tear a seam. Returns the level, or None and why there is none.
    """
    try:
        with temporary_folder() as folder:
            mesh, uv = call(
                collapse_textured,
                TriMesh(target.mesh.vertices, target.mesh.faces.astype(np.int64)),
                target.uv[target.face_uvs],
                target_faces,
                str(folder),
                seconds=seconds,
                memory_mb=8000,
            )
    except ChildFailed as failure:
        return None, str(failure)
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all() or not np.isfinite(uv).all():
        return None, "the collapse left nothing"
    uv, corner = np.unique(np.round(uv.reshape(-1, 2), 7), axis=0, return_inverse=True)
    return Target.of(mesh, uv, corner.reshape(-1, 3)), ""


def drift(level: Target, full: Target, size: int = 1024, count: int = 20_000) -> dict[str, float]:
    """Measure how far a level's surface is from the full mesh's surface at equal texture coordinates.

    Compares `count` points of the level. The full mesh's points are looked up in a raster of its charts, `size` texels
    a side. Returns drift_mean and drift_p99, as shares of the full mesh's extent, and outside: the share of the level's
    surface whose texture coordinates lie in no chart.
    """
    from gdtool.geometry.distance import sample_surface
    from gdtool.geometry.uv_raster import Barycentrics, extend_owners, owners_of

    points, face_idx, barycentric = sample_surface(level.mesh, count, np.random.default_rng(0))
    uv = np.einsum("nk,nkc->nc", barycentric, level.uv[level.face_uvs[face_idx]])
    owner = owners_of(full.uv, full.face_uvs, size)
    inside = Barycentrics(full.uv, full.face_uvs)
    # A texel at a chart's border may have its centre outside the chart: bilinear lookups reach two rings of those.
    ring, ring_owner, _ = extend_owners(inside, owner.reshape(size, size), 2)
    owner[ring] = ring_owner
    column, row = np.clip((uv * size).astype(np.int64), 0, size - 1).T
    face = owner[row * size + column]
    known = face >= 0
    weights = inside.at(face[known], uv[known, 0], uv[known, 1])
    full_points = np.einsum("nk,nkc->nc", np.clip(weights, -1, 2), full.mesh.vertices[full.mesh.faces[face[known]]])
    apart = np.linalg.norm(full_points - points[known], axis=1) / full.mesh.extent
    return {
        "drift_mean": float(apart.mean()),
        "drift_p99": float(np.percentile(apart, 99)),
        "outside": float(1 - known.mean()),
    }
