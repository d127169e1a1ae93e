"""Align views that disagree: measure how far apart their surfaces lie and solve for a smooth depth correction of each.

Generated views are each plausible but do not fit one another: one is a little deeper, another bent. Their overlap is
enough to find, for every view, the smooth change of depth that brings its surface onto the others'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from gdtool.cameras import Camera, project, rays
from gdtool.fields.views.photometric import Picture, color_equations
from gdtool.fields.views.prepared_view import PreparedView, hull_distance, pixel_footprint, tangent_distance

CONTROL_SIDE = 15  # control points along a side of a view's correction grid
MOST_CORRECTION = 0.06  # world units: bound of a correction
PRIOR_SIZE = 0.01  # world units: expected size of a correction
PRIOR_WEIGHT = 0.005  # weight of that expectation, relative to the matches
SLOPE_LENGTH = 0.2  # world units over which normals and depth are wrong by the same amount
# Weights relative to the matches. Rims also lie beside curved outlines, so they count little.
SLOPE_WEIGHT, RIM_WEIGHT, EXTENT_WEIGHT = 0.4, 0.01, 0.3
COLOR_DISTANCE = 0.002  # world units: a usual color difference counts like a plane at this distance
LEAST_WALL_PX = 1.5  # pixels: least thickness between surfaces that two views see from opposite sides
RIM_COSINE = 0.15  # a normal with a smaller cosine to a view's axis belongs to its outline


def disagreement(views: list[PreparedView], reach: float = 0.06, stride: int = 3, share: float = 0.5) -> float:
    """Measure the median distance (world units) between one view's points and another's surface where both see the same
    part.

    share: quantile to return in place of the median. 0 when no two views overlap.
    """
    gaps = [np.abs(m.distance) for m in _matches(views, reach, stride)]
    gaps = np.concatenate(gaps) if gaps else np.zeros(0)
    return float(np.quantile(gaps, share)) if len(gaps) else 0.0


def _sparse(view: PreparedView, stride: int) -> np.ndarray:
    """Select every stride-th pixel along both axes that has a surface worth comparing; (h, w) bool."""
    chosen = np.zeros(view.mask.shape, bool)
    chosen[::stride, ::stride] = True
    return chosen & (view.weight > 0.1) & ~view.depth_edge


def agreement(views: list[PreparedView], reach: float = 0.04, stride: int = 3) -> float:
    """Measure the share of points that a second view, facing them, confirms within `reach` (world units).

    Consistent views give 0.6 and more, the rest being occluded there. Views of different objects give nearly 0. Returns
    1 when no view faces what another shows.
    """
    confirmed = asked = 0
    for i, first in enumerate(views):
        if first.planes is None:
            continue
        chosen = _sparse(first, stride)
        points, normals = first.points[chosen].astype(np.float64), first.planes[chosen][:, :3]
        for j, second in enumerate(views):
            facing = normals @ second.camera.backward > 0.5
            if i == j or second.planes is None or not facing.any():
                continue
            distance, weight, _, _ = tangent_distance(second, points[facing])
            confirmed += int(((weight > 0.1) & (np.abs(distance) < reach)).sum())
            asked += int(facing.sum())
    return confirmed / asked if asked else 1.0


def normals_fit_depth(cameras: list[Camera], mask: np.ndarray, depth: np.ndarray, normal: np.ndarray) -> float:
    """Measure the share of pixels whose normal lies within 60 degrees of the slope of the depth; 1 when none can be
    judged.

    mask (k, h, w), depth (k, h, w), normal (k, h, w, 3). Consistent views give 0.9 and more, however rough a normal
    map.
    """
    good = judged = 0
    for camera, covered, distance, view_normal in zip(cameras, mask, depth, normal, strict=True):
        origins, directions = rays(camera)
        points = origins + directions * (distance / np.maximum(-(directions @ camera.backward), 1e-9))[..., None]
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        slope = np.cross(down, across)  # toward the camera: rows run down
        slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-30)
        whole = covered > 0.99
        inside = whole[1:-1, 1:-1] & whole[1:-1, 2:] & whole[1:-1, :-2] & whole[2:, 1:-1] & whole[:-2, 1:-1]
        inside &= slope @ camera.backward > 0.3  # not across an edge of the depth
        good += int(((slope * view_normal[1:-1, 1:-1]).sum(-1)[inside] > 0.5).sum())
        judged += int(inside.sum())
    return good / judged if judged else 1.0


@dataclass(frozen=True)
class _Match:
    """Hold points of view i that were measured against the surface of view j: rows of the linear system.

    points (n, 3); distance (n,) to the plane of view j; weight (n,); normal (n, 3) of that plane; pixels_i and pixels_j
    (n, 2): where the two views have the points.
    """

    i: int
    j: int
    points: np.ndarray
    distance: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    pixels_i: np.ndarray
    pixels_j: np.ndarray


class Equations(NamedTuple):
    """Weighted linear equations: coefficients (n, c) times the unknowns at indices places (n, c) sum to target (n,)."""

    coefficients: np.ndarray
    places: np.ndarray
    target: np.ndarray
    weight: np.ndarray


def _matches(views: list[PreparedView], reach: float, stride: int, walls: float = 0.0):
    """Yield pairs of views that see one surface: normals in one direction, each within `reach` of the other's plane.

    With walls > 0, yield instead pairs that see the two sides of a wall and leave it thinner than so many pixels. The
    distance is then the thickness that is lacking.
    """
    for i, first in enumerate(views):
        if first.planes is None:
            continue
        chosen = _sparse(first, stride)
        points = first.points[chosen].astype(np.float64)
        normals = first.planes[chosen][:, :3]
        weight_i = first.weight[chosen]
        for j, second in enumerate(views):
            if i == j or second.planes is None:
                continue
            distance, weight, normal, _ = tangent_distance(second, points)
            cosine = (normal * normals).sum(1)
            wall = walls * pixel_footprint(second.camera, float(np.linalg.norm(second.camera.position)))
            same = cosine > 0.8 if walls == 0 else (cosine < -0.8) & (distance > -wall)
            same &= (np.abs(distance) < reach) & (weight > 0.1)
            if same.any():
                yield _Match(
                    i,
                    j,
                    points[same],
                    distance[same] + wall,
                    np.minimum(weight, weight_i)[same],
                    normal[same],
                    project(first.camera, points[same])[0],
                    project(second.camera, points[same])[0],
                )


def _control_weights(pixels: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Compute bilinear weights (n, 4) and control indices (n, 4) of pixel positions (n, 2) in a view's control grid."""
    h, w = shape
    x = np.clip(pixels[:, 0] / w, 0, 1) * (CONTROL_SIDE - 1)
    y = np.clip(pixels[:, 1] / h, 0, 1) * (CONTROL_SIDE - 1)
    column = np.minimum(x.astype(int), CONTROL_SIDE - 2)
    row = np.minimum(y.astype(int), CONTROL_SIDE - 2)
    fx, fy = x - column, y - row
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    corner = row * CONTROL_SIDE + column
    return weights, np.stack([corner, corner + 1, corner + CONTROL_SIDE, corner + CONTROL_SIDE + 1], 1)


