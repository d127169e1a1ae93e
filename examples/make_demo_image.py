"""Render examples/demo.png: the demo's object as a camera sees it, from the front, a little above, in perspective.

python examples/make_demo_image.py [OUT.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from demo import SEED

SIZE = 512  # pixels
ELEVATION = 12.0  # degrees
LENS = {"distance": 2.6, "fov_degrees": 28.0}  # object sizes; across


def main() -> None:
    from gdtool.assets.load import load_scene
    from gdtool.cameras import camera_at
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.io import write_png
    from gdtool.shading.lights.load import load_environment
    from gdtool.shading.render.color import render_color

    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("demo.png")
    camera = camera_at(0.0, ELEVATION, name="photograph", size=SIZE, **LENS)
    color, mask = render_color(
        load_scene(f"procedural:{SEED}"), camera, load_environment("mid"), samples=16, light_samples=32
    )
    exposure = 0.95 / np.percentile(color[mask > 0.5].max(axis=-1), 99)  # highlights may clip, as in a photograph
    write_png(out, np.dstack([srgb_from_linear(np.clip(color * exposure, 0, 1)), mask]).astype(np.float32))
    print(out)


if __name__ == "__main__":
    main()
