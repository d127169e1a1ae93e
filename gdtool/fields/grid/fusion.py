"""Fuse views into a watertight mesh: carve a signed distance grid, extract_surface its surface and refine it."""

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
from gdtool.geometry.grids import edge_counts, extract_surface
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import vertex_normals
from gdtool.geometry.sharpen import dihedral_degrees, restore_creases

LEAST_NOISE = 0.3  # grid steps: noise that is assumed of views that had to be aligned
CREASE_MARGIN = 0.25  # grid steps by which a crease may leave the carved volume, whose edges pixels round off
# Pixels by which the surface of views that a model made comes out too small: parts that they disagree about go, edges
# first.
SHRINKAGE_PX = 0.2
# Degrees between the surface of views that disagree and their normals above which it is fitted to them. Exact normals
# give 3, a model's 4 and more.
BUMPY_DEGREES = 3.5
CREASE_ROUNDS = 4  # attempts, each without the vertices that folded over in the last one
MAX_SAMPLES = 320  # along the longest side: 33 million samples, 0.6 GB at the peak
# Rounds of alignment: how far apart two surfaces may lie to count as one (world units), and the stiffness of the
# corrections. The last one is repeated, MORE_ROUNDS times at most, while the disagreement falls by PLATEAU of itself.
ROUNDS = ((0.08, 4.0), (0.06, 1.0), (0.04, 0.3), (0.03, 0.3))
MORE_ROUNDS, PLATEAU = 4, 0.05
DRAFT_COARSENESS = 2.0  # grid steps of the draft that is made first when time is limited
# Predict the time of a finer fusion from a draft's, by the ratio of their steps. Fusing takes ratio^FUSION_POWER: the
# narrow band grows with power 2, the region where the surface may lie with power 3. Materials solved from color (the
# slowest way) and writing take AFTER_SHARE * ratio^SURFACE_POWER, like the number of vertices.
AFTER_SHARE, FUSION_POWER, SURFACE_POWER = 1.5, 2.4, 2.0


def _silent(text: str) -> None:
    """Ignore the message."""


@dataclass(frozen=True)
class AlignmentOptions:
    """Set how views are aligned.

    clock: limit of time. tell: receives a line a round. colors: images (k, h, w, 3), linear, of domains that do not
    depend on the viewing direction.
    """

    clock: Clock | None = None
    tell: Callable[[str], None] = _silent
    colors: Sequence[np.ndarray] = ()


@dataclass(frozen=True)
class FusionOptions:
    """Set how views are fused.

    noise: world units by which the views disagree. outvoted: see silhouettes_outvoted. has_normals: whether the normals
    are the views' and not computed from their depth. grow: world units by which the surface is moved out. picture_view:
    name of the view whose silhouette is certain, "" for none; where views disagree, the mesh shows all of it.
    """

    noise: float = 0.0
    outvoted: int = 0
    has_normals: bool = True
    grow: float = 0.0
    picture_view: str = ""


@dataclass(frozen=True)
class Shape:
    """Hold a closed mesh that faces outward, and how it came about.

    mesh: vertices (v, 3) float64, faces (f, 3) int32. support (v,): weight of the views that measured each vertex.
    step: of the grid, world units. dropped: pieces removed as debris. bumps: degrees between the surface's normals and
    those of views that disagree, None where not needed. restored: share of the picture's mask behind which the fused
    views left nothing.
    """

    mesh: TriMesh
    support: np.ndarray
    step: float
    dropped: int
    bumps: float | None = None
    restored: float = 0.0


def prepare_all(
    cameras: list[Camera], mask: np.ndarray, depth: np.ndarray | None, normal: np.ndarray | None
) -> list[PreparedView]:
    """Prepare every view whose mask is not empty."""
    return [
        prepare(camera, mask[k], None if depth is None else depth[k], None if normal is None else normal[k])
        for k, camera in enumerate(cameras)
        if (mask[k] > 0.5).any()
    ]


def finest_pixel(cameras: list[Camera]) -> float:
    """Return the world units across a pixel of the sharpest view, at the origin."""
    return min(float(pixel_footprint(c, float(np.linalg.norm(c.position)))) for c in cameras)


def grid_step(cameras: list[Camera], resolution: int) -> float:
    """Return the world units between samples: `resolution` samples a unit, or (0) 0.8 of the sharpest view's pixel."""
    return 1.0 / resolution if resolution else float(np.clip(0.8 * finest_pixel(cameras), 1.0 / MAX_SAMPLES, 1.0 / 64))


