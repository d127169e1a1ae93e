"""Measure a result against a reference, and print the figures.

Use it at the end of a pipe, or on any two of: folders of views, surface, mesh, atlas, asset or renders, and model
files. Geometry is measured against geometry in two protocols, pictures against pictures, whatever both hold. Without
--reference the model that the result came from is found along its provenance, and the views it came from say what part
of the truth was seen. An asset is also rendered through the cameras of those views. docs/metrics.md says what each
figure is.

Example:
  gdtool render-dataset procedural:7 | gdtool reconstruct | gdtool evaluate
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError, UsageError
from gdtool.core.folder import Folder, open_folder
from gdtool.core.provenance import ancestors, find_ancestor, origins
from gdtool.core.sources import Source, name_of
from gdtool.core.stage import MOST_SEED

if TYPE_CHECKING:
    import numpy as np

    from gdtool.assets.scene import Scene

READS = ("views", "surface", "mesh", "atlas", "asset", "renders", "model-file", "mesh-file")
GEOMETRY = ("surface", "mesh", "atlas", "asset")
MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
RENDERED = ("normal", "depth", "albedo", "roughness", "metallic")
SAME_POSE = 1e-4  # of camera matrices, in world units

Report = dict[str, bool | int | float | str]


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How to measure."""

    frame: Annotated[
        Literal["auto", "source", "box", "same"],
        Meta(
            description="how a model file gets into the result's frame: source = by the result's source_from_world, "
            "box = centred with longest side 1, same = it is there already; auto: same for two files, source where the "
            "result has one, else box"
        ),
    ] = "auto"
    samples: Annotated[int, Meta(ge=100, le=10_000_000, description="points drawn on each surface")] = 100_000
    threshold: Annotated[
        float,
        Meta(gt=0, le=1, description="distance that counts as a match in the F-score, largest extent of the truth 1"),
    ] = 0.01
    syncdreamer: Annotated[bool, Meta(description="measure by the protocol of the published tables too")] = True
    render: Annotated[
        bool, Meta(description="render an asset or a model through the cameras of the views and compare the pictures")
    ] = True
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="of the drawn points")] = 0


@dataclass(frozen=True)
class Geometry:
    """Triangles, and how many of the faces they were cut from are quads. source_from_world (4, 4), None of a file.

    in_source_frame: the vertices are in the source's frame, not in the normalised one.
    """

    vertices: np.ndarray
    faces: np.ndarray
    quads: int = 0
    source_from_world: np.ndarray | None = None
    in_source_frame: bool = False


def evaluate(result: Source, reference: Source | None, options: Options, views: Folder | None = None) -> Report:
    """All figures of a result, by name. reference None: found along the result's provenance; so are the views.

    Raises UsageError when there is no reference, InputError when the two cannot be compared.
    """
    report: Report = {"result": name_of(result), "kind": _kind(result)}
    if report["kind"] in ("views", "renders"):
        return report | _pictures(result, reference)
    if views is None and isinstance(result, Folder):
        found = find_ancestor(result, "views", "name the views with --views")
        views = open_folder(found.path) if found else None
    if views is None and _kind(reference) == "views":
        views = reference
    truth = reference if reference is not None else _truth_along(result)
    if truth is None and views is None:
        raise UsageError(
            name_of(result), "has neither model nor views along its provenance chain", "name one with --reference"
        )

    geometry = read_geometry(result)
    report |= _shape(geometry)
    against = _model_of(truth) if truth is not None else None
    if against is not None:
        report["reference"] = name_of(truth)
        report |= _surfaces(geometry, against, options, views)
    elif reference is not None and not (options.render and _has_material(result)):
        raise InputError(
            _place(reference),
            "holds no model to measure the geometry against",
            "name the model itself with --reference",
        )
    # Views named as the reference are the truth of the pictures; those along the provenance may have been generated.
    pictures = reference if _kind(reference) == "views" else views
    if options.render and pictures is not None and _has_material(result):
        report["reference_views"] = pictures.name
        report |= _rendered(result, pictures)
    elif against is None:
        raise UsageError(name_of(result), "was not made from a known model", "name one with --reference")
    return report


def _kind(source: Source | None) -> str:
    return source.kind if isinstance(source, Folder) else "" if source is None else "model"


def _place(source: Source) -> str:
    return str(source.path if isinstance(source, Folder) else source)


def _has_material(source: Source) -> bool:
    """Whether there is something to render that the views can judge: not a bare mesh."""
    return _kind(source) in ("asset", "surface", "model")


