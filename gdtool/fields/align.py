"""Make disagreeing views agree: how far apart their surfaces lie, and a smooth depth correction for each view.

Generated views are each plausible but do not fit one another: one is a little deeper, another bent. What they share is
enough to find, for every view, the smooth change of depth that brings its surface onto the others'.
"""

from __future__ import annotations

import numpy as np

from gdtool.cameras import Camera, project, rays
from gdtool.fields.sights import Sight, bilinear, tangent_distance

CONTROL = 7  # control points along a side of a view's correction
_PRIOR = 0.03  # world units: how large a correction is expected to be


def disagreement(sights: list[Sight], reach: float = 0.06, stride: int = 3) -> float:
    """Median distance (world units) between one view's points and another's surface where both see the same part.

    0 when no two views have depth in common.
    """
    gaps = [np.abs(m.distance) for m in _matches(sights, reach, stride)]
    gaps = np.concatenate(gaps) if gaps else np.zeros(0)
    return float(np.median(gaps)) if len(gaps) else 0.0


def _sparse(sight: Sight, stride: int) -> np.ndarray:
    """(h, w) bool: every stride-th pixel along both axes that has a surface worth comparing."""
    chosen = np.zeros(sight.mask.shape, bool)
    chosen[::stride, ::stride] = True
    return chosen & (sight.weight > 0.1) & ~sight.broken


def agreement(sights: list[Sight], reach: float = 0.04, stride: int = 3) -> float:
    """Share of the points that should be seen by another view, facing it, that it has within reach (world units).

    True views give 0.6 and more (the rest is occluded there), views of different things nearly 0. 1 when no view faces
    what another shows.
    """
    confirmed = asked = 0
    for i, first in enumerate(sights):
        if first.planes is None:
            continue
        chosen = _sparse(first, stride)
        points, normals = first.points[chosen].astype(np.float64), first.planes[chosen][:, :3]
        for j, second in enumerate(sights):
            facing = normals @ second.camera.backward > 0.5
            if i == j or second.planes is None or not facing.any():
                continue
            distance, weight, _, _ = tangent_distance(second, points[facing])
            confirmed += int(((weight > 0.1) & (np.abs(distance) < reach)).sum())
            asked += int(facing.sum())
    return confirmed / asked if asked else 1.0


def normals_fit_depth(cameras: list[Camera], mask: np.ndarray, depth: np.ndarray, normal: np.ndarray) -> float:
    """Share of the pixels whose normal lies within 60 degrees of what the slope of the depth says; 1 when none can be judged.

    mask (k, h, w), depth (k, h, w), normal (k, h, w, 3). True views give 0.9 and more, however rough a normal map.
    """
    good = judged = 0
    for camera, covered, distance, given in zip(cameras, mask, depth, normal, strict=True):
        origins, directions = rays(camera)
        points = origins + directions * (distance / np.maximum(-(directions @ camera.backward), 1e-9))[..., None]
        across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
        slope = np.cross(down, across)  # toward the camera: rows run down
        slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-30)
        whole = covered > 0.99
        inside = whole[1:-1, 1:-1] & whole[1:-1, 2:] & whole[1:-1, :-2] & whole[2:, 1:-1] & whole[:-2, 1:-1]
        inside &= slope @ camera.backward > 0.3  # not across an edge of the depth
        good += int(((slope * given[1:-1, 1:-1]).sum(-1)[inside] > 0.5).sum())
        judged += int(inside.sum())
    return good / judged if judged else 1.0


class _Match:
    """Points of view i measured against view j: rows of the linear system."""

    def __init__(self, i, j, points, distance, weight, normal, here, there):
        self.i, self.j, self.points, self.distance, self.weight = i, j, points, distance, weight
        self.normal, self.here, self.there = normal, here, there


