"""How a reconstruction looks beside the truth: its materials at held-out views under a held-out light, and pictures of
it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from gdtool.geometry.meshes import TriMesh

MATERIALS = (
    ("albedo_psnr", "albedo dB", 1),
    ("relit_psnr", "relit dB", 1),
    ("roughness_error", "roughness", 1),
    ("metallic_error", "metallic", 1),
)
CLAY, EDGE = np.array([0.78, 0.76, 0.73]), 224  # of the pictures: the surface's color, pixels along a side


def looks(surface, truth, size: int = 192) -> dict:
    """Albedo dB, roughness and metallic errors and the dB of a relit picture, seen by four cameras that the result was
    not made from."""
    import torch

    from gdtool.cameras import camera_at, rays
    from gdtool.geometry.rays import RayCaster
    from gdtool.images.color import srgb_from_linear
    from gdtool.shading.bsdf.closed_form import shade
    from gdtool.shading.bsdf.sg import SphericalGaussians
    from gdtool.shading.render.surface_points import surface_attributes

    light = SphericalGaussians(
        torch.tensor([[0.48, 0.64, 0.6], [-0.8, 0.36, 0.48], [0.0, 0.6, -0.8]]),
        torch.tensor([20.0, 6.0, 4.0]),
        torch.tensor([[3.0, 2.8, 2.5], [0.6, 0.8, 1.0], [0.7, 0.6, 0.6]]),
    )
    ours, true = RayCaster(TriMesh(surface.vertices, surface.faces)), RayCaster(TriMesh(truth.vertices, truth.faces))
    error = {name: [] for name, _, _ in MATERIALS}
    for i in range(4):
        camera = camera_at(22.5 + 90 * i, 20.0, name=str(i), size=size)
        origins, directions = (x.reshape(-1, 3) for x in rays(camera))
        hits, true_hits = ours.first_hit(origins, directions), true.first_hit(origins, directions)
        both = hits.is_hit & true_hits.is_hit
        both[both] = np.abs(hits.distance[both] - true_hits.distance[both]) < 0.01
        if not both.any():
            continue
        corner, share = surface.faces[hits.face_idx[both]], hits.barycentric[both][..., None]
        mine = {
            n: (np.asarray(getattr(surface, n)).reshape(len(surface.vertices), -1)[corner] * share).sum(1)
            for n in ("albedo", "roughness", "metallic", "normals")
        }
        found = surface_attributes(truth, true_hits.face_idx[both], true_hits.barycentric[both])
        theirs = {
            n: np.asarray(found[n]).reshape(both.sum(), -1) for n in ("albedo", "roughness", "metallic", "normal")
        }
        toward = torch.as_tensor(np.ascontiguousarray(-directions[both], np.float32))
        pictures = []
        for one, normal in ((mine, mine["normals"]), (theirs, theirs["normal"])):
            normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
            lit = shade(
                torch.as_tensor(np.float32(normal)),
                toward,
                torch.as_tensor(np.float32(one["albedo"])),
                torch.as_tensor(np.float32(one["roughness"][:, 0])),
                torch.as_tensor(np.float32(one["metallic"][:, 0])),
                light,
            )
            pictures.append(srgb_from_linear(np.clip(lit.numpy(), 0, 1)))
        squares = lambda a, b: float(np.mean((np.asarray(a, np.float64) - b) ** 2))  # noqa: E731
        error["albedo_psnr"].append(
            squares(srgb_from_linear(np.clip(mine["albedo"], 0, 1)), srgb_from_linear(np.clip(theirs["albedo"], 0, 1)))
        )
        error["relit_psnr"].append(squares(*pictures))
        for name in ("roughness", "metallic"):
            error[f"{name}_error"].append(float(np.abs(mine[name] - theirs[name]).mean()))
    return {
        name: (float(-10 * np.log10(max(np.mean(e), 1e-10))) if name.endswith("psnr") else float(np.mean(e)))
        for name, e in error.items()
        if e
    }


def picture(vertices: np.ndarray, faces: np.ndarray, size: int = EDGE) -> np.ndarray:
    """The shape (size, size, 3) from above at the right, flat shaded; white where there is none."""
    from gdtool.cameras import camera_at, rays
    from gdtool.geometry.normals import face_normals
    from gdtool.geometry.rays import RayCaster

    camera = camera_at(32.0, 28.0, name="sheet", size=2 * size)
    origins, directions = (x.reshape(-1, 3) for x in rays(camera))
    hits = RayCaster(TriMesh(vertices, faces)).first_hit(origins, directions)
    image = np.ones((len(origins), 3))
    normal = face_normals(TriMesh(vertices, faces))[0][hits.face_idx[hits.is_hit]]
    normal *= np.where((normal * directions[hits.is_hit]).sum(1) > 0, -1.0, 1.0)[:, None]
    light = np.array([0.35, 0.8, 0.5]) / np.linalg.norm([0.35, 0.8, 0.5])
    image[hits.is_hit] = CLAY * (0.3 + 0.7 * np.clip(normal @ light, 0, 1))[:, None]
    return image.reshape(size, 2, size, 2, 3).mean((1, 3))


def keep_row(folder: Path, label: str, meshes: list) -> None:
    """Keep pictures of meshes (vertices, faces), None for an empty place, until sheet() joins them: a stopped run loses
    none."""
    place = folder / "reconstruct_pictures"
    place.mkdir(parents=True, exist_ok=True)
    name = f"{len(list(place.glob('*.npz'))):03d}.npz"
    np.savez_compressed(
        place / name, label=label, **{str(i): picture(*mesh) for i, mesh in enumerate(meshes) if mesh is not None}
    )


def sheet(folder: Path, heads: list[str], path: Path, done: bool) -> None:
    """Write the contact sheet of the rows kept in folder, of a case measured twice the later one; forget them when
    done."""
    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import write_png

    rows = {}
    kept = sorted((folder / "reconstruct_pictures").glob("*.npz"))
    for file in kept:
        with np.load(file) as row:
            rows[str(row["label"])] = [row.get(str(i)) for i in range(len(heads))]
    if rows:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, contact_sheet(list(rows.values()), heads, list(rows)))
    if done:
        shutil.rmtree(folder / "reconstruct_pictures", ignore_errors=True)
