"""Read the inputs of a bake: the mesh to bake for, and the surface or model to bake from."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gdtool.bake.origin import Origin, from_scene, from_surface, material_field
from gdtool.bake.picture import Picture, picture_of
from gdtool.bake.target import Target, size_and_samples, texel_width
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.folders.mesh import read_mesh, read_obj
from gdtool.folders.views import Views
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
from gdtool.geometry.meshes import QuadMesh, TriMesh

# A mesh file is taken to be in the normalised frame when its bounding box is centred to this distance, and its longest
# side is 1 to this difference.
NORMALISED_OFFSET, NORMALISED_SCALE = 0.02, 0.05
# Larger texture coordinates are taken to be damaged: textures are not repeated this often.
MAX_UV = 64
# The least share of doubly covered texels, of those covered, that is worth a warning.
OVERLAP_SHARE = 0.001
# Side in texels of the image in which overlaps are counted.
OVERLAP_SIZE = 512

# Triangles of the target, about, that are compared with the source to find whether it is inside out.
MOST_COMPARED = 5000

MATERIALS = ("albedo", "roughness", "metallic")


@dataclass
class SourceChoice:
    """The choice of a source to bake from.

    surface, views: folders, None where there are none. model: a model file or procedural:SEED that replaces the
    surface. project_views: whether to read the views. size: side of the maps in texels; samples: samples per texel;
    None chooses either by the source's detail (target.size_and_samples). device: the torch device for networks.
    skipped: (what, why) of each input that was left out; reading appends to it.
    """

    surface: Folder | None
    views: Folder | None
    model: str | None
    project_views: bool = True
    size: int | None = None
    samples: int | None = None
    device: str = "cpu"
    skipped: list[tuple[str, str]] = field(default_factory=list)


def path_of(source: Folder | Path | str) -> Path | str:
    """Return the path or name of a source, for messages."""
    return source.path if isinstance(source, Folder) else source


def named_model(source: Folder | Path | str, model: str | None) -> str:
    """Return the model to bake from: `model`, or without it the one that the mesh folder was remeshed from.

    Raises InputError where there is neither.
    """
    from gdtool.assets.load import SUFFIXES
    from gdtool.core.provenance import find_source

    if model is None and hasattr(source, "content"):
        model = find_source(source, "name the model to bake from with --model")
        if model is not None and not model.startswith("procedural:") and Path(model).suffix.lower() not in SUFFIXES:
            model = None
    if model is None:
        raise InputError(
            path_of(source),
            "has no surface to bake from along its provenance chain",
            "name one with --surface or --model",
        )
    return model


def read_target_mesh(source: Folder | Path | str, surface: Folder | None) -> tuple[QuadMesh, np.ndarray]:
    """Read the mesh to bake for, in the normalised frame, and the matrix (4, 4) from there to its source's frame.

    surface: the folder that is baked from, None for a model. A mesh file may be in either frame. If it fills the unit
    box, it is taken to be normalised, like the surface; otherwise it is taken to be in the source's frame. Raises
    InputError for a mesh without usable texture coordinates.
    """
    in_folder = hasattr(source, "content")
    if in_folder:
        mesh, matrix = read_mesh(source), np.array(source.content.source_from_world).reshape(4, 4)
    elif isinstance(source, str):
        raise InputError(
            source, "has no texture coordinates of its own to bake into", "run gdtool remesh and gdtool unwrap first"
        )
    else:
        mesh = read_obj(source) if source.suffix.lower() == ".obj" else _triangles_of_scene(source)
    if mesh.uv is None:
        raise InputError(path_of(source), "has no texture coordinates", "run gdtool unwrap")
    if not in_folder:
        box = unit_box(mesh.vertices)
        matrix = np.array(surface.content.source_from_world).reshape(4, 4) if surface is not None else box
        normalised = np.abs(box[:3, 3]).max() < NORMALISED_OFFSET and abs(box[0, 0] - 1) < NORMALISED_SCALE
        if surface is None or not normalised:
            mesh = dataclasses.replace(mesh, vertices=transform_points(invert_similarity(matrix), mesh.vertices))
    if np.abs(mesh.uv).max() > MAX_UV:
        raise InputError(
            path_of(source), f"has texture coordinates as large as {np.abs(mesh.uv).max():g}", "run gdtool unwrap"
        )
    return mesh, matrix


def _triangles_of_scene(path: Path) -> QuadMesh:
    """Read a model file as a mesh with the texture coordinates of its first UV set."""
    from gdtool.assets.load import load_scene

    scene = load_scene(path)
    uv = scene.uvs[0] if scene.uvs else None
    faces = np.concatenate([scene.faces, np.full((len(scene.faces), 1), -1, np.int32)], 1)
    return QuadMesh(scene.vertices, faces, uv, None if uv is None else faces)


def target_of(mesh: QuadMesh) -> tuple[Target, np.ndarray]:
    """Cut a mesh of quads into the triangles to bake into; return them and the quad (t,) of each triangle."""
    uv, quad_uvs = mesh.texture_coordinates()
    faces, face_idx = mesh.triangulation
    # The texture corners are cut the same way: the second triangle of a quad has its corners 0, 2, 3.
    second = np.zeros(len(faces), bool)
    second[1:] = face_idx[1:] == face_idx[:-1]
    corners = np.where(second[:, None], [0, 2, 3], [0, 1, 2])
    face_uvs = np.take_along_axis(quad_uvs[face_idx], corners, 1)
    return Target.of(TriMesh(mesh.vertices, faces), uv, face_uvs), face_idx


def uv_warnings(target: Target) -> list[str]:
    """Return warnings of texture coordinates that spoil maps: those that overlap or leave the unit square."""
    from gdtool.geometry.uv_raster import owner_count

    out = []
    count = owner_count(target.uv, target.face_uvs, OVERLAP_SIZE)
    share = float((count > 1).sum() / max((count > 0).sum(), 1))
    if share > OVERLAP_SHARE:
        out.append(
            f"texture coordinates overlap on {100 * share:.1f} % of what they cover; the first face there is baked"
        )
    if target.uv.min() < -1e-6 or target.uv.max() > 1 + 1e-6:
        out.append("texture coordinates leave the unit square; what lies outside is not baked")
    return out


def read_origin(
    source: Folder | Path | str, choice: SourceChoice, target: Target, matrix: np.ndarray
) -> tuple[Origin, bool]:
    """Read what to bake from: the surface with its views, or else a model.

    The model is the one that `choice` names, or the one that the mesh was remeshed from. source: what the mesh was read
    from. matrix (4, 4): from the normalised frame to the model's. Also returns whether the source's faces were flipped,
    because nine in ten faced away from the target's.
    """
    origin = _origin(source, choice, target, matrix)
    vertices, faces = target.mesh.vertices, target.mesh.faces
    few = slice(None, None, max(1, len(faces) // MOST_COMPARED))
    turned = origin.source.flip_if_inside_out(vertices[faces[few]].mean(1), target.normals[few].mean(1))
    return origin, turned


def _origin(source: Folder | Path | str, choice: SourceChoice, target: Target, matrix: np.ndarray) -> Origin:
    """Read the surface with its views, or else the model, as read_origin() does, but without flipping faces."""
    if choice.model is None and choice.surface is not None:
        return _surface_origin(choice)
    from gdtool.assets.load import load_scene

    def footprint(detail: float) -> float:
        size, samples = size_and_samples(target, detail, choice.size, choice.samples)
        # Bilinear lookups average as well: a mip level as coarse as the sample is wide would blur twice.
        return 0.5 * texel_width(target, size) / samples**0.5

    return from_scene(load_scene(named_model(source, choice.model)), matrix, footprint)


def _surface_origin(choice: SourceChoice) -> Origin:
    """Read the surface, its views, and the material field where the views lack a material."""
    from gdtool.folders.surface import read_surface
    from gdtool.folders.views import read_views

    views, surface = None, choice.surface
    if not choice.project_views:
        choice.skipped.append(("views", "left out by --no-project-views"))
    elif choice.views is None:
        choice.skipped.append(("views", "none along the provenance chain: materials come from the surface's vertices"))
    else:
        views = read_views(choice.views, (*MATERIALS, "normal"))
        for domain in (*MATERIALS, "normal"):
            if domain not in views.images:
                choice.skipped.append((f"{domain} views", "the views do not have it: the surface's vertices are used"))
    use_field = surface.content.field and not (views and set(MATERIALS) <= set(views.images))
    network = material_field(surface.file("field.safetensors"), choice.device) if use_field else None
    views = views if views is not None and views.images else None
    return from_surface(read_surface(surface), views, network, None if views is None else _read_picture(choice, views))


def _read_picture(choice: SourceChoice, views: Views) -> Picture | None:
    """Read the picture that the views were generated from; None where their folder lacks it or they have no albedo."""
    from gdtool.folders.views import read_picture

    image_and_camera = read_picture(choice.views, views.cameras)
    if image_and_camera is None or "albedo" not in views.images:
        missing = image_and_camera is None
        choice.skipped.append(
            ("picture", "the views' folder holds none" if missing else "the views have no albedo to add its detail to")
        )
        return None
    image, camera = image_and_camera
    return picture_of(image, camera, views.images["albedo"][views.names.index(camera.name)])
