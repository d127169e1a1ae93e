"""The grid method: views to a watertight mesh, by carving a signed distance grid and refining its surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera
from gdtool.fields.clock import Clock
from gdtool.fields.grid.carve import carve, silhouettes_outvoted, smooth_unseen
from gdtool.fields.grid.picture_silhouette import restore_picture_silhouette
from gdtool.fields.grid.refine import (
    FOLD_DEGREES,
    drop_debris,
    fit_to_normals,
    measured_planes,
    normal_deviation_degrees,
    refine,
)
from gdtool.fields.grid.thin_parts import restore_thin_parts, vertices_near
from gdtool.fields.views.depth_alignment import Corrections, corrections, disagreement, slope_equations
from gdtool.fields.views.photometric import Picture
from gdtool.fields.views.prepared_view import (
    WEAK,
    PreparedView,
    free_distance,
    grow_silhouette,
    hull_distance,
    pixel_footprint,
    prepare,
)
from gdtool.geometry.grids import edge_counts, extract
from gdtool.geometry.normals import vertex_normals
from gdtool.geometry.sharpen import dihedral_degrees, restore_creases

LEAST_NOISE = 0.3  # grid steps: of views that had to be brought together
OVER_EDGE = 0.25  # steps that a sharp edge may stand out of what the views leave, whose pixels round it off
# Pixels by which the surface of views that a model made comes out too small: parts that they disagree about go, edges
# first.
SMALL = 0.2
# Degrees between the surface of views that disagree and their normals: exact normals come to 3, a model's to 4 and
# more.
BUMPY = 3.5
CREASE_ROUNDS = 4  # tries without what folded over
MAX_SAMPLES = 320  # along the longest side: 33 million samples, 0.6 GB at the peak
# Rounds of bringing views together: how far apart two surfaces may lie to be taken for one (world units), and how stiff
# the corrections are. The last is repeated while the disagreement falls by PLATEAU of itself.
ROUNDS = ((0.08, 4.0), (0.06, 1.0), (0.04, 0.3), (0.03, 0.3))
MORE_ROUNDS, PLATEAU = 4, 0.05
DRAFT = 2.0  # grid steps of the draft that is made first when time is short
# What materials solved from color (the slowest way) and writing take of a draft's seconds at the same step. Fusing
# grows with the step to the power -2.4 (the narrow band to -2, where the surface may lie to -3), the rest with the
# number of vertices.
AFTER, FUSING, SURFACE = 1.5, 2.4, 2.0


def _silent(text: str) -> None:
    """Tell nobody."""


@dataclass(frozen=True)
class Shape:
    """A closed mesh, outward: vertices (v, 3) float64, faces (f, 3) int32, support (v,): weight of the views that
    measured each vertex; step: the grid's, world units; pieces dropped as debris; bumps: degrees by which the normals
    of views that disagree differed from the surface's, None where they did not matter; restored: share of the picture's
    mask behind which the views together left nothing."""

    vertices: np.ndarray
    faces: np.ndarray
    support: np.ndarray
    step: float
    dropped: int
    bumps: float | None = None
    restored: float = 0.0


def prepare_all(
    cameras: list[Camera], mask: np.ndarray, depth: np.ndarray | None, normal: np.ndarray | None
) -> list[PreparedView]:
    """Prepare every view that shows anything; views whose mask is empty are left out."""
    return [
        prepare(camera, mask[k], None if depth is None else depth[k], None if normal is None else normal[k])
        for k, camera in enumerate(cameras)
        if (mask[k] > 0.5).any()
    ]


def finest_pixel(cameras: list[Camera]) -> float:
    """World units across a pixel of the sharpest view, at the origin."""
    return min(float(pixel_footprint(c, float(np.linalg.norm(c.position)))) for c in cameras)


def grid_step(cameras: list[Camera], resolution: int) -> float:
    """World units between samples: resolution samples a unit, or (0) 0.8 of a pixel of the sharpest view."""
    return 1.0 / resolution if resolution else float(np.clip(0.8 * finest_pixel(cameras), 1.0 / MAX_SAMPLES, 1.0 / 64))


def depth_for(
    cameras: list[Camera], mask: np.ndarray, normal: np.ndarray, alike: dict[str, np.ndarray] | None = None
) -> np.ndarray:
    """Depth (k, h, w) from normals (k, h, w, 3) and silhouettes; alike: albedo, roughness and metallic views where
    there are any."""
    from gdtool.fields.grid.carve import hull_bounds
    from gdtool.fields.views.normal_integration import depth_from_normals

    views = prepare_all(cameras, mask, None, None)
    return depth_from_normals(
        cameras, mask, normal, alike or {}, views, hull_bounds(views, silhouettes_outvoted(views))
    )


def align_depth(
    cameras: list[Camera],
    mask: np.ndarray,
    depth: np.ndarray | None,
    normal: np.ndarray | None,
    step: float,
    clock: Clock | None = None,
    tell: Callable[[str], None] = _silent,
    colors: Sequence[np.ndarray] = (),
) -> tuple[list[PreparedView], float, float]:
    """Prepared views whose surfaces were brought together where they disagree, the disagreement before and after.

    colors: images (k, h, w, 3), linear, of what looks alike from all sides. Views that agree to a tenth of a step at
    three quarters of their points are left as they are: of views that end at one another's silhouettes half may agree
    by that alone."""
    views = prepare_all(cameras, mask, depth, normal)
    before = disagreement(views)
    if disagreement(views, share=0.75) < 0.1 * step:
        return views, before, before
    views, after = align_views(cameras, mask, depth, normal, views, clock, tell, colors)
    # What the views got wrong in common is not seen in their disagreement.
    return views, before, max(after, LEAST_NOISE * step)


def align_views(
    cameras: list[Camera],
    mask: np.ndarray,
    depth: np.ndarray,
    normal: np.ndarray | None,
    views: list[PreparedView],
    clock: Clock | None = None,
    tell: Callable[[str], None] = _silent,
    colors: Sequence[np.ndarray] = (),
) -> tuple[list[PreparedView], float]:
    """Corrected views and their disagreement. views: the views as they were given, prepared.

    Rounds go on until the disagreement falls no more, or until half of the clock's time is spent; each leaves whole
    views.
    """
    clock = clock or Clock()
    kept = [k for k in range(len(cameras)) if (mask[k] > 0.5).any()]
    slopes = [slope_equations(view) for view in views]
    found, after = Corrections.none(len(views)), disagreement(views)
    for count, (reach, stiffness) in enumerate((*ROUNDS, *[ROUNDS[-1]] * MORE_ROUNDS), 1):
        pictures = [[Picture.of(cameras[k], stack[k], mask[k], reach) for k in kept] for stack in colors]
        found = corrections(views, slopes, found, reach, stiffness, pictures=pictures)
        changed = np.array(depth)
        for place, k in enumerate(kept):
            changed[k] = np.where(depth[k] > 0, depth[k] + found.depth(place, mask[k].shape), 0)
        views = [
            grow_silhouette(view, edge)
            for view, edge in zip(prepare_all(cameras, mask, changed, normal), found.edge, strict=True)
        ]
        previous, after = after, disagreement(views)
        tell(f"round {count}: views disagree by {after:.5f}, {previous:.5f} before")
        plateau = count >= len(ROUNDS) and after > (1 - PLATEAU) * previous
        if plateau or clock.left() < clock.spent():
            break
    return views, after


def fuse_within_budget(
    views: list[PreparedView],
    step: float,
    noise: float,
    outvoted: int,
    clock: Clock,
    shaded: bool = True,
    grow: float = 0.0,
    known: str = "",
) -> tuple[Shape, str]:
    """fuse_views at the finest step that the clock has time for, and what was left out for it ("" for nothing).

    With an end in view a draft is made first, which tells how quick the machine is and is the result when nothing
    finer can be done in time."""
    if not clock.limited:
        return fuse_views(views, step, noise, outvoted, shaded, grow, known), ""
    began = clock.spent()
    draft = fuse_views(views, DRAFT * step, noise, outvoted, shaded, grow, known)
    seconds = clock.spent() - began
    for coarser in (1.0, 1.4):
        finer = DRAFT / coarser
        if seconds * (finer**FUSING + AFTER * finer**SURFACE) <= clock.left():
            return fuse_views(
                views, coarser * step, noise, outvoted, shaded, grow, known
            ), "" if coarser == 1 else f"at {coarser} of its step"
    return draft, f"at {DRAFT:g} of its step"


def fuse_views(
    views: list[PreparedView],
    step: float,
    noise: float = 0.0,
    outvoted: int = 0,
    shaded: bool = True,
    grow: float = 0.0,
    known: str = "",
) -> Shape:
    """Mesh of the prepared views. noise: world units by which they disagree; outvoted: see silhouettes_outvoted;
    shaded: whether their normals are views' own, and not made of their depth; grow: world units by which the surface is
    moved out; known: name of the view whose silhouette is no guess, all of which the mesh shows (shown.py), where views
    disagree; "" for none.

    Raises ValueError when the silhouettes have no common volume.
    """
    noise = 0.0 if noise < 0.1 * step else min(noise, 2 * step)
    grid, values, measured = carve(views, step, noise, outvoted)
    carved, thin = values, np.zeros((0, 3))
    values = smooth_unseen(values, measured)
    if not noise and not outvoted:
        values, thin = restore_thin_parts(values, carved, grid, views)
    if noise:
        values = _smoothed(values, noise / step)
    values, restored = values - np.float32(grow), 0.0
    for view in views:
        if noise and view.camera.name == known:
            values, restored = restore_picture_silhouette(values, grid, views, view)
    vertices, faces = extract(values, grid)
    if len(faces) == 0:
        raise ValueError("the silhouettes have no common volume")
    reach = 1.5 * step + noise
    support = measured_planes(views, vertices, vertex_normals(vertices, faces), reach)[2]
    deep = any(s.planes is not None for s in views)
    vertices, faces, dropped = drop_debris(
        vertices, faces, support if deep else np.ones(len(vertices)), step, hollows=deep and not noise
    )
    if not noise and not outvoted:
        # A sheet's two sides would both be drawn onto its one measured surface.
        moved = refine(vertices, faces, views, step, reach=reach)
        thickened = vertices_near(vertices, thin, 2 * step)
        vertices, faces = sharpen_creases(np.where(thickened[:, None], vertices, moved), faces, views, thickened, step)
    bumps = normal_deviation_degrees(vertices, faces, views, reach + noise) if noise and shaded else None
    if bumps is not None and bumps > BUMPY:
        vertices = fit_to_normals(vertices, faces, views, step, reach=reach + noise)
    support = measured_planes(views, vertices, vertex_normals(vertices, faces), reach)[2]
    return Shape(vertices, faces, support, step, dropped, bumps, restored)


def _smoothed(values: np.ndarray, noise: float) -> np.ndarray:
    """Distances of views that disagree by noise (steps), smoothed as much as that asks for; fins that more would take
    away are taken away: views from beside leave them where they see a sheet edge-on."""
    from scipy.ndimage import binary_dilation, gaussian_filter

    little, more = (gaussian_filter(values, min(least + noise, 2.5), truncate=2.5) for least in (0.6, 1.0))
    return np.where(binary_dilation(more < 0, iterations=2), little, more)


def sharpen_creases(
    vertices: np.ndarray, faces: np.ndarray, views: list[PreparedView], fixed: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """The closed mesh with the bevels that marching cubes leaves along sharp edges drawn out; as given where that opens
    it.

    fixed (v,) bool: vertices that stay. None moves out of the silhouettes, nor into what a view sees to be free.
    """

    def outside(points: np.ndarray) -> np.ndarray:
        far = np.max([hull_distance(view, points) for view in views], 0)
        for view in views:
            if view.planes is not None:
                distance, weight = free_distance(view, points)
                far = np.maximum(far, np.where(weight > WEAK, distance, -np.inf))
        return far

    def accept(idx: np.ndarray, points: np.ndarray) -> np.ndarray:
        return ~fixed[idx] & (outside(points) < np.maximum(outside(vertices[idx]), OVER_EDGE * step))

    fixed = fixed.copy()
    for _ in range(CREASE_ROUNDS):
        sharp, sharp_faces, _ = restore_creases(vertices, faces, accept=accept)
        folded = folds(sharp, sharp_faces)
        fresh = (
            vertices_near(vertices, folded, 2 * step)
            & ~vertices_near(vertices, folds(vertices, faces), 2 * step)
            & ~fixed
        )
        if not fresh.any():
            break
        fixed |= fresh
    else:
        return vertices, faces
    sharp_faces = np.ascontiguousarray(sharp_faces, np.int32)
    return (sharp, sharp_faces) if is_closed_manifold(sharp_faces) else (vertices, faces)


def folds(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Midpoints (n, 3) of the edges at which a mesh folds back onto itself."""
    ends, _, angle = dihedral_degrees(vertices, faces)
    return vertices[ends[angle > FOLD_DEGREES]].mean(1)


def is_closed_manifold(faces: np.ndarray) -> bool:
    """Every edge belongs to exactly two faces that run along it in opposite directions."""
    if len(faces) == 0:
        return False
    _, count = edge_counts(faces)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    key = directed[:, 0] * (int(faces.max()) + 1) + directed[:, 1]
    return bool((count == 2).all() and len(np.unique(key)) == len(key))
