"""Check folders and .glb files against the format; exit 3 with the first faults.

Use it on a folder that another program wrote, or at the end of a pipe. Every file is opened and read as a stage would
read it: the manifest against its schema, the files against the manifest, pixel formats, ranges, indices, units.

Example:
  gdtool validate cat.asset/views cat.asset/asset/asset.glb
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder, dataset_objects, open_folder
from gdtool.core.kinds import CONTENTS
from gdtool.core.manifest import MANIFEST, check_files
from gdtool.core.runner import key_of, names_file
from gdtool.core.sources import digest

STAGES = (
    "render-dataset",
    "train",
    "sample-views",
    "import-views",
    "reconstruct",
    "remesh",
    "unwrap",
    "bake",
    "relight",
)


def faults(path: Path) -> Iterator[str]:
    """Yield what is wrong with a folder or a .glb/.gltf, one line each; nothing when it is right.

    Raises ResourceError where that cannot be told here: a package or memory is missing.
    """
    if path.suffix.lower() in (".glb", ".gltf"):
        yield from _read(lambda: _check_scene(path))
        return
    try:
        folder = open_folder(path)
    except InputError as error:
        yield str(error)
        return
    listed = {entry.path for entry in folder.manifest.files}
    for name in sorted(_needed(folder) - listed):
        yield f"{folder.file(name)}: {folder.kind} needs it, and the manifest does not list it"
    yield from _check_key(folder)
    yield from _read(lambda: CHECKS[folder.kind](folder))


def _read(check: Callable[[], Iterator[str]]) -> Iterator[str]:
    try:
        yield from check()
    except InputError as error:
        yield str(error)


def _check_key(folder: Folder) -> Iterator[str]:
    """Check that the key is the one that the stage, its version, the options and the inputs give.

    Nothing is said of a manifest without a key or of another program's stage, nor where an option names a file that
    lies elsewhere by now: its digest is part of the key."""
    manifest = folder.manifest
    if not manifest.key or manifest.stage not in STAGES:
        return
    options = dict(manifest.options)
    stage = importlib.import_module("gdtool.stages." + manifest.stage.replace("-", "_")).STAGE
    for name in (field.name for field in msgspec.structs.fields(stage.Options) if names_file(field)):
        value = options.get(name)
        if not isinstance(value, str) or not value.startswith(".."):
            continue  # not given, or one of the stage's built-in names
        path = folder.path.resolve() / value
        if not path.is_file():
            return
        options[name] = digest(path)
    given = [(entry.role, entry.digest) for entry in manifest.inputs]
    if key_of(manifest.stage, manifest.stage_version, options, given) != manifest.key:
        yield (
            f"{folder.path / MANIFEST}: options and inputs are not those that the key was made of; run gdtool "
            f"{manifest.stage} again"
        )


def _needed(folder: Folder) -> set[str]:
    """Files that a folder of this kind and content must have."""
    content = folder.content
    if folder.kind == "views":
        suffix = {domain: "exr" if domain == "depth" else "png" for domain in content.domains}
        files = {f"{domain}/{view}.{suffix[domain]}" for domain in content.domains for view in content.views}
        files |= {f"mask/{view}.png" for view in content.views} | {"cameras.json"}
        files |= {f"condition/{i:03d}.png" for i in range(content.conditions)}
        return files | ({"light.json"} if content.light else set()) | ({"source.glb"} if content.model else set())
    if folder.kind == "surface":
        extra = ({"light.json"} if content.light else set()) | ({"field.safetensors"} if content.field else set())
        return {"surface.ply"} | extra
    if folder.kind in ("mesh", "atlas"):
        return {"mesh.obj"}
    if folder.kind == "asset":
        return (
            {"asset.glb", "asset.obj", "asset.mtl"}
            | set(content.maps.values())
            | ({content.usd} if content.usd else set())
        )
    if folder.kind == "renders":
        return {f"{i:03d}.png" for i in range(content.frames)}
    if folder.kind == "model":
        return {"config.json", "card.md"}
    return set()


def _check_views(folder: Folder) -> Iterator[str]:
    import numpy as np

    from gdtool.folders.views import read_picture, read_views

    views = read_views(folder)
    read_picture(folder, views.cameras)
    for k, camera in enumerate(views.cameras):
        inside = views.mask[k] > 0.5
        if not inside.any():
            yield f"{folder.file(f'mask/{camera.name}.png')}: is empty"
        if "normal" in views.images:
            length = np.linalg.norm(views.images["normal"][k][inside], axis=-1)
            if len(length) and np.abs(length - 1).max() > 0.05:
                yield (
                    f"{folder.file(f'normal/{camera.name}.png')}: holds normals that are not unit (length "
                    f"{length.min():.3f} to {length.max():.3f})"
                )
        if "depth" in views.images:
            depth = views.images["depth"][k][inside]
            if len(depth) and (depth.min() < camera.near - 1e-4 or depth.max() > camera.far + 1e-4):
                yield (
                    f"{folder.file(f'depth/{camera.name}.exr')}: is not within near {camera.near:g} and far "
                    f"{camera.far:g}"
                )


def _check_dataset(folder: Folder) -> Iterator[str]:
    for views in dataset_objects(folder):
        check_files(views.path, views.manifest)
    yield from ()


def _check_model(folder: Folder) -> Iterator[str]:
    from safetensors import SafetensorError, safe_open

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
    from gdtool.folders.surface import read_surface
    from gdtool.geometry.topology import is_watertight

    surface = read_surface(folder)
    if is_watertight(surface.faces) != folder.content.watertight:
        yield (
            f"{folder.file('surface.ply')}: the manifest says watertight = {folder.content.watertight}, which it is not"
        )
    yield from _check_counts(folder, len(surface.vertices), {"faces": len(surface.faces)})


def _check_mesh(folder: Folder) -> Iterator[str]:
    from gdtool.folders.mesh import read_mesh

    mesh = read_mesh(folder)
    quads = int(mesh.is_quad.sum())
    yield from _check_counts(folder, len(mesh.vertices), {"quads": quads, "triangles": len(mesh.faces) - quads})
    if folder.kind == "atlas":
        if mesh.uv is None:
            raise InputError(folder.file("mesh.obj"), "has no texture coordinates", "run gdtool unwrap")
        if mesh.uv.min() < -1e-6 or mesh.uv.max() > 1 + 1e-6:
            yield f"{folder.file('mesh.obj')}: has texture coordinates outside [0, 1]"


def _check_counts(folder: Folder, vertices: int, counts: dict[str, int]) -> Iterator[str]:
    for name, count in {"vertices": vertices, **counts}.items():
        listed = getattr(folder.content, name)
        if listed != count:
            yield f"{folder.path}: the manifest says {listed} {name}, the file holds {count}"


def _check_asset(folder: Folder) -> Iterator[str]:
    from gdtool.images.io import read_image

    yield from _check_scene(folder.file("asset.glb"))
    for name, relative in folder.content.maps.items():
        image = read_image(folder.file(relative))
        if image.shape[0] != image.shape[1]:
            yield f"{folder.file(relative)}: map {name} is not square"


def _check_renders(folder: Folder) -> Iterator[str]:
    from gdtool.images.io import read_image

    for i in range(folder.content.frames):
        read_image(folder.file(f"{i:03d}.png"))
    yield from ()


def _check_scene(path: Path) -> Iterator[str]:
    import numpy as np

    from gdtool.assets.load import load_scene

    scene = load_scene(path)
    if not len(scene.faces):
        yield f"{path}: has no faces"
    for index, uv in enumerate(scene.uvs):
        if uv is not None and not np.isfinite(uv).all():
            yield f"{path}: TEXCOORD_{index} is not finite"


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
