"""Bake a case of cases.py in Blender: python in_blender.py MODEL.glb LOW.npz OUT.npz --size 2048 --samples 1
(pip install bpy)

Cycles, selected to active, as its manual has it: base color and metallic by emission (a diffuse bake of a metal is
black), roughness and tangent-space normals by their own passes. LOW holds vertices, triangles and uv per corner (t, 3,
2) with v up. OUT gets albedo (linear, s, s, 3), roughness, metallic (s, s), normal (s, s, 3) as stored and before
quantisation, and per corner of the triangles, in the file's frame, the normals, tangents and signs that Blender encoded
them with. Prints its cost as JSON."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import bpy
import numpy as np

Z_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)  # glTF's (x, y, z) is Blender's (x, -z, y)


def principled() -> list:
    """Of each material of the models: its node tree, output and principled node."""
    out = []
    for material in bpy.data.materials:
        nodes = material.node_tree.nodes if material.node_tree else []
        shader = next((n for n in nodes if n.type == "BSDF_PRINCIPLED"), None)
        end = next((n for n in nodes if n.type == "OUTPUT_MATERIAL"), None)
        if shader and end:
            out.append((material.node_tree, end, shader))
    return out


def emit(trees: list, entry: str) -> list:
    """Put what feeds an entry of the principled nodes into an emission; returns what undoes it."""
    undo = []
    for tree, end, shader in trees:
        emission, source = tree.nodes.new("ShaderNodeEmission"), shader.inputs[entry]
        if source.links:
            tree.links.new(source.links[0].from_socket, emission.inputs[0])
        else:
            value = source.default_value
            emission.inputs[0].default_value = tuple(value) if hasattr(value, "__len__") else (value, value, value, 1)
        undo.append((tree, end, emission, end.inputs[0].links[0].from_socket))
        tree.links.new(emission.outputs[0], end.inputs[0])
    return undo


def low_object(path: Path):
    """The mesh to bake into, smooth, with its own material."""
    with np.load(path) as found:
        vertices, triangles, uv = found["vertices"] @ Z_UP.T, found["triangles"], found["uv"]
    mesh = bpy.data.meshes.new("low")
    mesh.from_pydata(vertices.tolist(), [], triangles.tolist())
    mesh.uv_layers.new().data.foreach_set("uv", uv.astype(np.float32).ravel())
    mesh.shade_smooth()
    mesh.update()
    low = bpy.data.objects.new("low", mesh)
    bpy.context.scene.collection.objects.link(low)
    material = bpy.data.materials.new("low")
    material.use_nodes = True
    mesh.materials.append(material)
    return low, mesh, material


def corners_of(mesh) -> dict[str, np.ndarray]:
    """Normals (t, 3, 3), tangents (t, 3, 3) and signs (t, 3) of the triangles' corners, Y up."""
    mesh.calc_tangents()
    out = {}
    for name, attribute, width in (
        ("corner_normals", "normal", 3),
        ("corner_tangents", "tangent", 3),
        ("corner_signs", "bitangent_sign", 1),
    ):
        values = np.empty(len(mesh.loops) * width, np.float32)
        mesh.loops.foreach_get(attribute, values)
        out[name] = values.reshape(-1, 3, 3) @ Z_UP if width == 3 else values.reshape(-1, 3)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("low", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--samples", type=int, default=1)
    parser.add_argument("--cage", type=float, default=0.02)
    parser.add_argument("--occlusion", type=int, default=0, help="samples of an ambient occlusion pass; 0: none")
    asked = parser.parse_args()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.import_scene.gltf(filepath=str(asked.model.resolve()))
    high, trees = [o for o in scene.objects if o.type == "MESH"], principled()
    low, mesh, material = low_object(asked.low)
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    scene.render.bake.use_selected_to_active, scene.render.bake.cage_extrusion, scene.render.bake.margin = (
        True,
        asked.cage,
        4,
    )
    bpy.ops.object.select_all(action="DESELECT")
    for one in [*high, low]:
        one.select_set(True)
    bpy.context.view_layer.objects.active = low
    seconds, maps = {}, {}

    def bake(name: str, kind: str, entry: str = "") -> None:
        image = bpy.data.images.new(name, asked.size, asked.size, float_buffer=True)
        image.colorspace_settings.name = "Non-Color"
        node = material.node_tree.nodes.new("ShaderNodeTexImage")
        node.image, material.node_tree.nodes.active = image, node
        undo = emit(trees, entry) if entry else []
        scene.cycles.samples = asked.occlusion if kind == "AO" else asked.samples
        start, spent = time.perf_counter(), time.process_time()
        bpy.ops.object.bake(type=kind)
        seconds[name] = time.perf_counter() - start, time.process_time() - spent
        for tree, end, emission, before in undo:
            tree.links.new(before, end.inputs[0])
            tree.nodes.remove(emission)
        pixels = np.empty(asked.size * asked.size * 4, np.float32)
        image.pixels.foreach_get(pixels)
        pixels = pixels.reshape(asked.size, asked.size, 4)[::-1, :, :3]
        maps[name] = pixels if name in ("albedo", "normal") else pixels[..., 0]
        bpy.data.images.remove(image)

    bake("albedo", "EMIT", "Base Color")
    bake("roughness", "ROUGHNESS")
    bake("metallic", "EMIT", "Metallic")
    bake("normal", "NORMAL")
    if asked.occlusion:
        bake("occlusion", "AO")
    peak = next(
        int(line.split()[1]) / 1024
        for line in Path("/proc/self/status").read_text().splitlines()
        if line.startswith("VmHWM")
    )
    np.savez(asked.out, **maps, **corners_of(mesh))
    print("cost " + json.dumps({"seconds": seconds, "peak_mb": peak}))


if __name__ == "__main__":
    main()
