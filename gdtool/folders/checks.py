"""Check the files of each kind of folder as a stage would read them: one line for each fault."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from gdtool.assets.load import load_scene
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder, dataset_objects
from gdtool.core.kinds import CONTENTS, AssetContent, RendersContent, SurfaceContent, ViewsContent
from gdtool.core.manifest import check_files
from gdtool.folders.mesh import read_mesh
from gdtool.folders.surface import read_surface
from gdtool.folders.views import read_picture, read_views
from gdtool.geometry.topology import is_watertight
from gdtool.images.io import read_image

# Largest difference of a normal's length from 1: 8-bit storage rounds by less.
UNIT_TOLERANCE = 0.05
# World units by which depth may leave the camera's near and far: float32 rounds by less.
DEPTH_TOLERANCE = 1e-4
# By how much texture coordinates may leave [0, 1]: text of nine digits rounds by less.
UV_TOLERANCE = 1e-6


def faults_in_files(folder: Folder) -> Iterator[str]:
    """Yield what is wrong with the files of a folder. Raises InputError at the first one that cannot be read."""
    yield from CHECKS[folder.kind](folder)


def required_files(folder: Folder) -> set[str]:
    """Return the names of the files that a folder of this kind and content must have."""
    content = folder.content
    if isinstance(content, ViewsContent):
        suffix = {domain: "exr" if domain == "depth" else "png" for domain in content.domains}
        files = {f"{domain}/{view}.{suffix[domain]}" for domain in content.domains for view in content.views}
        files |= {f"mask/{view}.png" for view in content.views} | {"cameras.json"}
        files |= {f"condition/{i:03d}.png" for i in range(content.conditions)}
        return files | ({"light.json"} if content.light else set()) | ({"source.glb"} if content.model else set())
    if isinstance(content, SurfaceContent):
        extra = ({"light.json"} if content.light else set()) | ({"field.safetensors"} if content.field else set())
        return {"surface.ply"} | extra
    if isinstance(content, AssetContent):
        usd = {content.usd} if content.usd else set()
        return {"asset.glb", "asset.obj", "asset.mtl"} | set(content.maps.values()) | usd
    if isinstance(content, RendersContent):
        return {f"{i:03d}.png" for i in range(content.frames)}
    return {"mesh": {"mesh.obj"}, "atlas": {"mesh.obj"}, "model": {"config.json", "card.md"}}.get(folder.kind, set())


def check_scene(path: Path) -> Iterator[str]:
    """Check a model file: it has faces, and its texture coordinates are finite."""
    scene = load_scene(path)
    if not len(scene.faces):
        yield f"{path}: has no faces"
    for index, uv in enumerate(scene.uvs):
        if uv is not None and not np.isfinite(uv).all():
            yield f"{path}: TEXCOORD_{index} is not finite"


def _check_views(folder: Folder) -> Iterator[str]:
    """Check that masks are not empty, normals are unit, and depth lies between near and far."""
    views = read_views(folder)
    read_picture(folder, views.cameras)
    for k, camera in enumerate(views.cameras):
        inside = views.mask[k] > 0.5
        if not inside.any():
            yield f"{folder.file(f'mask/{camera.name}.png')}: is empty"
        if "normal" in views.images:
            length = np.linalg.norm(views.images["normal"][k][inside], axis=-1)
            if len(length) and np.abs(length - 1).max() > UNIT_TOLERANCE:
                yield (
                    f"{folder.file(f'normal/{camera.name}.png')}: holds normals that are not unit (length "
                    f"{length.min():.3f} to {length.max():.3f})"
                )
        if "depth" in views.images:
            depth = views.images["depth"][k][inside]
            if len(depth) and (
                depth.min() < camera.near - DEPTH_TOLERANCE or depth.max() > camera.far + DEPTH_TOLERANCE
            ):
                yield (
                    f"{folder.file(f'depth/{camera.name}.exr')}: is not within near {camera.near:g} and far "
                    f"{camera.far:g}"
                )


def _check_dataset(folder: Folder) -> Iterator[str]:
    """Check the files of every views folder that a dataset lists."""
    for views in dataset_objects(folder):
        check_files(views.path, views.manifest)
    yield from ()


def _check_model(folder: Folder) -> Iterator[str]:
    """Check that the weights can be read."""
    weights = [entry.path for entry in folder.manifest.files if entry.path.endswith(".safetensors")]
    if not weights:
        yield f"{folder.path}: holds no .safetensors"
    for name in weights:
        try:
            with safe_open(folder.file(name), "numpy") as file:
                list(file.keys())
        except SafetensorError as error:
            yield f"{folder.file(name)}: is not safetensors ({error})"


def _check_surface(folder: Folder) -> Iterator[str]:
    """Check that the surface is closed where the manifest says so, and its counts."""
    surface = read_surface(folder)
    listed = folder.content_as(SurfaceContent).watertight
    if is_watertight(surface.faces) != listed:
        yield f"{folder.file('surface.ply')}: the manifest says watertight = {listed}, which it is not"
    yield from _check_counts(folder, len(surface.vertices), {"faces": len(surface.faces)})


def _check_mesh(folder: Folder) -> Iterator[str]:
    """Check the counts of a mesh or an atlas, and the range of its texture coordinates."""
    mesh = read_mesh(folder)
    quads = int(mesh.is_quad.sum())
    yield from _check_counts(folder, len(mesh.vertices), {"quads": quads, "triangles": len(mesh.faces) - quads})
    if folder.kind == "atlas":
        if mesh.uv is None:
            raise InputError(folder.file("mesh.obj"), "has no texture coordinates", "run gdtool unwrap")
        if mesh.uv.min() < -UV_TOLERANCE or mesh.uv.max() > 1 + UV_TOLERANCE:
            yield f"{folder.file('mesh.obj')}: has texture coordinates outside [0, 1]"


def _check_counts(folder: Folder, vertices: int, counts: dict[str, int]) -> Iterator[str]:
    """Compare the counts of a manifest with those of the file."""
    for name, count in {"vertices": vertices, **counts}.items():
        listed = getattr(folder.content, name)
        if listed != count:
            yield f"{folder.path}: the manifest says {listed} {name}, the file holds {count}"


def _check_asset(folder: Folder) -> Iterator[str]:
    """Check the .glb, and that every map can be read and is square."""
    yield from check_scene(folder.file("asset.glb"))
    for name, relative in folder.content_as(AssetContent).maps.items():
        image = read_image(folder.file(relative))
        if image.shape[0] != image.shape[1]:
            yield f"{folder.file(relative)}: map {name} is not square"


def _check_renders(folder: Folder) -> Iterator[str]:
    """Check that every frame can be read."""
    for i in range(folder.content_as(RendersContent).frames):
        read_image(folder.file(f"{i:03d}.png"))
    yield from ()


CHECKS: dict[str, Callable[[Folder], Iterator[str]]] = {
    "views": _check_views,
    "dataset": _check_dataset,
    "model": _check_model,
    "surface": _check_surface,
    "mesh": _check_mesh,
    "atlas": _check_mesh,
    "asset": _check_asset,
    "renders": _check_renders,
}
assert CHECKS.keys() == CONTENTS.keys()