def _bending() -> np.ndarray:
    """Build second differences (r, CONTROL_SIDE^2) of a control grid along both axes, in units of a tenth of its side,
    squared.
    """
    rows = []
    for a in range(CONTROL_SIDE):
        for b in range(1, CONTROL_SIDE - 1):
            for place in ([(a, b - 1), (a, b), (a, b + 1)], [(b - 1, a), (b, a), (b + 1, a)]):
                row = np.zeros((CONTROL_SIDE, CONTROL_SIDE))
                for (r, c), value in zip(place, (1, -2, 1), strict=True):
                    row[r, c] = value
                rows.append(row.ravel())
    return np.array(rows) * ((CONTROL_SIDE - 1) / 10) ** 2


@dataclass(frozen=True)
class Corrections:
    """Hold the changes that bring the views together.

    control (k, CONTROL_SIDE^2): world units to add to each view's depth. edge (k,): world units by which each
    silhouette is too small all around.
    """

    control: np.ndarray
    edge: np.ndarray

    @classmethod
    def none(cls, count: int) -> Corrections:
        """Return zero corrections of `count` views."""
        return cls(np.zeros((count, CONTROL_SIDE * CONTROL_SIDE)), np.zeros(count))

    def depth(self, k: int, shape: tuple[int, int]) -> np.ndarray:
        """Interpolate the image (h, w) to add to the depth of view k."""
        h, w = shape
        x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        weights, places = _control_weights(np.stack([x, y], -1).reshape(-1, 2), shape)
        image = (self.control[k][places] * weights).sum(1).reshape(h, w)
        return np.clip(image, -MOST_CORRECTION, MOST_CORRECTION)


