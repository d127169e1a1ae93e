r"""Render views by gdtool for the benchmarks of render-dataset and relight.

Prints its seconds and writes its images.

    python -m benchmarks.common.render.in_gdtool MODEL ENV OUT.npz --views front,right --size 512 --samples 16 \
        --light sampled --light-samples 4
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import time

import numpy as np


def main() -> None:
    """Render the views that the command line names, and write their images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "env", "out"):
        parser.add_argument(name)
    parser.add_argument("--views", default="front_right")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--light", choices=["none", "sampled", "prefiltered", "sg"], default="none")
    parser.add_argument("--light-samples", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--converged", action="store_true", help="every pixel gets all samples")
    arguments = parser.parse_args()
    import torch

    from benchmarks.common.render.scene import normalised

    torch.set_num_threads(1)
    from gdtool.assets.load import load_scene
    from gdtool.cameras import rig
    from gdtool.shading.bsdf.closed_form import closed_form_image
    from gdtool.shading.lights.studio import studio
    from gdtool.shading.render import render
    from gdtool.shading.render.direct import DirectLight, LightOptions

    # What the renderer imports when it first needs it: no renderer's seconds have its imports in them.
    for module in (
        "embreex.mesh_construction",
        "gdtool.shading.bsdf.closed_form",
        "gdtool.shading.lights.prefilter",
        "gdtool.geometry.tangents",
        "torch.quasirandom",
    ):
        importlib.import_module(module)
    scene = normalised(load_scene(arguments.model))
    if arguments.converged:
        render.BASE_SAMPLES = arguments.samples
    environment, lobes, _ = studio(arguments.env, arguments.seed, fit=arguments.light == "sg")
    wall, processor = time.perf_counter(), time.process_time()
    renderer = render.Renderer(scene, len(os.sched_getaffinity(0)))
    color = None
    if arguments.light in ("sampled", "prefiltered"):
        color = DirectLight(
            renderer, environment, arguments.light_samples, arguments.seed, options=LightOptions(arguments.light)
        ).color()
    cameras = {camera.name: camera for camera in rig("six", arguments.size)}

    def view(camera):
        frame = renderer.buffers(camera, arguments.samples, color)
        if arguments.light == "sg":
            frame["color"] = closed_form_image(frame, camera, lobes)
        if "color" in frame:
            frame["color"] = frame["color"] * frame["mask"][..., None]
        return frame

    frames = list(renderer.render_each(view, [cameras[name] for name in arguments.views.split(",")]))
    seconds = {"wall s": time.perf_counter() - wall, "cpu s": time.process_time() - processor}
    np.savez(
        arguments.out,
        names=np.array(arguments.views.split(",")),
        **{key: np.stack([frame[key] for frame in frames]) for key in frames[0]},
    )
    print(json.dumps({**seconds, "rays": renderer.counts.samples + renderer.counts.shadow_rays}))


if __name__ == "__main__":
    main()
