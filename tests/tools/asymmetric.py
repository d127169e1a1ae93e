"""Write a .glb that shows at a glance what is mirrored: python asymmetric.py OUT.glb

A grey slab has FRONT in readable letters on the side toward +Z. A red arm points toward +X (the picture's right), a
green one toward +Y (up), a blue one toward +Z (the viewer). On the slab's lower half a normal map raises a dome: lit
from the upper left, its upper left is bright.
"""

from __future__ import annotations

import sys

import numpy as np

from gdtool.assets.gltf.write import write_glb
from gdtool.assets.scene import Material, Scene, Texture

_CORNERS = np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float)
_TURNS = (
    np.eye(3),
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
    [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make the six sides of a box (24 vertices, outward): vertices, normals, uv; the side toward +Z is the first."""
    center, half = (np.array(low) + high) / 2, (np.array(high) - low) / 2
    vertices = np.concatenate([_CORNERS @ np.array(turn).T for turn in _TURNS])
    normals = np.repeat([np.array(turn)[:, 2] for turn in _TURNS], 4, 0)
    uv = np.tile([[0, 1], [1, 1], [1, 0], [0, 0]], (6, 1)).astype(float)
    uv[4:] = 0.02  # only the front shows the picture
    return vertices * half + center, normals, uv


def asymmetric() -> Scene:
    """Make the scene; its longest side is about 1."""
    import OpenImageIO as oiio

    size = 256
    buffer = oiio.ImageBuf(np.full((size, size, 3), 200, np.uint8))
    oiio.ImageBufAlgo.render_text(
        buffer, size // 2, size // 4, "FRONT", 70, "", (0.05, 0.05, 0.05, 1.0), "center", "center"
    )
    picture = np.asarray(buffer.get_pixels("uint8"), np.uint8).reshape(size, size, 3)
    y, x = np.meshgrid(np.linspace(1, -1, size), np.linspace(-1, 1, size), indexing="ij")
    dx, dy = x / 0.45, (y + 0.5) / 0.45
    inside = (dx**2 + dy**2 < 1)[..., None]
    tilt = np.stack([dx, dy, np.sqrt(np.maximum(1 - dx**2 - dy**2, 0.05))], -1)
    bumps = np.where(inside, tilt / np.linalg.norm(tilt, axis=-1, keepdims=True), (0, 0, 1.0))
    slab = Material(
        "slab",
        metallic=0.0,
        roughness=0.6,
        base_color_texture=Texture(picture, "srgb"),
        normal_texture=Texture(np.rint((0.5 * bumps + 0.5) * 255).astype(np.uint8)),
    )
    arms = [
        Material(name, (*color, 1.0), metallic=0.0, roughness=0.6)
        for name, color in (("right", (1, 0, 0)), ("up", (0, 1, 0)), ("front", (0, 0, 1)))
    ]
    boxes = [
        box((-0.4, -0.4, -0.1), (0.3, 0.3, 0.1)),
        box((0.3, -0.05, -0.05), (0.6, 0.05, 0.05)),
        box((-0.1, 0.3, -0.05), (0.0, 0.45, 0.05)),
        box((-0.4, 0.2, 0.1), (-0.3, 0.3, 0.4)),
    ]
    vertices, normals, uv = (np.concatenate([b[i] for b in boxes]) for i in range(3))
    quads = np.arange(len(vertices)).reshape(-1, 4)
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype(np.int32)
    return Scene(
        vertices,
        faces,
        (slab, *arms),
        (faces[:, 0] // 24).astype(np.int32),
        normals=normals,
        uvs=(uv,),
        name="asymmetric",
    )


if __name__ == "__main__":
    write_glb(sys.argv[1], asymmetric())