class _System:
    """Collect weighted linear equations in the control values of all views and the offset of every silhouette."""

    def __init__(self, count: int):
        self.count, self.unknowns = count, count * (CONTROL_SIDE * CONTROL_SIDE + 1)
        self.rows: list[Equations] = []

    def add(self, coefficients: np.ndarray, places: np.ndarray, target: np.ndarray, weight: np.ndarray) -> None:
        """Add equations: coefficients (n, c) times the unknowns at indices places (n, c) shall sum to target (n,)."""
        self.rows.append(Equations(coefficients, places, target, weight))

    def view_unknowns(self, k: int, control: np.ndarray) -> np.ndarray:
        """Return the indices of control values of view k among all unknowns."""
        return control + k * CONTROL_SIDE * CONTROL_SIDE

    def edge(self, k: int) -> int:
        """Return the index of the silhouette offset of view k among all unknowns."""
        return self.count * CONTROL_SIDE * CONTROL_SIDE + k

    def solve(self, prior: np.ndarray) -> Corrections:
        """Solve the normal equations with the quadratic prior (unknowns, unknowns)."""
        from scipy.sparse import csr_matrix

        # All rows in one sparse matrix: its square is made dense but once.
        place = np.concatenate([places.ravel() for _, places, _, _ in self.rows])
        value = np.concatenate(
            [(coefficients * np.sqrt(weight)[:, None]).ravel() for coefficients, _, _, weight in self.rows]
        )
        width = np.concatenate([np.full(len(target), places.shape[1]) for _, places, target, _ in self.rows])
        rows = csr_matrix((value, place, np.concatenate([[0], np.cumsum(width)])), (len(width), self.unknowns))
        vector = rows.T @ np.concatenate([np.sqrt(weight) * target for _, _, target, weight in self.rows])
        matrix = prior + (rows.T @ rows).toarray()
        solution = np.linalg.solve(matrix, vector)
        size = self.count * CONTROL_SIDE * CONTROL_SIDE
        return Corrections(solution[:size].reshape(self.count, -1), solution[size:])


