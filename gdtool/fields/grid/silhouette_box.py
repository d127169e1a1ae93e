"""Find the box around the volume that the silhouettes of all views have in common."""

from __future__ import annotations

import numpy as np

from gdtool.cameras import Camera, transform_camera
from gdtool.fields.grid.carve import hull_bounds
from gdtool.fields.grid.fusion import prepare_all
from gdtool.fields.views.prepared_view import hull_distance, pixel_footprint

SAMPLES = 64  # grid samples along each side of the cube in which the common volume is looked for


def unit_box_of_silhouettes(cameras: list[Camera], mask: np.ndarray) -> np.ndarray | None:
    """Compute the similarity (4, 4) that takes the box around the common volume to the centred one of longest side 1.

    mask (k, h, w). The search starts around the point that the viewing axes pass nearest. It is run twice, the second
    time inside the first box. Returns None where the silhouettes have no volume in common there.
    """
    axes = np.stack([camera.backward for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    positions = np.stack([camera.position for camera in cameras])
    center = np.linalg.lstsq(across.sum(0), np.einsum("kij,kj->i", across, positions), rcond=None)[0]
    distance = np.abs(((positions - center) * axes).sum(1))
    reach = max(
        float(pixel_footprint(c, d)) * max(c.width, c.height) / 2 for c, d in zip(cameras, distance, strict=True)
    )
    total = np.eye(4)
    margin = 2.0 / (SAMPLES - 1)  # that hull_bounds leaves around the volume
    for _ in range(2):
        step = np.eye(4)
        step[:3] /= reach
        step[:3, 3] = -center / reach
        cameras, total = [transform_camera(camera, step) for camera in cameras], step @ total
        views = prepare_all(cameras, mask, None, None)
        low, high = hull_bounds(views, reach=1.0, samples=SAMPLES)
        center = (low + high) / 2
        reach = float((high - low).max()) / 2
        if max(hull_distance(view, center[None])[0] for view in views) > reach:
            return None
    step = np.eye(4)
    step[:3] /= 2 * (reach - margin)
    step[:3, 3] = -center / (2 * (reach - margin))
    return step @ total
