"""Inflate a picture's silhouette to a solid, the simplest guess at an object's shape, and view it from all around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt

from gdtool.assets.scene import Material, Scene
from gdtool.cameras import Camera
from gdtool.folders.views import Views
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import vertex_normals
from gdtool.shading.render.render import Renderer

_SAMPLES = 16  # of a pixel


@dataclass(frozen=True)
class Picture:
    """Hold a picture of an object from the front.

    color (h, w, 3): linear. mask (h, w): coverage. camera: the orthographic front camera, at azimuth 0.
    """

    color: np.ndarray
    mask: np.ndarray
    camera: Camera


def inflated(picture: Picture) -> Scene:
    """Inflate the silhouette, half thickness sqrt(d (2 D - d)) on either side of the plane z = 0.

    d: distance to the outline; D: its largest value. So a disc becomes a ball. The picture's color is carried straight
    through, each pixel to the two squares that lie before and behind it.
    """
    inside = picture.mask > 0.5
    distance = distance_to_outline(inside) * picture.camera.pixel_size
    half = np.sqrt(distance * (2 * distance.max() - distance))
    rows, columns = np.nonzero(inside)
    # A pixel's top left, bottom left, bottom right and top right corner, and its centre, as points of the half pixels.
    corners = np.stack(
        [np.stack([2 * rows + i, 2 * columns + j], -1) for i, j in ((0, 0), (2, 0), (2, 2), (0, 2), (1, 1))],
        1,
    )
    point = corners[..., 0] * half.shape[1] + corners[..., 1]  # (pixels, 5)
    fan = np.array([[4, 0, 1], [4, 1, 2], [4, 2, 3], [4, 3, 0]])  # counter-clockwise from the front
    # Points behind come after those before, but on the outline, where both are one.
    behind = point + np.where(half.reshape(-1)[point] > 0, half.size, 0)
    normals = vertex_normals(
        TriMesh(
            np.concatenate([_places(half, picture.camera, 1), _places(half, picture.camera, -1)]),
            np.concatenate([point[:, fan].reshape(-1, 3), behind[:, fan[:, ::-1]].reshape(-1, 3)]),
        )
    )
    own = 5 * np.arange(len(point))[:, None, None]  # each pixel has points of its own, of its color
    before_faces, behind_faces = (own + fan).reshape(-1, 3), (own + fan[:, ::-1]).reshape(-1, 3) + point.size
    both = np.concatenate([point.reshape(-1), behind.reshape(-1)])
    places = np.concatenate([_places(half, picture.camera, 1), _places(half, picture.camera, -1)])
    colors = np.concatenate([picture.color[rows, columns], np.ones((len(rows), 1))], 1)
    return Scene(
        places[both],
        np.concatenate([before_faces, behind_faces]).astype(np.int32),
        (Material("inflated", metallic=0.0, roughness=0.5, double_sided=True),),
        normals=normals[both],
        colors=np.tile(np.repeat(colors, 5, axis=0), (2, 1)),
    )


def inflated_views(picture: Picture, cameras: list[Camera], roughness: float = 0.5, metallic: float = 0.0) -> Views:
    """View the inflated silhouette through cameras. Color is the carried color, and so is albedo.

    The front view has the picture's silhouette and color, and the back view their mirror image.
    """
    renderer = Renderer(inflated(picture))
    buffers = [renderer.buffers(camera, _SAMPLES) for camera in cameras]
    images = {domain: np.stack([frame[domain] for frame in buffers]) for domain in ("normal", "depth", "albedo")}
    mask = np.stack([frame["mask"] for frame in buffers])
    images["color"] = images["albedo"]
    images |= {"roughness": np.where(mask > 0, roughness, 0), "metallic": np.where(mask > 0, metallic, 0)}
    for k, camera in enumerate(cameras):
        if camera.name in ("front", "back"):
            mirror = slice(None, None, 1 if camera.name == "front" else -1)
            mask[k], images["color"][k] = picture.mask[:, mirror], picture.color[:, mirror]
    return Views(cameras, images, mask.astype(np.float32))


def distance_to_outline(inside: np.ndarray) -> np.ndarray:
    """Compute the distance, in pixels, from points half a pixel apart to the nearest point outside of a silhouette.

    inside (h, w) bool. Returns (2 h + 1, 2 w + 1): pixel (i, j) has its centre at [2 i + 1, 2 j + 1]. A point that
    touches a pixel outside lies on the outline.
    """
    padded = np.pad(inside, 1)
    rows, columns = (np.arange(2 * side + 1) for side in inside.shape)
    touched = [
        padded[np.ix_(i + 1, j + 1)] for i in ((rows - 1) // 2, rows // 2) for j in ((columns - 1) // 2, columns // 2)
    ]
    return distance_transform_edt(np.all(touched, 0)) / 2


def _places(half: np.ndarray, camera: Camera, side: int) -> np.ndarray:
    """Place the points of half pixels (m, n) in the world, in front of z = 0 (side 1) or behind it (-1); (m n, 3)."""
    rows, columns = np.meshgrid(*(np.arange(n) for n in half.shape), indexing="ij")
    step = camera.pixel_size / 2
    x, y = (columns - camera.width) * step, (camera.height - rows) * step
    return np.stack([x, y, side * half], -1).reshape(-1, 3)