def corrections(
    views: list[PreparedView],
    slopes: list[Equations],
    before: Corrections,
    reach: float,
    stiffness: float = 1.0,
    stride: int = 3,
    pictures: Sequence[list[Picture]] = (),
) -> Corrections:
    """Solve for the total correction of views to which `before` has already been applied: one robust linear least
    squares.

    The equations say: a point of one view, moved along its ray, lies on another view's plane, moved along its ray, and
    has the color that the other view shows there (pictures: of every view, once for each domain of colors). Two views
    of the opposite sides of a wall leave it a thickness. The corrected depth rises as the normals say (slopes:
    slope_equations of the views before any correction). A surface that one view sees edge-on lies on that view's
    silhouette. Two silhouettes reach equally far along the direction that both show at full length. Priors keep
    corrections small and smooth. Plane distances cannot reveal an error that all views of a point share; the other
    equations can.
    """
    system, size = _System(len(views)), CONTROL_SIDE * CONTROL_SIDE
    total = 0.0
    matches = list(_matches(views, reach, stride))
    for m in matches:
        for domain_pictures in pictures:
            slope, difference, weight = color_equations(
                m.points, m.pixels_i, m.pixels_j, domain_pictures[m.i], domain_pictures[m.j], m.weight
            )
            weights, places = _control_weights(m.pixels_i, views[m.i].mask.shape)
            done = (before.control[m.i][places] * weights).sum(1)
            system.add(
                weights * slope[:, None],
                system.view_unknowns(m.i, places),
                slope * done - difference,
                COLOR_DISTANCE**2 * weight,
            )
    for m in chain(matches, _matches(views, reach, stride, LEAST_WALL_PX)):
        weight = m.weight / (1 + (m.distance / (0.5 * reach)) ** 2) ** 2
        total += weight.sum()
        w_here, c_here = _control_weights(m.pixels_i, views[m.i].mask.shape)
        w_there, c_there = _control_weights(m.pixels_j, views[m.j].mask.shape)
        # More depth moves a point along the viewing direction, that is against `backward`.
        slope_here = -(m.normal @ views[m.i].camera.backward)[:, None]
        slope_there = (m.normal @ views[m.j].camera.backward)[:, None]
        coefficients = np.concatenate([w_here * slope_here, w_there * slope_there], 1)
        places = np.concatenate([system.view_unknowns(m.i, c_here), system.view_unknowns(m.j, c_there)], 1)
        done = (before.control[m.i][c_here] * w_here).sum(1) * slope_here[:, 0] + (
            before.control[m.j][c_there] * w_there
        ).sum(1) * slope_there[:, 0]
        system.add(coefficients, places, done - m.distance, weight)
    if total == 0:
        return before
    per_view = total / len(views)
    unit = (
        PRIOR_WEIGHT * per_view / size
    )  # a control's prior: what a match of one view's average control counts, times PRIOR_WEIGHT
    for k, (coefficients, places, target, weight) in enumerate(slopes):
        share = SLOPE_WEIGHT * PRIOR_WEIGHT * SLOPE_LENGTH**2 * per_view / max(weight.sum(), 1e-12)
        system.add(coefficients, system.view_unknowns(k, places), target, share * weight)
    _add_rims(system, views, before, reach, per_view)
    _add_extents(system, views, before, per_view)
    prior = np.zeros((system.unknowns, system.unknowns))
    bending = _bending()
    view_prior = stiffness * PRIOR_WEIGHT * bending.T @ bending * per_view / size + unit * np.eye(size)
    for k, view in enumerate(views):
        prior[k * size : (k + 1) * size, k * size : (k + 1) * size] = view_prior
        foot = float(np.median(pixel_footprint(view.camera, np.linalg.norm(view.camera.position))))
        prior[system.edge(k), system.edge(k)] = PRIOR_WEIGHT * per_view * (PRIOR_SIZE / foot) ** 2
    return system.solve(prior)


