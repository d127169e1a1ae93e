"""A contact sheet of procedural objects, seen from half right and above: what training data looks like.

python examples/procedural_sheet.py FIRST_SEED [COUNT] [OUT.png]       python examples/procedural_sheet.py kinds 5
sheet.png
"""

from __future__ import annotations

import sys

import numpy as np

SIZE, COLUMNS = 128, 8


def picture(scene, light) -> np.ndarray:
    """(SIZE, SIZE, 3) sRGB over white."""
    from gdtool.cameras import camera_at
    from gdtool.images.color import srgb_from_linear
    from gdtool.shading.render.color import render_color

    camera = camera_at(25.0, 18.0, name="sheet", size=SIZE, half_width=0.66)
    color, mask = render_color(scene, camera, light, samples=4, light_samples=6)
    return srgb_from_linear(np.clip(color, 0, 1)) * mask[..., None] + 1 - mask[..., None]


def main() -> None:
    from gdtool.assets.procedural import generate, kinds
    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import write_png
    from gdtool.shading.lights.load import load_environment

    first, count = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 48
    out = sys.argv[3] if len(sys.argv) > 3 else "procedural.png"
    light = load_environment("mid")
    if first == "kinds":  # one row a kind
        names = [kind for family in kinds().values() for kind in family]
        rows, labels = [[picture(generate(seed, kind), light) for seed in range(count)] for kind in names], names
    else:
        images = [picture(generate(seed), light) for seed in range(int(first), int(first) + count)]
        rows, labels = (
            [images[i : i + COLUMNS] for i in range(0, count, COLUMNS)],
            [str(int(first) + i) for i in range(0, count, COLUMNS)],
        )
    write_png(out, contact_sheet(rows, labels_left=labels))
    print(out)


if __name__ == "__main__":
    main()