def _truth_along(result: Source) -> Source | None:
    """Return the model that a result was made from: a file or procedural:SEED, or the views that carry their model; or
    None."""
    if not isinstance(result, Folder):
        return None
    cure = "name what to measure against with --reference"
    chain = [result, *ancestors(result, cure)]
    for folder in chain:
        generated = next((entry.path for entry in folder.manifest.inputs if entry.path.startswith("procedural:")), None)
        if generated:
            return generated
        for origin in origins(folder):
            if origin.path.suffix.lower() in MODEL_SUFFIXES and origin.path.is_file():
                origin.require_same(cure)
                return origin.path
    return next((folder for folder in chain if folder.kind == "views" and folder.content.model), None)


def _model_of(reference: Source) -> Source | None:
    """Return what of a reference has geometry: itself, the model in a views folder or the one it was made from, or
    None."""
    if _kind(reference) == "renders":
        return None
    if _kind(reference) != "views" or reference.content.model:
        return reference
    return _truth_along(reference)


def read_geometry(source: Source) -> Geometry:
    """Return the triangles of anything that has some. Raises InputError."""
    import numpy as np

    if _kind(source) == "model":
        scene = _load(source)
        return Geometry(scene.vertices, scene.faces)
    matrix = np.array(source.content.source_from_world).reshape(4, 4)
    if source.kind == "surface":
        from gdtool.folders.surface import read_surface

        surface = read_surface(source)
        return Geometry(surface.vertices, surface.faces, 0, matrix)
    if source.kind in ("mesh", "atlas"):
        from gdtool.folders.mesh import read_mesh
        from gdtool.geometry.topology import triangulated

        mesh = read_mesh(source)
        return Geometry(mesh.vertices, triangulated(mesh.faces)[0], int(mesh.is_quad.sum()), matrix)
    if source.kind == "asset":
        from gdtool.folders.mesh import read_obj

        # The .glb is what an engine shows; only the .obj knows which triangles were quads.
        scene = _load(source.file("asset.glb"))
        quads = int(read_obj(source.file("asset.obj")).is_quad.sum())
        return Geometry(scene.vertices, scene.faces, quads, matrix, source.content.frame == "source")
    scene = _load(source.file("source.glb"))  # of views: as they show it
    return Geometry(scene.vertices, scene.faces, 0, matrix)


def _load(path: Path | str) -> Scene:
    from gdtool.assets.load import load_scene

    return load_scene(path)


def _shape(geometry: Geometry) -> Report:
    import numpy as np

    from gdtool.geometry.meshes import TriMesh
    from gdtool.geometry.metrics import is_closed, weld_faces

    mesh = TriMesh(geometry.vertices, geometry.faces)
    return {
        "vertices": len(np.unique(weld_faces(mesh))),
        "faces": len(geometry.faces) - geometry.quads,
        "quads": geometry.quads,
        "watertight": is_closed(mesh),
    }


def _in_world(geometry: Geometry) -> np.ndarray:
    """Vertices in the normalised frame that the geometry's own folder states; a file's as they are."""
    from gdtool.geometry.frames import invert_similarity, transform_points

    if not geometry.in_source_frame:
        return geometry.vertices
    return transform_points(invert_similarity(geometry.source_from_world), geometry.vertices)


def _surfaces(geometry: Geometry, truth: Source, options: Options, views: Folder | None) -> Report:
    """Both protocols, in the normalised frame of the result."""
    from gdtool.folders.records import read_cameras
    from gdtool.geometry import metrics
    from gdtool.geometry.meshes import TriMesh

    true_geometry = read_geometry(truth)
    vertices, true_vertices = _in_world(geometry), _in_world(true_geometry)
    if _kind(truth) == "model":
        true_vertices = _brought_in(true_geometry, geometry, options.frame)
    cameras = read_cameras(views.file("cameras.json")) if views is not None else None
    # The cameras are in the normalised frame: of two files nothing says where that is.
    known = geometry.source_from_world is not None or options.frame == "box"
    mesh, true_mesh = TriMesh(vertices, geometry.faces), TriMesh(true_vertices, true_geometry.faces)
    how = metrics.SurfaceOptions(
        cameras=cameras if cameras is not None and known else (),
        samples=options.samples,
        seed=options.seed,
        threshold=options.threshold,
    )
    found = metrics.surface_protocol(mesh, true_mesh, how)
    report: Report = {
        f"surface_{name}" if not name.startswith("seen_") else name: value for name, value in found.items()
    }
    report["reference_watertight"] = "iou" in found
    if options.syncdreamer:
        found = metrics.syncdreamer_protocol(mesh, true_mesh)
        report |= {f"syncdreamer_{name}": value for name, value in found.items()}
    return report