def slope_equations(view: PreparedView, stride: int = 2, apart: int = 2) -> Equations:
    """Build the equations by which normals constrain a view's depth correction.

    The coefficients (n, 8) at control indices (n, 8) give the slope of the correction across `apart` pixels; it shall
    equal the target (n,). Only smooth parts of the surface take part.
    """
    h, w = view.mask.shape
    good = (view.weight > 0.1) & ~view.not_smooth & ~view.depth_edge
    normal, parts = view.planes[..., :3], []
    for axis in (0, 1):
        ahead = [slice(None, -apart) if a == axis else slice(None) for a in (0, 1)]
        behind = [slice(apart, None) if a == axis else slice(None) for a in (0, 1)]
        middle = [slice(apart // 2, -(apart // 2)) if a == axis else slice(None) for a in (0, 1)]
        first, second, between = tuple(ahead), tuple(behind), tuple(middle)
        chosen = good[first] & good[second] & good[between]
        chosen[np.arange(chosen.shape[0]) % stride > 0] = False
        chosen[:, np.arange(chosen.shape[1]) % stride > 0] = False
        step = (view.points[second] - view.points[first])[chosen].astype(np.float64)
        n = normal[between][chosen].astype(np.float64)
        facing = n @ view.camera.backward
        across = np.linalg.norm(step - np.outer(step @ view.camera.backward, view.camera.backward), axis=1)
        slope = (n * step).sum(1) / np.maximum(facing * across, 1e-9)
        keep = (np.abs(slope) < 0.5) & (facing > 0.3)
        row, column = (x[keep] for x in np.nonzero(chosen))
        place = np.stack([column, row], 1) + 0.5
        there = place + apart * np.eye(2)[1 - axis]
        w_a, c_a = _control_weights(place, (h, w))
        w_b, c_b = _control_weights(there, (h, w))
        scale = 1 / across[keep][:, None]
        # Height over the plane must vanish: moved apart by more depth, the far end sinks.
        parts.append(
            (
                np.concatenate([-w_a * scale, w_b * scale], 1),
                np.concatenate([c_a, c_b], 1),
                slope[keep],
                facing[keep] ** 2,
            )
        )
    return Equations(*(np.concatenate(x) for x in zip(*parts, strict=True)))


def _add_rims(system: _System, views: list[PreparedView], before: Corrections, reach: float, per_view: float) -> None:
    """Add equations for contour points: a point seen edge-on by another view, close to its silhouette, lies on it."""
    for i, first in enumerate(views):
        if first.planes is None:
            continue
        chosen = _sparse(first, 1) & ~first.not_smooth
        points, normals = first.points[chosen].astype(np.float64), first.planes[chosen][:, :3].astype(np.float64)
        for j, second in enumerate(views):
            if i == j:
                continue
            square = np.abs(normals @ second.camera.backward) < RIM_COSINE
            p, n = points[square], normals[square]
            if len(p) == 0:
                continue
            distance = hull_distance(second, p)
            with np.errstate(invalid="ignore"):  # -inf on both sides of a picture's border that cuts the object
                outward = (hull_distance(second, p + 0.01 * n) - distance) / 0.01
            near = (np.abs(distance) < reach) & (outward > 0.9) & np.isfinite(distance)
            if not near.any():
                continue
            p, n, distance = p[near], n[near], distance[near]
            weights, control = _control_weights(project(first.camera, p)[0], first.mask.shape)
            slope = -(n @ first.camera.backward)
            coefficients = np.concatenate([weights * slope[:, None], np.full((len(p), 1), -1.0)], 1)
            places = np.concatenate([system.view_unknowns(i, control), np.full((len(p), 1), system.edge(j))], 1)
            done = (before.control[i][control] * weights).sum(1) * slope - before.edge[j]
            weight = 1 / (1 + (distance / (0.5 * reach)) ** 2) ** 2
            system.add(coefficients, places, done - distance, weight * RIM_WEIGHT * per_view / max(len(p), 100))


def _add_extents(system: _System, views: list[PreparedView], before: Corrections, per_view: float) -> None:
    """Add equations for pairs of orthographic views: along the direction square to both axes they reach equally far."""
    outlines = [_outline(s) for s in views]
    for i, j in combinations(range(len(views)), 2):
        if outlines[i] is None or outlines[j] is None:
            continue
        along = np.cross(views[i].camera.backward, views[j].camera.backward)
        length = np.linalg.norm(along)
        if length < 0.1:  # nearly opposite: their silhouettes are one, mirrored; the others tie them
            continue
        foot = views[i].camera.pixel_size
        for sign in (1, -1):
            gap = (
                float((outlines[i] @ along).max() - (outlines[j] @ along).max()) / length
                if sign > 0
                else -float((outlines[i] @ along).min() - (outlines[j] @ along).min()) / length
            )
            if abs(gap) < 8 * foot:  # more is no matter of the edge
                coefficients, places = np.array([[1.0, -1.0]]), np.array([[system.edge(i), system.edge(j)]])
                system.add(
                    coefficients,
                    places,
                    np.array([before.edge[i] - before.edge[j] - gap]),
                    np.array([EXTENT_WEIGHT * per_view]),
                )


def _outline(view: PreparedView) -> np.ndarray | None:
    """Compute world points (n, 3) of an orthographic silhouette's contour; None when it is cropped or perspective."""
    from skimage.measure import find_contours

    if view.cropped or view.camera.projection != "orthographic":
        return None
    lines = find_contours(-np.pad(view.silhouette, 1, constant_values=1.0), 0.0)
    if not lines:
        return None
    place = np.concatenate(lines) - 0.5
    origins, _ = rays(view.camera, place[:, ::-1])
    return origins
