"""What a user would run instead of `gdtool reconstruct`: screened Poisson, plain and capped, and a hull, plain and
carved.

All are classical and quick. A carved hull is the weighted truncated distance to the depth views cut by the silhouettes;
a hull the silhouettes alone, which is all that views without depth give; capped Poisson is screened Poisson on the
views' points and on those points of the carved hull's top and bottom that no view sees, without which it balloons
there. Each gives vertices (v, 3) and faces (f, 3)."""

from __future__ import annotations

import numpy as np

from gdtool.cameras import project, rays
from gdtool.folders.views import Views
from gdtool.geometry.meshes import TriMesh

REACH = 0.6  # the grid covers the cube of this half side


def cloud(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and normals (n, 3) of every pixel whose mask is over a half."""
    points, normals = [], []
    for k, camera in enumerate(views.cameras):
        good = (views.mask[k] > 0.5) & (np.linalg.norm(views.images["normal"][k], axis=-1) > 0.5)
        origins, directions = rays(camera)
        along = views.images["depth"][k] / -(directions @ camera.backward)
        points.append((origins + directions * along[..., None])[good])
        normals.append(views.images["normal"][k][good])
    return np.concatenate(points).astype(np.float64), np.concatenate(normals).astype(np.float64)


def carved_field(views: Views, samples: int, truncation: float = 4.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Signed distances (n, n, n), positive outside; the coordinates (n,) of the samples along an axis; their step."""
    from scipy.ndimage import distance_transform_edt, map_coordinates

    step = 2 * REACH / samples
    axis = (np.arange(samples) + 0.5) * step - REACH
    limit = truncation * step
    total, weights = np.zeros((samples,) * 3, np.float32), np.zeros((samples,) * 3, np.float32)
    hull = np.full((samples,) * 3, -limit, np.float32)
    silhouettes = []
    for mask in views.mask > 0.5:
        silhouettes.append(
            np.where(mask, 0.5 - distance_transform_edt(mask), distance_transform_edt(~mask) - 0.5).astype(np.float32)
        )
    for j in range(samples):
        x, z = np.meshgrid(axis, axis, indexing="ij")
        points = np.stack([x, np.full_like(x, axis[j]), z], -1).reshape(-1, 3)
        for k, camera in enumerate(views.cameras):
            pixels, depth = project(camera, points)
            place = [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5]
            foot = camera.pixel_size if camera.projection == "orthographic" else 1 / camera.fx
            beside = map_coordinates(silhouettes[k], place, order=1, mode="nearest") * foot
            hull[:, j] = np.maximum(hull[:, j], np.clip(beside, -limit, limit).reshape(samples, samples))
            if "depth" not in views.images:
                continue
            row, column = (np.rint(p).astype(int).clip(0, views.mask.shape[1] - 1) for p in place)
            front = views.images["depth"][k][row, column] - depth
            facing = np.clip(views.images["normal"][k][row, column] @ camera.backward, 0.05, 1)
            good = (views.mask[k][row, column] > 0.5) & (front > -limit)
            share = np.where(good, facing**2, 0).reshape(samples, samples)
            total[:, j] += share * np.clip(front * facing, -limit, limit).reshape(samples, samples)
            weights[:, j] += share
    surface = np.where(weights > 1e-3, total / np.maximum(weights, 1e-6), -limit)
    return np.maximum(surface, hull), axis, step


def carved_hull(views: Views, samples: int = 128) -> tuple[np.ndarray, np.ndarray]:
    from skimage.measure import marching_cubes

    field, axis, step = carved_field(views, samples)
    field = np.pad(field, 1, constant_values=step)
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    return vertices * step + axis[0] - step, faces


def hull(views: Views, samples: int = 128) -> tuple[np.ndarray, np.ndarray]:
    """What the silhouettes alone give."""
    return carved_hull(Views(views.cameras, {}, views.mask, None), samples)


def screened_poisson(
    points: np.ndarray, normals: np.ndarray, depth: int, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of points (n, 3) with normals (n, 3), on an octree of the given depth."""
    import pymeshlab

    mesh = pymeshlab.MeshSet()
    mesh.add_mesh(pymeshlab.Mesh(points, v_normals_matrix=normals))
    mesh.generate_surface_reconstruction_screened_poisson(depth=depth, preclean=True, threads=threads)
    return mesh.current_mesh().vertex_matrix(), mesh.current_mesh().face_matrix()


def poisson(views: Views, depth: int = 7, threads: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Of the views' points alone; where no view looks it balloons."""
    return screened_poisson(*cloud(views), depth, threads)


def capped_poisson(views: Views, depth: int = 7, threads: int = 2) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    from gdtool.geometry.distance import sample_surface
    from gdtool.geometry.normals import face_normals

    points, normals = cloud(views)
    samples = 96
    vertices, faces = carved_hull(views, samples)
    caps, face_idx, _ = sample_surface(TriMesh(vertices, faces), 60_000, np.random.default_rng(0))
    cap_normals = face_normals(TriMesh(vertices, faces))[0][face_idx]
    unseen = (cKDTree(points).query(caps)[0] > 2.5 * 2 * REACH / samples) & (np.abs(cap_normals[:, 1]) > 0.5)
    return screened_poisson(
        np.concatenate([points, caps[unseen]]), np.concatenate([normals, cap_normals[unseen]]), depth, threads
    )


def available(deep: bool = True) -> dict:
    """Name to function of the peers whose packages are installed; without deep, of those that need silhouettes
    alone."""
    from importlib.util import find_spec

    if not deep:
        return {"hull": hull}
    found = {"carved hull": carved_hull, "hull": hull}
    if find_spec("pymeshlab"):
        found |= {"capped Poisson": capped_poisson, "Poisson": poisson}
    return found
