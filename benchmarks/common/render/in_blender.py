"""Render views by Blender's Cycles (the bpy module) for the benchmarks of render-dataset and relight.

Prints its seconds and writes its images.

  PEERS_PYTHON benchmarks/common/render/in_blender.py MODEL.glb LIGHT.exr OUT.npz --views front,right \
      --size 512 --samples 16 --light

Box filter, direct light only, no adaptive sampling. Buffers come as AOVs and the normal pass of the one picture,
without light when --light is left out: the cheapest way there is. Cycles' depth is not antialiased, so it is not
written."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

INPUTS = {"albedo": "Base Color", "roughness": "Roughness", "metallic": "Metallic"}


def scene_and_camera(arguments: argparse.Namespace):
    """Load the model and the light; returns the scene, and its camera.

    The model's bounding box is centred and its longest side scaled to 1.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed, cycles.max_bounces = "CPU", arguments.samples, arguments.seed, 0
    cycles.use_adaptive_sampling, cycles.use_denoising, cycles.pixel_filter_type = False, arguments.denoise, "BOX"
    scene.render.threads_mode, scene.render.threads = "FIXED", len(os.sched_getaffinity(0))
    scene.render.use_persistent_data = scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = arguments.size
    scene.render.resolution_percentage = 100
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format, settings.color_depth = "OPEN_EXR_MULTILAYER", "32"
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    nodes = scene.world.node_tree
    background = next(n for n in nodes.nodes if n.type == "BACKGROUND")
    if arguments.light:
        image = nodes.nodes.new("ShaderNodeTexEnvironment")
        image.image = bpy.data.images.load(str(Path(arguments.env).absolute()))
        image.image.colorspace_settings.name = "Linear Rec.709"
        nodes.links.new(image.outputs[0], background.inputs[0])
    else:
        background.inputs[1].default_value = 0.0
    bpy.ops.import_scene.gltf(filepath=str(Path(arguments.model).absolute()))
    objects = [o for o in scene.objects if o.type == "MESH" and not o.hide_render]
    bpy.context.view_layer.update()
    points = np.array([tuple(o.matrix_world @ v.co) for o in objects for v in o.data.vertices])
    low, high = points.min(0), points.max(0)
    root = bpy.data.objects.new("root", None)
    scene.collection.objects.link(root)
    for child in list(scene.objects):
        if child.parent is None and child is not root:
            child.parent = root
    factor = 1 / (high - low).max()
    root.scale, root.location = (factor,) * 3, Vector(-factor * (low + high) / 2)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.data.type, camera.data.ortho_scale, camera.data.clip_end = "ORTHO", 2 * arguments.half_width, 10
    return scene, camera


def add_buffers() -> None:
    """Add the normal pass, and an AOV for each material input, to the view layer."""
    layer = bpy.context.view_layer
    layer.use_pass_normal = True
    for name in INPUTS:
        aov = layer.aovs.add()
        aov.name, aov.type = name, "COLOR" if name == "albedo" else "VALUE"
    for material in bpy.data.materials:
        tree = material.node_tree
        shader = next((n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"), None) if tree else None
        for name, socket in INPUTS.items() if shader else ():
            out = tree.nodes.new("ShaderNodeOutputAOV")
            out.aov_name, source, target = name, shader.inputs[socket], out.inputs[0 if name == "albedo" else 1]
            # AOVs add up through cut-outs, so each surface gives its value times its alpha.
            value = tree.nodes.new("ShaderNodeVectorMath")
            value.operation = "MULTIPLY"
            for socket_in, factor in ((source, value.inputs[0]), (shader.inputs["Alpha"], value.inputs[1])):
                if socket_in.links:
                    tree.links.new(socket_in.links[0].from_socket, factor)
                else:
                    factor.default_value = (
                        socket_in.default_value[:3] if socket_in.type == "RGBA" else (socket_in.default_value,) * 3
                    )
            tree.links.new(value.outputs[0], target)


def channels(path: str) -> dict[str, np.ndarray]:
    """Read all channels (h, w) of all parts of a multi-layer EXR, by their names."""
    import OpenImageIO as oiio

    file, images, part = oiio.ImageInput.open(path), {}, 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        pixels = file.read_image(part, 0, 0, spec.nchannels, "float")
        images |= {name: pixels[..., i] for i, name in enumerate(spec.channelnames)}
        part += 1
    file.close()
    return images


def layer(images: dict[str, np.ndarray], name: str) -> np.ndarray:
    """Stack the channels (h, w, c) of one pass."""
    keys = [key for key in images if key.split(".")[-2].lower() == name.lower()]
    keys.sort(key=lambda key: "RGBAXYZV".index(key[-1]))
    return np.stack([images[key] for key in keys], -1)


def main() -> None:
    """Render the views that the command line names, and write their images."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "env", "out"):
        parser.add_argument(name)
    parser.add_argument("--views", default="front_right=45", help="name=azimuth in degrees, by commas")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--half-width", type=float, default=0.72)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--light", action="store_true")
    parser.add_argument("--buffers", action="store_true")
    parser.add_argument("--denoise", action="store_true")
    arguments = parser.parse_args()
    scene, camera = scene_and_camera(arguments)
    if arguments.buffers:
        add_buffers()
    views = [view.split("=") for view in arguments.views.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        wall, processor, files = time.perf_counter(), time.process_time(), []
        for name, azimuth in views:
            angle = np.radians(float(azimuth))
            position = Vector((np.sin(angle), -np.cos(angle), 0)) * 3
            camera.location, camera.rotation_euler = position, position.to_track_quat("Z", "Y").to_euler()
            scene.render.filepath = str(Path(folder, f"{name}.exr"))
            bpy.ops.render.render(write_still=True)
            files.append(scene.render.filepath)
        seconds = {"wall s": time.perf_counter() - wall, "cpu s": time.process_time() - processor}
        rendered = [channels(file) for file in files]

    def stack(name: str) -> np.ndarray:
        return np.stack([layer(each, name) for each in rendered])

    combined = stack("Combined")
    images = {"mask": combined[..., 3]}
    if arguments.light:
        images["color"] = combined[..., :3]
    if arguments.buffers:
        normal = stack("Normal")
        images["normal"] = np.stack([normal[..., 0], normal[..., 2], -normal[..., 1]], -1)
        images["albedo"] = stack("albedo")[..., :3]
        images |= {name: stack(name)[..., 0] for name in ("roughness", "metallic")}
    np.savez(arguments.out, names=np.array([name for name, _ in views]), **images)
    print("\n" + json.dumps(seconds), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