def _brought_in(truth: Geometry, result: Geometry, frame: str) -> np.ndarray:
    """Return the vertices of a model file in the frame that the result is measured in."""
    import numpy as np

    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

    matrix = result.source_from_world
    if frame == "auto":
        # A result without a similarity of its own came from a picture: its frame is the unit box.
        frame = "same" if matrix is None else "box" if np.allclose(matrix, np.eye(4), atol=1e-12) else "source"
    if frame == "source":
        if matrix is None:
            raise UsageError("--frame source", "needs a result that is a folder", "use --frame box or same")
        return transform_points(invert_similarity(matrix), truth.vertices)
    if frame == "box":
        return transform_points(invert_similarity(unit_box(truth.vertices[np.unique(truth.faces)])), truth.vertices)
    return truth.vertices


def _pictures(result: Folder, reference: Source | None) -> Report:
    """Return views against views or renders against renders."""
    from gdtool.images.metrics import resized_views, views_metrics

    if reference is None:
        reference = next(
            (folder for folder in ancestors(result, "name one with --reference") if folder.kind == result.kind), None
        )
        if reference is None:
            raise UsageError(
                result.path, f"has no other {result.kind} along its provenance chain", "name one with --reference"
            )
        reference = open_folder(reference.path)
    if _kind(reference) != result.kind:
        cure = (
            f"run gdtool render-dataset {_place(reference)} --cameras {result.path} first"
            if result.kind == "views"
            else "name a renders folder with --reference"
        )
        raise InputError(_place(reference), f"holds {_kind(reference)}, but the result holds {result.kind}", cure)
    read = _read_renders if result.kind == "renders" else _read_views
    (images, mask, names), (true_images, true_mask, true_names) = read(result), read(reference)
    shared = [name for name in true_names if name in names]
    if not shared:
        raise InputError(
            result.path,
            f"has no view in common with {reference.path} ({', '.join(true_names)})",
            f"run gdtool render-dataset with --cameras {reference.path}"
            if result.kind == "views"
            else "render both with the same --views",
        )
    if result.kind == "views":
        _check_cameras(result, reference, shared)
    pick, true_pick = [names.index(name) for name in shared], [true_names.index(name) for name in shared]
    height, width = min(mask.shape[1:], true_mask.shape[1:])
    small, small_mask = resized_views({d: x[pick] for d, x in images.items()}, mask[pick], height, width)
    true_small, true_small_mask = resized_views(
        {d: x[true_pick] for d, x in true_images.items()}, true_mask[true_pick], height, width
    )
    return {
        "reference": reference.name,
        "views": len(shared),
        **views_metrics(small, small_mask, true_small, true_small_mask),
    }


def _read_views(folder: Folder) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    from gdtool.folders.views import read_views

    views = read_views(folder)
    return views.images, views.mask, list(views.names)


def _read_renders(folder: Folder) -> tuple[dict[str, np.ndarray], np.ndarray, list[str]]:
    import numpy as np

    from gdtool.images.color import linear_from_srgb
    from gdtool.images.io import read_image

    names = [f"{i:03d}" for i in range(folder.content.frames)]
    frames = [read_image(folder.file(f"{name}.png")) for name in names]
    if len({frame.shape for frame in frames}) > 1 or frames[0].shape[2] != 4:
        raise InputError(folder.path, "has frames of different sizes, or without alpha", "run gdtool relight again")
    stack = np.stack(frames).astype(np.float32) / np.iinfo(frames[0].dtype).max
    return {"color": linear_from_srgb(stack[..., :3]).astype(np.float32)}, stack[..., 3], names


def _check_cameras(result: Folder, reference: Folder, names: list[str]) -> None:
    """Raise InputError when a view was not taken from the same place. The sizes of the pictures may differ."""
    import numpy as np

    from gdtool.folders.records import read_cameras

    mine, other = (
        {camera.name: camera for camera in read_cameras(folder.file("cameras.json"))} for folder in (result, reference)
    )
    for name in names:
        a, b = mine[name], other[name]
        same = a.projection == b.projection and np.allclose(a.world_from_camera, b.world_from_camera, atol=SAME_POSE)
        if a.projection == "orthographic":
            same = same and np.isclose(a.half_width, b.half_width, rtol=SAME_POSE)
        else:
            same = same and np.isclose(a.fx / a.width, b.fx / b.width, rtol=SAME_POSE)
        if not same or a.width * b.height != a.height * b.width:
            raise InputError(
                result.path,
                f"sees {name} from another camera than {reference.path}",
                f"run gdtool render-dataset with --cameras {reference.path}",
            )


