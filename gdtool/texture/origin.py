"""What a bake reads from: a surface with its views, or a model with its textures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.folders.surface import Surface
from gdtool.folders.views import Views
from gdtool.geometry.frames import invert_similarity, transform_points
from gdtool.geometry.normals import vertex_normals
from gdtool.texture.bake import Lookup, ViewsOfSource, vertex_lookup, with_views
from gdtool.texture.project_views import pixel_footprint, sight_of
from gdtool.texture.reproject import Places, Source


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


def from_surface(surface: Surface, views: Views | None) -> Origin:
    """A surface; views give material and normals where they see it well, its vertices elsewhere."""
    source = Source(surface.vertices, surface.faces)
    normals = surface.normals if surface.normals is not None else vertex_normals(surface.vertices, surface.faces)
    attributes = {"albedo": surface.albedo, "roughness": surface.roughness, "metallic": surface.metallic}
    lookup = vertex_lookup(source, attributes, normals.astype(np.float32))
    if views is None:
        return Origin(source, lookup, normals, "vertices")
    images = dict(views.images)
    if "normal" in images and not _views_are_finer(views, source):
        del images["normal"]
    if not images:
        return Origin(source, lookup, normals, "vertices")
    sights = [sight_of(camera, source.caster, mask) for camera, mask in zip(views.cameras, views.mask, strict=True)]
    lookup, domains = with_views(lookup, source, ViewsOfSource(sights, images, views.mask))
    return Origin(source, lookup, normals, "views: " + " ".join(domains))


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
    source = Source(transform_points(matrix, scene.vertices), scene.faces)
    normals = scene.normals @ turn.T if scene.normals is not None else vertex_normals(source.vertices, source.faces)

    points = SurfaceLookup(scene)
    width = texel_width * np.sqrt((source_from_world[:3, 0] ** 2).sum())

    def lookup(places: Places) -> dict[str, np.ndarray]:
        read = points.attributes(places.face_idx, places.barycentric.astype(np.float64), np.full(len(places.face_idx), width))
        normal = read["normal"] @ turn.T
        # Files whose winding and normals disagree are common; the winding says which side is outside.
        normal[(normal * source.face_normals[places.face_idx]).sum(1) < 0] *= -1
        return {"albedo": read["albedo"], "roughness": read["roughness"], "metallic": read["metallic"], "alpha": read["alpha"], "normal": normal}

    modes = {material.alpha_mode for material in scene.materials}
    mode = next((m for m in ("BLEND", "MASK") if m in modes), "OPAQUE")
    cutoffs = [m.alpha_cutoff for m in scene.materials if m.alpha_mode == "MASK"]
    return Origin(source, lookup, normals, "model", mode, cutoffs[0] if cutoffs else 0.5, any(m.double_sided for m in scene.materials))
