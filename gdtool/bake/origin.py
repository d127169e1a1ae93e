"""Prepare the source of a bake: a surface with its views, or a model with its textures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.bake.picture import Picture
from gdtool.bake.pipeline import Lookup, ViewsOfSource, vertex_lookup, with_views
from gdtool.bake.project_views import pixel_footprint, view_visibility
from gdtool.bake.reproject import Places, Source
from gdtool.folders.surface import Surface
from gdtool.folders.views import Views
from gdtool.geometry.frames import invert_similarity, transform_points
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import vertex_normals
from gdtool.geometry.tangents import dot


@dataclass(frozen=True)
class Origin:
    """A source in the normalised frame, the lookup of its material, and its vertex normals (v, 3).

    label: where materials come from, for the report. alpha_mode, alpha_cutoff, double_sided: as in glTF. detail: width
    of the source's finest detail in the normalised frame. It is the least of: a texel of the textures, half a pixel of
    the views, a pixel of the picture that the views were generated from, and without textures half an edge of the mesh.
    """

    source: Source
    lookup: Lookup
    normals: np.ndarray
    label: str
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    detail: float = 0.0


def material_field(path: Path, device: str = "cpu") -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """Load the material network of a surface's field.safetensors, as a function of points (n, 3).

    The function returns albedo (n, 3), roughness (n,) and metallic (n,). Raises InputError for a file that is damaged
    or holds another network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    from gdtool.core.errors import InputError
    from gdtool.fields.neural.networks import MaterialNetwork
    from gdtool.fields.neural.paper import network_materials

    network = MaterialNetwork()
    try:
        tensors = load_file(str(path))
        network.load_state_dict(
            {name.removeprefix("material."): value for name, value in tensors.items() if name.startswith("material.")}
        )
    except (SafetensorError, RuntimeError, OSError) as error:
        raise InputError(
            path,
            f"is not the material field that gdtool writes ({str(error).splitlines()[0]})",
            "run gdtool reconstruct again",
        ) from None
    network = network.to(device).eval()

    def materials_at(points: np.ndarray) -> dict[str, np.ndarray]:
        out = network_materials(network, points, device)
        return {name: value if name == "albedo" else value[:, 0] for name, value in out.items()}

    return materials_at


def from_surface(
    surface: Surface,
    views: Views | None,
    field: Callable[[np.ndarray], dict[str, np.ndarray]] | None = None,
    picture: Picture | None = None,
) -> Origin:
    """Prepare a surface: materials and normals come from views where these see it well, elsewhere from its vertices.

    field (see material_field) replaces the vertices for the materials that no view has. picture: the one that the views
    were generated from; it adds finer detail.
    """
    mesh = TriMesh(surface.vertices, surface.faces)
    source = Source(mesh)
    normals = surface.normals if surface.normals is not None else vertex_normals(mesh)
    attributes = {
        "albedo": surface.albedo,
        "roughness": surface.roughness,
        "metallic": surface.metallic,
        "confidence": surface.confidence,
    }
    lookup = vertex_lookup(source, attributes, normals.astype(np.float32))
    images = dict(views.images) if views is not None else {}
    label = "vertices"
    if field is not None:
        missing = [name for name in ("albedo", "roughness", "metallic") if name not in images]
        if missing:
            lookup, label = _with_field(lookup, source, field, missing), "field: " + " ".join(missing)
    if "normal" in images and not _views_are_finer(views, source):
        del images["normal"]
    detail = 0.5 * _median_edge(source)
    if not images:
        return Origin(source, lookup, normals, label, detail=detail)
    visibilities = [
        view_visibility(camera, source.caster, mask) for camera, mask in zip(views.cameras, views.mask, strict=True)
    ]
    lookup, domains = with_views(lookup, source, ViewsOfSource(visibilities, images, views.mask, picture))
    label = ("" if label == "vertices" else label + ", ") + "views: " + " ".join(domains)
    detail = min(detail, 0.5 * _view_pixel(views))
    if picture is not None and "albedo" in domains:
        label, detail = label + ", picture: albedo", min(detail, _view_pixel(views) / picture.finer)
    return Origin(source, lookup, normals, label, detail=detail)


def _with_field(
    lookup: Lookup, source: Source, field: Callable[[np.ndarray], dict[str, np.ndarray]], names: list[str]
) -> Lookup:
    """Make a lookup that takes the named materials from a field, and the others from `lookup`."""

    def with_field(places: Places) -> dict[str, np.ndarray]:
        read = field(source.at(places.face_idx, places.barycentric, source.mesh.vertices))
        return {**lookup(places), **{name: read[name] for name in names}}

    return with_field


def _views_are_finer(views: Views, source: Source) -> bool:
    """Return whether the views' normals can hold more detail than the surface's vertices.

    They can where a pixel spans at most 1.5 times the surface's median edge.
    """
    return _view_pixel(views) <= 1.5 * _median_edge(source)


