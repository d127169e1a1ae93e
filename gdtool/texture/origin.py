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
    source = Source.of(surface.vertices, surface.faces)
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


def from_scene(scene: Scene, source_from_world: np.ndarray) -> Origin:
    """A model with its own textures, in its own frame; source_from_world (4, 4) takes the normalised frame there."""
    from gdtool.shading.surface_points import surface_attributes

    matrix = invert_similarity(source_from_world)
    turn = matrix[:3, :3] / np.sqrt((matrix[:3, 0] ** 2).sum())
    source = Source.of(transform_points(matrix, scene.vertices), scene.faces)
    normals = scene.normals @ turn.T if scene.normals is not None else vertex_normals(source.vertices, source.faces)

    def lookup(places: Places) -> dict[str, np.ndarray]:
        read = surface_attributes(scene, places.face_idx, places.barycentric)
        normal = np.asarray(read["normal"]) @ turn.T
        # Both sides of a face may be seen; a bake is for the outer one.
        flip = (normal * source.face_normals[places.face_idx]).sum(1) < 0
        normal[flip] *= -1
        out = {name: np.asarray(read[name]).reshape(len(normal), -1).squeeze(-1) if name != "albedo" else np.asarray(read[name])
               for name in ("albedo", "roughness", "metallic", "alpha")}
        out["normal"] = normal
        return out

    modes = {material.alpha_mode for material in scene.materials}
    mode = next((m for m in ("BLEND", "MASK") if m in modes), "OPAQUE")
    cutoffs = [m.alpha_cutoff for m in scene.materials if m.alpha_mode == "MASK"]
    return Origin(source, lookup, normals, "model", mode, cutoffs[0] if cutoffs else 0.5, any(m.double_sided for m in scene.materials))
