"""examples/demo.png shows the object that examples/demo.py measures against."""

import sys
from pathlib import Path

import numpy as np

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_demo_image_is_the_demo_object_from_the_front(monkeypatch):
    from gdtool.assets.load import load_scene
    from gdtool.cameras import camera_at
    from gdtool.images.io import read_image
    from gdtool.shading.render.render import render_buffers

    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])
    import make_demo_image as script

    image = read_image(EXAMPLES / "demo.png")
    assert image.shape == (script.SIZE, script.SIZE, 4)
    assert image.dtype == np.uint8
    camera = camera_at(0.0, script.ELEVATION, name="photograph", size=128, **script.LENS)
    buffers = render_buffers(load_scene(f"procedural:{script.SEED}"), camera, samples=4)
    small = (image / 255.0).reshape(128, script.SIZE // 128, 128, script.SIZE // 128, 4).mean((1, 3))
    assert np.abs(small[..., 3] - buffers["mask"]).mean() < 0.005
    inside = buffers["mask"] > 0.99
    # lit color correlates with albedo where the light is white and mostly diffuse
    lit, albedo = small[..., :3][inside], buffers["albedo"][inside] ** (1 / 2.2)
    assert np.corrcoef(lit.ravel(), albedo.ravel())[0, 1] > 0.6
