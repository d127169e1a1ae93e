"""Render one lit picture a view by Mitsuba 3 for the benchmarks of render-dataset and relight.

Prints its seconds and writes its images.

  PEERS_PYTHON benchmarks/common/render/in_mitsuba.py SCENE.npz OUT.npz --views front,right --size 512 --samples 16

SCENE.npz is what scene.exported writes. Direct light, box filter, metallic-roughness as `principled` under
`normalmap`; a first picture that is not timed loads the kernels. Emission and alpha are left out."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import mitsuba as mi
import numpy as np


def texture(image: np.ndarray, raw: bool) -> dict:
    """Describe a bitmap texture of an image (h, w, c); raw: its values are linear, not sRGB."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image)), "raw": raw, "filter_type": "bilinear"}


def value(scene: dict, name: str) -> dict | float:
    """Describe a material's input: a texture, a color, or a number."""
    stored = scene[name]
    if stored.ndim == 3:
        return texture(stored, raw=not name.endswith("base_color"))
    return {"type": "rgb", "value": stored.tolist()} if stored.ndim else float(stored)


def mesh(scene: dict, key: str, folder: str) -> dict:
    """Describe the mesh of one material and its BSDF; key: of the material in SCENE.npz. The mesh is written to a .ply
    in folder.
    """
    vertices, faces, normals, uv = (scene[f"{key}_{name}"] for name in ("vertices", "faces", "normals", "uv"))
    colors = scene[f"{key}_colors"]
    mitsuba_mesh = mi.Mesh(
        key, len(vertices), len(faces), has_vertex_normals=len(normals) > 0, has_vertex_texcoords=True
    )
    if len(colors):
        mitsuba_mesh.add_attribute("vertex_color", 3, np.ravel(colors).astype(np.float32))
    fields = mi.traverse(mitsuba_mesh)
    for name, array in {"vertex_positions": vertices, "vertex_normals": normals, "vertex_texcoords": uv}.items():
        if len(array):
            fields[name] = np.ravel(array).astype(np.float32)
    fields["faces"] = np.ravel(faces).astype(np.uint32)
    fields.update()
    path = str(Path(folder, f"{key}.ply"))
    mitsuba_mesh.write_ply(path)
    color = {"type": "mesh_attribute", "name": "vertex_color"} if len(colors) else value(scene, f"{key}_base_color")
    bsdf = {
        "type": "principled",
        "base_color": color,
        "roughness": value(scene, f"{key}_roughness"),
        "metallic": value(scene, f"{key}_metallic"),
        "specular": 0.5,
    }
    if scene[f"{key}_normal"].ndim == 3:
        bsdf = {"type": "normalmap", "normalmap": texture(scene[f"{key}_normal"], True), "bsdf": bsdf}
    return {
        "type": "ply",
        "filename": path,
        "flip_tex_coords": False,
        "face_normals": not len(normals),
        "bsdf": {"type": "twosided", "bsdf": bsdf},
    }


def main() -> None:
    """Render the views that the command line names, and write their images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("out")
    parser.add_argument("--views", default="front_right")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    import drjit as dr
    from mitsuba import ScalarTransform4f as Transform

    stored = dict(np.load(arguments.scene))
    with tempfile.TemporaryDirectory() as folder:
        # Mitsuba's map begins a quarter turn before gdtool's.
        light = np.roll(stored["light"], -(stored["light"].shape[1] // 4), 1)
        keys = [name.removesuffix("_vertices") for name in stored if name.endswith("_vertices")]
        scene = mi.load_dict(
            {
                "type": "scene",
                "light": {"type": "envmap", "bitmap": mi.Bitmap(light.astype(np.float32))},
                **{key: mesh(stored, key, folder) for key in keys},
            }
        )
    integrator = mi.load_dict({"type": "direct", "hide_emitters": True})

    def picture(view: str, samples: int, seed: int) -> np.ndarray:
        angle = np.radians(stored[f"azimuth_{view}"])
        half = float(stored["half_width"])
        sensor = mi.load_dict(
            {
                "type": "orthographic",
                "near_clip": 0.1,
                "far_clip": 10.0,
                "to_world": Transform().look_at(
                    origin=[3 * np.sin(angle), 0, 3 * np.cos(angle)], target=[0, 0, 0], up=[0, 1, 0]
                )
                @ Transform().scale([half, half, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": arguments.size,
                    "height": arguments.size,
                    "pixel_format": "rgba",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": samples},
            }
        )
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed)
        dr.eval(image)
        return np.array(image)

    names = arguments.views.split(",")
    # What one launch may hold: a reference is the mean of several.
    parts = max(1, arguments.samples // 256)
    picture(names[0], arguments.samples // parts, 10_000)
    wall, processor = time.perf_counter(), time.process_time()
    images = [
        np.mean([picture(name, arguments.samples // parts, arguments.seed + 100 * part) for part in range(parts)], 0)
        for name in names
    ]
    seconds = {"wall s": time.perf_counter() - wall, "cpu s": time.process_time() - processor}
    frames = np.stack(images)
    np.savez(arguments.out, names=np.array(names), color=frames[..., :3], mask=frames[..., 3])
    print(json.dumps(seconds), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