def depth_for(
    cameras: list[Camera], mask: np.ndarray, normal: np.ndarray, alike: dict[str, np.ndarray] | None = None
) -> np.ndarray:
    """Compute depth (k, h, w) from normals (k, h, w, 3) and silhouettes.

    alike: albedo, roughness and metallic views where there are any.
    """
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
    options: AlignmentOptions = AlignmentOptions(),
) -> tuple[list[PreparedView], float, float]:
    """Prepare the views and align their surfaces where they disagree; returns views and disagreement before and after.

    Views that agree to a tenth of a step at three quarters of their points are left unchanged. The median would not do:
    half of the points of views that end at one another's silhouettes may agree by that alone.
    """
    views = prepare_all(cameras, mask, depth, normal)
    before = disagreement(views)
    if disagreement(views, share=0.75) < 0.1 * step:
        return views, before, before
    views, after = align_views(cameras, mask, depth, normal, views, options)
    # What the views got wrong in common is not seen in their disagreement.
    return views, before, max(after, LEAST_NOISE * step)


def align_views(
    cameras: list[Camera],
    mask: np.ndarray,
    depth: np.ndarray,
    normal: np.ndarray | None,
    views: list[PreparedView],
    options: AlignmentOptions = AlignmentOptions(),
) -> tuple[list[PreparedView], float]:
    """Correct the depth of views until they disagree no less; returns the corrected views and their disagreement.

    views: the prepared, uncorrected views. Rounds end at a plateau or when half of the clock's time is spent. Each
    round leaves complete views.
    """
    clock = options.clock or Clock()
    kept = [k for k in range(len(cameras)) if (mask[k] > 0.5).any()]
    slopes = [slope_equations(view) for view in views]
    solution, after = Corrections.none(len(views)), disagreement(views)
    for count, (reach, stiffness) in enumerate((*ROUNDS, *[ROUNDS[-1]] * MORE_ROUNDS), 1):
        pictures = [[Picture.of(cameras[k], stack[k], mask[k], reach) for k in kept] for stack in options.colors]
        solution = corrections(views, slopes, solution, reach, stiffness, pictures=pictures)
        changed = np.array(depth)
        for index, k in enumerate(kept):
            changed[k] = np.where(depth[k] > 0, depth[k] + solution.depth(index, mask[k].shape), 0)
        views = [
            grow_silhouette(view, edge)
            for view, edge in zip(prepare_all(cameras, mask, changed, normal), solution.edge, strict=True)
        ]
        previous, after = after, disagreement(views)
        options.tell(f"round {count}: views disagree by {after:.5f}, {previous:.5f} before")
        plateau = count >= len(ROUNDS) and after > (1 - PLATEAU) * previous
        if plateau or clock.left() < clock.spent():
            break
    return views, after


def fuse_within_budget(
    views: list[PreparedView], step: float, clock: Clock, options: FusionOptions = FusionOptions()
) -> tuple[Shape, str]:
    """Run fuse_views at the finest step that the clock allows; also returns what was left out ("" for nothing).

    With a time limit a draft is made first. It tells how quick the machine is, and is the result when nothing finer can
    be done in time.
    """
    if not clock.limited:
        return fuse_views(views, step, options), ""
    began = clock.spent()
    draft = fuse_views(views, DRAFT_COARSENESS * step, options)
    seconds = clock.spent() - began
    for coarser in (1.0, 1.4):
        finer = DRAFT_COARSENESS / coarser
        if seconds * (finer**FUSION_POWER + AFTER_SHARE * finer**SURFACE_POWER) <= clock.left():
            return fuse_views(views, coarser * step, options), "" if coarser == 1 else f"at {coarser} of its step"
    return draft, f"at {DRAFT_COARSENESS:g} of its step"


