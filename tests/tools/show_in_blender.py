"""Render a .glb from the front in Blender: python show_in_blender.py MODEL.glb OUT.png [unlit]     (pip install bpy)

The camera is orthographic, its half-width 0.72 of the longest side, the object's middle in the picture's. The sun is at
the upper left, as in show_in_three.mjs. The two pictures and gdtool's front view have to show the object in the same
orientation.
"""

from __future__ import annotations

import math
import sys

import bpy
from mathutils import Vector

SIZE = 512


def unlit() -> None:
    """Make every material emit its base color, and reflect nothing."""
    for material in bpy.data.materials:
        tree = material.node_tree
        shader = next((n for n in tree.nodes if n.type == "BSDF_PRINCIPLED"), None) if tree else None
        if shader:
            emission, source = tree.nodes.new("ShaderNodeEmission"), shader.inputs["Base Color"]
            emission.inputs[0].default_value = tuple(source.default_value)
            if source.links:
                tree.links.new(source.links[0].from_socket, emission.inputs[0])
            end = next(n for n in tree.nodes if n.type == "OUTPUT_MATERIAL")
            tree.links.new(emission.outputs[0], end.inputs[0])


def main(model: str, out: str, mode: str = "lit") -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=model)
    if mode == "unlit":
        unlit()
    scene = bpy.context.scene
    corners = [
        obj.matrix_world @ Vector(corner) for obj in scene.objects if obj.type == "MESH" for corner in obj.bound_box
    ]
    low = Vector(tuple(min(c[i] for c in corners) for i in range(3)))
    high = Vector(tuple(max(c[i] for c in corners) for i in range(3)))
    middle, extent = (low + high) / 2, max(high - low)
    # Blender turns glTF's Y up into Z up: the front, +Z there, is -Y here.
    camera = bpy.data.cameras.new("front")
    camera.type, camera.ortho_scale = "ORTHO", 2 * 0.72 * extent
    camera.clip_end = 10 * extent
    eye = bpy.data.objects.new("front", camera)
    eye.location, eye.rotation_euler = middle + Vector((0, -2 * extent, 0)), (math.pi / 2, 0, 0)
    scene.collection.objects.link(eye)
    scene.camera = eye
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy = 3
    lamp = bpy.data.objects.new("sun", sun)
    lamp.rotation_euler = Vector((-1, -1, 1)).to_track_quat("Z", "Y").to_euler()
    scene.collection.objects.link(lamp)
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.3, 0.3, 0.3, 1)
    scene.world = world
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.device = 16, "CPU"
    scene.view_settings.view_transform = "Standard"
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.filepath = out
    bpy.ops.render.render(write_still=True)
    print(
        {
            "meshes": sum(o.type == "MESH" for o in scene.objects),
            "faces": sum(len(m.polygons) for m in bpy.data.meshes),
            "low": tuple(round(x, 4) for x in low),
            "high": tuple(round(x, 4) for x in high),
        }
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
