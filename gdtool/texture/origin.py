"""What a bake reads from: a surface with its views, or a model with its textures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.folders.surface import Surface
from gdtool.folders.views import Views
from gdtool.geometry.frames import invert_similarity, transform_points
from gdtool.geometry.normals import vertex_normals
from gdtool.texture.bake import Lookup, ViewsOfSource, vertex_lookup, with_views
from gdtool.texture.project_views import pixel_footprint, sight_of
from gdtool.texture.reproject import Places, Source
from gdtool.texture.tangents import dot


@dataclass(frozen=True)
class Origin:
    """A source in the normalised frame, its material lookup, its vertex normals (v, 3), and how its surface is drawn.

    label says where materials come from, for the report.
    """

    source: Source
    lookup: Lookup
    normals: np.ndarray
    label: str
    alpha_mode: str = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False


def material_field(path: Path, device: str = "cpu") -> Callable[[np.ndarray], dict[str, np.ndarray]]:
    """The material network of a surface's field.safetensors: points (n, 3) to albedo (n, 3), roughness (n,), metallic (n,).

    Raises InputError for a file that is damaged or holds another network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    from gdtool.core.errors import InputError
    from gdtool.fields.networks import MaterialNetwork
    from gdtool.fields.paper import network_materials

    network = MaterialNetwork()
    try:
        tensors = load_file(str(path))
        network.load_state_dict({name.removeprefix("material."): value for name, value in tensors.items() if name.startswith("material.")})
    except (SafetensorError, RuntimeError, OSError) as error:
        raise InputError(path, f"is not the material field that gdtool writes ({str(error).splitlines()[0]})", "run gdtool reconstruct again") from None
    network = network.to(device).eval()

    def at(points: np.ndarray) -> dict[str, np.ndarray]:
        out = network_materials(network, points, device)
        return {name: value if name == "albedo" else value[:, 0] for name, value in out.items()}

    return at


def from_surface(surface: Surface, views: Views | None, field: Callable[[np.ndarray], dict[str, np.ndarray]] | None = None) -> Origin:
    """A surface; views give material and normals where they see it well, its vertices elsewhere.

    field (material_field) takes the vertices' place for the materials that no view shows.
    """
    source = Source(surface.vertices, surface.faces)
    normals = surface.normals if surface.normals is not None else vertex_normals(surface.vertices, surface.faces)
    attributes = {"albedo": surface.albedo, "roughness": surface.roughness, "metallic": surface.metallic}
    lookup = vertex_lookup(source, attributes, normals.astype(np.float32))
    images = dict(views.images) if views is not None else {}
    label = "vertices"
    if field is not None:
        shown = [name for name in ("albedo", "roughness", "metallic") if name not in images]
        if shown:
            lookup, label = _with_field(lookup, source, field, shown), "field: " + " ".join(shown)
    if "normal" in images and not _views_are_finer(views, source):
        del images["normal"]
    if not images:
        return Origin(source, lookup, normals, label)
    sights = [sight_of(camera, source.caster, mask) for camera, mask in zip(views.cameras, views.mask, strict=True)]
    lookup, domains = with_views(lookup, source, ViewsOfSource(sights, images, views.mask))
    label = ("" if label == "vertices" else label + ", ") + "views: " + " ".join(domains)
    return Origin(source, lookup, normals, label)


def _with_field(lookup: Lookup, source: Source, field: Callable[[np.ndarray], dict[str, np.ndarray]], names: list[str]) -> Lookup:
    def looked(places: Places) -> dict[str, np.ndarray]:
        read = field(source.at(places.face_idx, places.barycentric, source.vertices))
        return {**lookup(places), **{name: read[name] for name in names}}

    return looked


def _views_are_finer(views: Views, source: Source) -> bool:
    """Whether a view's pixel is no larger than the surface's typical edge, so that its normals can hold more detail."""
    corners = source.vertices[source.faces]
    edge = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1)))
    depth = (views.cameras[0].near + views.cameras[0].far) / 2
    return float(pixel_footprint(views.cameras[0], depth)) <= 1.5 * edge


def from_scene(scene: Scene, source_from_world: np.ndarray, texel_width: float = 0.0) -> Origin:
    """A model with its own textures, in its own frame; source_from_world (4, 4) takes the normalised frame there.

    texel_width is what a texel of the baked maps spans, in the normalised frame: finer textures are averaged over it.
    """
    from gdtool.shading.surface_points import SurfaceLookup

    matrix = invert_similarity(source_from_world)
    turn = matrix[:3, :3] / np.sqrt((matrix[:3, 0] ** 2).sum())
    turn, unturned = turn.astype(np.float32), bool(np.allclose(turn, np.eye(3), atol=1e-9))
    source = Source(transform_points(matrix, scene.vertices), scene.faces)
    normals = scene.normals @ turn.T if scene.normals is not None else vertex_normals(source.vertices, source.faces)

    points = SurfaceLookup(scene)
    width = texel_width * np.sqrt((source_from_world[:3, 0] ** 2).sum())

    def lookup(places: Places) -> dict[str, np.ndarray]:
        read = points.attributes(places.face_idx, places.barycentric.astype(np.float64), np.full(len(places.face_idx), width))
        # einsum: a product of so thin matrices by BLAS keeps a second thread busy with waiting.
        normal = read["normal"] if unturned else np.einsum("nk,ck->nc", read["normal"], turn)
        # Files whose winding and normals disagree are common; the winding says which side is outside.
        inward = dot(normal, source.face_normals_32[places.face_idx]) < 0
        if inward.any():
            normal[inward] *= -1
        return {"albedo": read["albedo"], "roughness": read["roughness"], "metallic": read["metallic"], "alpha": read["alpha"], "normal": normal}

    modes = {material.alpha_mode for material in scene.materials}
    mode = next((m for m in ("BLEND", "MASK") if m in modes), "OPAQUE")
    cutoffs = [m.alpha_cutoff for m in scene.materials if m.alpha_mode == "MASK"]
    return Origin(source, lookup, normals, "model", mode, cutoffs[0] if cutoffs else 0.5, any(m.double_sided for m in scene.materials))