def fuse_views(views: list[PreparedView], step: float, options: FusionOptions = FusionOptions()) -> Shape:
    """Fuse prepared views into a mesh. Raises ValueError when the silhouettes have no common volume."""
    noise = 0.0 if options.noise < 0.1 * step else min(options.noise, 2 * step)
    outvoted = options.outvoted
    grid, values, measured = carve(views, step, noise, outvoted)
    carved, thin = values, np.zeros((0, 3))
    values = smooth_unseen(values, measured)
    if not noise and not outvoted:
        values, thin = restore_thin_parts(values, carved, grid, views)
    if noise:
        values = _smoothed(values, noise / step)
    values, restored = values - np.float32(options.grow), 0.0
    for view in views:
        if noise and view.camera.name == options.picture_view:
            values, restored = restore_picture_silhouette(values, grid, views, view)
    mesh = extract_surface(values, grid)
    if len(mesh.faces) == 0:
        raise ValueError("the silhouettes have no common volume")
    reach = 1.5 * step + noise
    support = measured_planes(views, mesh.vertices, vertex_normals(mesh), reach)[2]
    deep = any(s.planes is not None for s in views)
    mesh, dropped = drop_debris(
        mesh, support if deep else np.ones(len(mesh.vertices)), step, hollows=deep and not noise
    )
    if not noise and not outvoted:
        # Refining would move both sides of a sheet onto its one measured surface.
        moved = refine(mesh, views, step, reach=reach)
        thickened = vertices_near(mesh.vertices, thin, 2 * step)
        refined = TriMesh(np.where(thickened[:, None], mesh.vertices, moved), mesh.faces)
        mesh = sharpen_creases(refined, views, thickened, step)
    bumps = normal_deviation_degrees(mesh, views, reach + noise) if noise and options.has_normals else None
    if bumps is not None and bumps > BUMPY_DEGREES:
        mesh = TriMesh(fit_to_normals(mesh, views, step, reach=reach + noise), mesh.faces)
    support = measured_planes(views, mesh.vertices, vertex_normals(mesh), reach)[2]
    return Shape(mesh, support, step, dropped, bumps, restored)


def _smoothed(values: np.ndarray, noise: float) -> np.ndarray:
    """Smooth the distances of views that disagree by `noise` (steps), and remove fins that stronger smoothing would
    remove.

    Such fins are left by views from the side, which see a sheet edge-on.
    """
    from scipy.ndimage import binary_dilation, gaussian_filter

    little, more = (gaussian_filter(values, min(least + noise, 2.5), truncate=2.5) for least in (0.6, 1.0))
    return np.where(binary_dilation(more < 0, iterations=2), little, more)


def sharpen_creases(mesh: TriMesh, views: list[PreparedView], fixed: np.ndarray, step: float) -> TriMesh:
    """Replace the bevels that marching cubes leaves along sharp edges by creases.

    fixed (v,) bool: vertices that stay. No vertex leaves the silhouettes or enters space that a view sees to be free.
    Returns the input where the result would not be closed and manifold.
    """
    vertices = mesh.vertices

    def outside(points: np.ndarray) -> np.ndarray:
        """Compute how far points lie outside the silhouettes or in front of seen surfaces."""
        far = np.max([hull_distance(view, points) for view in views], 0)
        for view in views:
            if view.planes is not None:
                distance, weight = free_distance(view, points)
                far = np.maximum(far, np.where(weight > WEAK, distance, -np.inf))
        return far

    def accept(idx: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Accept a vertex that is not fixed and moves no farther outside than it is, or than CREASE_MARGIN."""
        return ~fixed[idx] & (outside(points) < np.maximum(outside(vertices[idx]), CREASE_MARGIN * step))

    fixed = fixed.copy()
    for _ in range(CREASE_ROUNDS):
        sharp = restore_creases(mesh, accept=accept).mesh
        folded = fold_midpoints(sharp)
        fresh = (
            vertices_near(vertices, folded, 2 * step)
            & ~vertices_near(vertices, fold_midpoints(mesh), 2 * step)
            & ~fixed
        )
        if not fresh.any():
            break
        fixed |= fresh
    else:
        return mesh
    sharp_faces = np.ascontiguousarray(sharp.faces, np.int32)
    return TriMesh(sharp.vertices, sharp_faces) if is_closed_manifold(sharp_faces) else mesh


def fold_midpoints(mesh: TriMesh) -> np.ndarray:
    """Return the midpoints (n, 3) of edges at which a mesh folds back onto itself."""
    ends, _, angle = dihedral_degrees(mesh)
    return mesh.vertices[ends[angle > FOLD_DEGREES]].mean(1)


def is_closed_manifold(faces: np.ndarray) -> bool:
    """Tell whether every edge belongs to exactly two faces that traverse it in opposite directions."""
    if len(faces) == 0:
        return False
    _, count = edge_counts(faces)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    key = directed[:, 0] * (int(faces.max()) + 1) + directed[:, 1]
    return bool((count == 2).all() and len(np.unique(key)) == len(key))
