"""Run Blender's QuadriFlow or Smart UV Project on one mesh, with the settings that its users choose.

  python blender_meshing.py quadriflow|smart IN.npz OUT.npz [QUADS_OR_MARGIN]

IN: vertices (v, 3), faces (f, 4), -1 as a triangle's fourth corner. OUT: vertices and faces, or uv (c, 2) with v up and
face_uvs (f, 4); and the seconds of the operator alone. Runs in a Python that has bpy; it does not import gdtool,
because bpy brings its own Python.
"""

import sys
import time

import bpy
import numpy as np


def active_object(vertices: np.ndarray, faces: np.ndarray):
    """Make a mesh object of vertices (v, 3) and faces (f, 4), and make it the active one."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = bpy.data.meshes.new("mesh")
    used = faces >= 0
    total = used.sum(1)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.loops.add(int(total.sum()))
    mesh.loops.foreach_set("vertex_index", faces[used].astype(np.int32))
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", (np.cumsum(total) - total).astype(np.int32))
    mesh.update(calc_edges=True)
    mesh_object = bpy.data.objects.new("mesh", mesh)
    bpy.context.collection.objects.link(mesh_object)
    bpy.context.view_layer.objects.active = mesh_object
    mesh_object.select_set(True)
    return mesh_object


def corners(mesh) -> np.ndarray:
    """Return the loop indices (f, 4) of each polygon, -1 as a triangle's fourth."""
    start, total = (np.zeros(len(mesh.polygons), np.int32) for _ in range(2))
    mesh.polygons.foreach_get("loop_start", start)
    mesh.polygons.foreach_get("loop_total", total)
    return np.where(np.arange(4) < total[:, None], start[:, None] + np.arange(4), -1)


def prepare_for_quadriflow(mesh_object, vertices: np.ndarray) -> float:
    """Enlarge the mesh and dissolve its tiniest edges; returns the factor of the enlargement.

    QuadriFlow reports a mesh with edges below 1e-4 as not manifold.
    """
    import bmesh

    factor = 1000.0 / float(np.linalg.norm(np.ptp(vertices, 0)))
    mesh_object.data.vertices.foreach_set("co", (vertices * factor).astype(np.float32).ravel())
    mesh = bmesh.new()
    mesh.from_mesh(mesh_object.data)
    bmesh.ops.dissolve_degenerate(mesh, dist=5e-4, edges=mesh.edges)
    bmesh.ops.triangulate(mesh, faces=mesh.faces)
    mesh.to_mesh(mesh_object.data)
    mesh.free()
    mesh_object.data.update()
    return factor


def main() -> None:
    """Run the operator that the command line names, and write its result."""
    method, source, target, quads_or_margin = sys.argv[1:5]
    with np.load(source) as arrays:
        mesh_object = active_object(arrays["vertices"], arrays["faces"])
        factor = prepare_for_quadriflow(mesh_object, arrays["vertices"]) if method == "quadriflow" else 1.0
    start = time.perf_counter()
    if method == "quadriflow":
        state = bpy.ops.object.quadriflow_remesh(
            mode="FACES", target_faces=int(quads_or_margin), use_preserve_sharp=True, use_mesh_symmetry=False, seed=0
        )
        if "FINISHED" not in state:
            sys.exit("QuadriFlow was cancelled")
        seconds = time.perf_counter() - start
        mesh = mesh_object.data
        points, vertex = np.zeros(3 * len(mesh.vertices), np.float32), np.zeros(len(mesh.loops), np.int32)
        mesh.vertices.foreach_get("co", points)
        mesh.loops.foreach_get("vertex_index", vertex)
        loops = corners(mesh)
        faces = np.where(loops < 0, -1, vertex[loops]).astype(np.int64)
        np.savez(target, vertices=points.reshape(-1, 3).astype(np.float64) / factor, faces=faces, seconds=seconds)
        return
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.smart_project(angle_limit=np.radians(66), margin_method="FRACTION", island_margin=float(quads_or_margin))
    bpy.ops.object.mode_set(mode="OBJECT")
    seconds = time.perf_counter() - start
    mesh = mesh_object.data
    uv, vertex = np.zeros(2 * len(mesh.loops), np.float32), np.zeros(len(mesh.loops), np.int32)
    mesh.uv_layers.active.data.foreach_get("uv", uv)
    mesh.loops.foreach_get("vertex_index", vertex)
    # Loops of one vertex at one place are one texture corner.
    keyed = np.concatenate([vertex[:, None], np.round(uv.reshape(-1, 2) * 2**20)], 1)
    _, first, inverse = np.unique(keyed, axis=0, return_index=True, return_inverse=True)
    loops = corners(mesh)
    face_uvs = np.where(loops < 0, -1, inverse.ravel()[loops]).astype(np.int64)
    np.savez(target, uv=uv.reshape(-1, 2)[first].astype(np.float64), face_uvs=face_uvs, seconds=seconds)


main()