def _matches(sights: list[Sight], reach: float, stride: int):
    """Pairs of views that see the same surface: same direction of normal and within reach of each other's plane."""
    for i, first in enumerate(sights):
        if first.planes is None:
            continue
        chosen = _sparse(first, stride)
        points = first.points[chosen].astype(np.float64)
        normals = first.planes[chosen][:, :3]
        own = first.weight[chosen]
        for j, second in enumerate(sights):
            if i == j or second.planes is None:
                continue
            distance, weight, normal, _ = tangent_distance(second, points)
            same = (np.abs(distance) < reach) & (weight > 0.1) & ((normal * normals).sum(1) > 0.8)
            if same.any():
                yield _Match(i, j, points[same], distance[same], np.minimum(weight, own)[same], normal[same],
                             project(first.camera, points[same])[0], project(second.camera, points[same])[0])


def _control_weights(pixels: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear weights (n, 4) and control indices (n, 4) of pixel positions (n, 2) in a view's control grid."""
    h, w = shape
    x = np.clip(pixels[:, 0] / w, 0, 1) * (CONTROL - 1)
    y = np.clip(pixels[:, 1] / h, 0, 1) * (CONTROL - 1)
    column = np.minimum(x.astype(int), CONTROL - 2)
    row = np.minimum(y.astype(int), CONTROL - 2)
    fx, fy = x - column, y - row
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    corner = row * CONTROL + column
    return weights, np.stack([corner, corner + 1, corner + CONTROL, corner + CONTROL + 1], 1)


def _bending() -> np.ndarray:
    """Second differences (r, CONTROL^2) of a control grid along both axes."""
    rows = []
    for a in range(CONTROL):
        for b in range(1, CONTROL - 1):
            for place in ([(a, b - 1), (a, b), (a, b + 1)], [(b - 1, a), (b, a), (b + 1, a)]):
                row = np.zeros((CONTROL, CONTROL))
                for (r, c), value in zip(place, (1, -2, 1), strict=True):
                    row[r, c] = value
                rows.append(row.ravel())
    return np.array(rows)


def depth_corrections(sights: list[Sight], reach: float, stiffness: float = 1.0, stride: int = 3) -> list[np.ndarray | None]:
    """For each view a smooth image (h, w) to add to its depth, so that the views' surfaces meet; None without depth.

    One robust linear least squares over control grids: rows say that a point of one view, moved along its ray, lies
    on another view's plane, moved along its own; priors keep corrections small and smooth.
    """
    size = CONTROL * CONTROL
    count = len(sights) * size
    matrix, vector = np.zeros((count, count)), np.zeros(count)
    total = 0.0
    for m in _matches(sights, reach, stride):
        weight = m.weight / (1 + (m.distance / (0.5 * reach)) ** 2) ** 2
        total += weight.sum()
        w_here, c_here = _control_weights(m.here, sights[m.i].mask.shape)
        w_there, c_there = _control_weights(m.there, sights[m.j].mask.shape)
        # More depth moves a point along the viewing direction, that is against `backward`.
        slope_here = -(m.normal @ sights[m.i].camera.backward)[:, None]
        slope_there = (m.normal @ sights[m.j].camera.backward)[:, None]
        coefficients = np.concatenate([w_here * slope_here, w_there * slope_there], 1)
        places = np.concatenate([c_here + m.i * size, c_there + m.j * size], 1)
        outer = coefficients[:, :, None] * coefficients[:, None, :] * weight[:, None, None]
        np.add.at(matrix, (places[:, :, None], places[:, None, :]), outer)
        np.add.at(vector, places, -coefficients * (weight * m.distance)[:, None])
    if total == 0:
        return [None if s.planes is None else np.zeros(s.mask.shape) for s in sights]
    per_view = total / len(sights)
    bending = _bending()
    prior = (stiffness * 2.0 * bending.T @ bending + 0.02 * np.eye(size)) * per_view / size
    for k in range(len(sights)):
        matrix[k * size:(k + 1) * size, k * size:(k + 1) * size] += prior
    solution = np.linalg.solve(matrix, vector).reshape(len(sights), CONTROL, CONTROL)
    out = []
    for sight, control in zip(sights, solution, strict=True):
        if sight.planes is None:
            out.append(None)
            continue
        h, w = sight.mask.shape
        x, y = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)
        place = np.stack([x, y], -1).reshape(-1, 2) * (CONTROL - 1) + 0.5
        image = bilinear(control[..., None].astype(np.float32), place)[:, 0].reshape(h, w)
        out.append(np.clip(image, -2 * _PRIOR, 2 * _PRIOR))
    return out