def _rendered(result: Source, views: Folder) -> Report:
    """Return the result's buffers through the cameras of the views, against the views' own pictures."""
    import numpy as np

    from gdtool.folders.views import read_views
    from gdtool.images.metrics import views_metrics
    from gdtool.shading.render.render import Renderer

    truth = read_views(views, RENDERED)
    scenes = _scenes(result)
    images: dict[str, np.ndarray] = {}
    for scene, names in scenes:
        renderer = Renderer(scene)
        buffers = [renderer.buffers(camera) for camera in truth.cameras]
        images |= {
            name: np.stack([channel(one) for one in buffers])
            for name, channel in names.items()
            if name in (*truth.images, "mask")
        }
    mask = images.pop("mask")
    return {"views": len(truth.cameras), **views_metrics(images, mask, truth.images, truth.mask)}


def _scenes(source: Source) -> list[tuple[Scene, dict[str, Callable[[dict[str, np.ndarray]], np.ndarray]]]]:
    """Return what to render of a result, in the normalised frame, and which image of the buffers is which domain.

    A surface has its material per vertex, which a Scene has for base color only: roughness and metallic are rendered as
    the base color of a second one.
    """
    from dataclasses import replace

    import numpy as np

    from gdtool.assets.scene import Material, Scene

    every = {name: (lambda buffers, name=name: buffers[name]) for name in (*RENDERED, "mask")}
    if _kind(source) != "surface":
        scene = _load(source.file("asset.glb") if isinstance(source, Folder) else source)
        return [
            (
                _normalised(scene, source)
                if isinstance(source, Folder) and source.content.frame == "source"
                else scene,
                every,
            )
        ]
    from gdtool.folders.surface import read_surface

    surface = read_surface(source)
    scene = Scene(
        surface.vertices,
        surface.faces,
        (Material("surface", metallic=0.0),),
        normals=surface.normals,
        colors=_rgba(surface.albedo),
    )
    rough = replace(scene, colors=_rgba(np.stack([surface.roughness, surface.metallic, surface.metallic], -1)))
    parts = {
        "roughness": lambda buffers: buffers["albedo"][..., 0],
        "metallic": lambda buffers: buffers["albedo"][..., 1],
    }
    return [(scene, {name: every[name] for name in ("normal", "depth", "albedo", "mask")}), (rough, parts)]


def _rgba(color: np.ndarray) -> np.ndarray:
    import numpy as np

    return np.concatenate([color, np.ones((len(color), 1))], -1)


def _normalised(scene: Scene, folder: Folder) -> Scene:
    """Return a scene in its source's frame, brought into the normalised one."""
    from dataclasses import replace

    import numpy as np

    from gdtool.geometry.frames import invert_similarity, transform_points

    matrix = invert_similarity(np.array(folder.content.source_from_world).reshape(4, 4))
    turn = matrix[:3, :3] / np.linalg.norm(matrix[:3, 0])
    normals = None if scene.normals is None else scene.normals @ turn.T
    tangents = (
        None if scene.tangents is None else np.concatenate([scene.tangents[:, :3] @ turn.T, scene.tangents[:, 3:]], 1)
    )
    return replace(scene, vertices=transform_points(matrix, scene.vertices), normals=normals, tangents=tangents)


# What the figures are called on a terminal, and how they are grouped there; docs/metrics.md explains each.
GROUPS = (
    ("surface protocol", "surface_"),
    ("surface protocol, the part that the views see", "seen_"),
    ("syncdreamer protocol", "syncdreamer_"),
    ("pictures", ("mask_", "color_", "albedo_", "closed_form_", "normal_", "depth_", "roughness_", "metallic_")),
)
UNITS = {"degrees": "°", "psnr": " dB"}


def table(report: Report) -> str:
    """Return the report for a reader: what it is about, then the figures in their groups."""
    lines: list[str] = []

    def add(name: str, label: str) -> None:
        value = report[name]
        text = (
            ("yes" if value else "no")
            if isinstance(value, bool)
            else f"{value:.5g}"
            if isinstance(value, float)
            else str(value)
        )
        unit = next((unit for word, unit in UNITS.items() if word in name), "")
        lines.append(f"  {label.replace('_', ' '):<24}{text}{unit}")

    groups = [(title, [name for name in report if name.startswith(prefix)], prefix) for title, prefix in GROUPS]
    grouped = {name for _, names, _ in groups for name in names}
    lines.append(f"{report['result']} ({report['kind']})")
    for name in report:
        if name not in grouped and name not in ("result", "kind"):
            add(name, name)
    for title, names, prefix in groups:
        if names:
            lines.append(title)
            for name in names:
                add(name, name.removeprefix(prefix) if isinstance(prefix, str) else name)
    return "\n".join(lines)