def _median_edge(source: Source) -> float:
    """Compute the median edge length of the source's triangles."""
    corners = source.mesh.vertices[source.mesh.faces]
    return float(np.median(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1)))


def _view_pixel(views: Views) -> float:
    """Compute the width of a view's pixel in the middle of its depth range."""
    camera = views.cameras[0]
    return float(pixel_footprint(camera, (camera.near + camera.far) / 2))


def texture_detail(scene: Scene) -> float | None:
    """Measure the width on the surface of a texel of the finest textures, in the scene's units.

    This is the median over the textured area; None where no face has a texture.
    """
    from gdtool.geometry.normals import face_normals

    area = face_normals(TriMesh(scene.vertices, scene.faces))[1]
    widths, weights = [], []
    for index in np.unique(scene.material_idx):
        material, faces = scene.materials[index], scene.material_idx == index
        textures = (
            material.base_color_texture,
            material.metallic_roughness_texture,
            material.normal_texture,
            material.emissive_texture,
        )
        used = [t for t in textures if t is not None and t.uv_set < len(scene.uvs) and scene.uvs[t.uv_set] is not None]
        if not used:
            continue
        density = np.zeros(int(faces.sum()))
        for texture in used:
            u, v = (
                scene.uvs[texture.uv_set][scene.faces[faces][:, k]]
                - scene.uvs[texture.uv_set][scene.faces[faces][:, 0]]
                for k in (1, 2)
            )
            height, width = texture.image.shape[:2]
            covered = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) * abs(texture.scale[0] * texture.scale[1])
            density = np.maximum(density, covered * height * width)
        valid = (density > 0) & (area[faces] > 0)
        widths.append(np.sqrt(area[faces][valid] / density[valid]))
        weights.append(area[faces][valid])
    if not widths or not sum(map(len, widths)):
        return None
    spans, weight = np.concatenate(widths), np.concatenate(weights)
    order = np.argsort(spans)
    return float(spans[order][np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2)])


def from_scene(
    scene: Scene, source_from_world: np.ndarray, footprint: Callable[[float], float] = lambda detail: 0.0
) -> Origin:
    """Prepare a textured model, given in its file's frame; source_from_world (4, 4) maps the normalised frame to it.

    footprint: from the model's detail (see Origin), the width over which textures are averaged where they are read.
    Both are in the normalised frame.
    """
    from gdtool.shading.render.surface_points import SurfaceLookup

    matrix = invert_similarity(source_from_world)
    turn = matrix[:3, :3] / np.sqrt((matrix[:3, 0] ** 2).sum())
    turn, unturned = turn.astype(np.float32), bool(np.allclose(turn, np.eye(3), atol=1e-9))
    source = Source(TriMesh(transform_points(matrix, scene.vertices), scene.faces))
    normals = scene.normals @ turn.T if scene.normals is not None else vertex_normals(source.mesh)

    # Single precision is exact to 1/1000 of a texel of a 16384² texture, and takes half the time.
    points = SurfaceLookup(
        replace(
            scene,
            normals=None if scene.normals is None else scene.normals.astype(np.float32),
            uvs=tuple(None if uv is None else uv.astype(np.float32) for uv in scene.uvs),
        )
    )
    texel = texture_detail(scene)
    # With vertex colors, or factors only, the mesh limits the detail.
    detail = (
        0.5 * _median_edge(source) if texel is None else texel / float(np.sqrt((source_from_world[:3, 0] ** 2).sum()))
    )
    width = footprint(detail) * np.sqrt((source_from_world[:3, 0] ** 2).sum())

    def lookup(places: Places) -> dict[str, np.ndarray]:
        read = points.attributes(places.face_idx, places.barycentric, np.full(len(places.face_idx), width, np.float32))
        # einsum: for matrices this thin, BLAS keeps a second thread waiting busily.
        normal = read["normal"] if unturned else np.einsum("nk,ck->nc", read["normal"], turn)
        # Files whose winding and normals disagree are common: the winding decides which side is outside.
        inward = dot(normal, source.normals_of(places.face_idx)) < 0
        if inward.any():
            normal[inward] *= -1
        out = {name: read[name] for name in names}
        return {**out, "confidence": np.ones(len(normal), np.float32), "normal": normal}

    modes = {material.alpha_mode for material in scene.materials}
    mode = next((m for m in ("BLEND", "MASK") if m in modes), "OPAQUE")
    shines = any(max(material.emissive) > 0 for material in scene.materials)
    names = [
        "albedo",
        "roughness",
        "metallic",
        *(["alpha"] if mode != "OPAQUE" else []),
        *(["emissive"] if shines else []),
    ]
    cutoffs = [m.alpha_cutoff for m in scene.materials if m.alpha_mode == "MASK"]
    return Origin(
        source,
        lookup,
        normals,
        "model",
        mode,
        cutoffs[0] if cutoffs else 0.5,
        any(m.double_sided for m in scene.materials),
        detail,
    )
