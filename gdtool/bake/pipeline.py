"""Baking: what each texel of a mesh's map reads from the surface the mesh stands for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gdtool.bake.occlusion import ambient_visibility
from gdtool.bake.picture import Picture
from gdtool.bake.project_views import ViewVisibility, observe, silhouette_margin
from gdtool.bake.reproject import Places, Source, reproject
from gdtool.bake.supersample import supersample
from gdtool.bake.target import TEXELS_AT_ONCE, Target, Texels, surface_at
from gdtool.core.threads import mapped
from gdtool.geometry.tangents import dot, encode_tangent_space, unit

# Looks the material of places up: dict of albedo (n, 3) linear, roughness (n,), metallic (n,), normal (n, 3) unit in
# world axes, and alpha (n,) where the source has one.
Lookup = Callable[[Places], dict[str, np.ndarray]]


@dataclass(frozen=True)
class ViewsOfSource:
    """Views of the source and what their cameras see of it.

    images: domain (albedo linear, roughness, metallic, normal) to (k, h, w[, c]); mask (k, h, w); picture: what one of
    them was made of."""

    visibilities: list[ViewVisibility]
    images: dict[str, np.ndarray]
    mask: np.ndarray
    picture: Picture | None = None


@dataclass(frozen=True)
class Baked:
    """What the n texels read: values by name, float32; seen (n,) the views' confidence, None without views."""

    values: dict[str, np.ndarray]
    seen: np.ndarray | None
    report: dict[str, float] = field(default_factory=dict)


def vertex_lookup(source: Source, attributes: dict[str, np.ndarray], normals: np.ndarray) -> Lookup:
    """Lookup of attributes and unit normals (v, 3) per vertex of the source."""

    def lookup(places: Places) -> dict[str, np.ndarray]:
        out = {name: source.at(places.face_idx, places.barycentric, values) for name, values in attributes.items()}
        normal = source.at(places.face_idx, places.barycentric, normals)
        geometric = source.face_normals[places.face_idx]
        # A vertex normal that points to the other side of its own face is damaged.
        out["normal"] = unit(np.where(dot(normal, geometric)[:, None] > 0, normal, geometric))
        return out

    return lookup


def with_views(lookup: Lookup, source: Source, views: ViewsOfSource) -> tuple[Lookup, list[str]]:
    """A lookup that reads the views where they see a place well, blended by their confidence into the given lookup.

    Adds the entry "seen", the confidence (n,). Also returns the domains that come from views.
    """
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    domains = [d for d in ("albedo", "roughness", "metallic", "normal") if d in views.images]
    encoded = {}
    for domain in domains:
        image = views.images[domain]
        image = srgb_from_linear(image) if domain == "albedo" else image
        encoded[domain] = np.asarray(image if image.ndim == 4 else image[..., None], np.float32)
    stack = np.concatenate(list(encoded.values()), -1)
    channel = np.cumsum([0, *(image.shape[-1] for image in encoded.values())])
    pictured = None
    if views.picture is not None and "albedo" in domains:
        pictured = next(k for k, visibility in enumerate(views.visibilities) if visibility.camera.name == views.picture.camera.name)

    def looked(places: Places) -> dict[str, np.ndarray]:
        out = dict(lookup(places))
        points = source.at(places.face_idx, places.barycentric, source.vertices)
        prior = [srgb_from_linear(out[d]) if d == "albedo" else out[d] for d in domains]
        prior = np.concatenate([p if p.ndim == 2 else p[:, None] for p in prior], 1)
        value, seen, shares = observe(
            points, out["normal"], views.visibilities, stack, views.mask, prior, known=pictured, colors=channel[1]
        )
        for k, domain in enumerate(domains):
            own, read = prior[:, channel[k] : channel[k + 1]], value[:, channel[k] : channel[k + 1]]
            share = seen[:, None]
            if domain == "normal":
                read = unit(read)
                # A view's normal bends the surface's, it does not replace it: 60 degrees off is a mistake.
                share = share * np.clip((dot(read, own)[:, None] - 0.5) / 0.2, 0, 1)
            mixed = own + share * (read - own)
            if domain == "normal":
                mixed = unit(mixed)
            out[domain] = (
                linear_from_srgb(mixed) if domain == "albedo" else mixed if out[domain].ndim == 2 else mixed[:, 0]
            )
        if pictured is not None:
            _sharpen(out, points, views.picture, views.visibilities[pictured], seen * shares[pictured])
        out["seen"] = seen
        if "confidence" in out:
            out["confidence"] = seen + (1 - seen) * out["confidence"]
        return out

    return looked, domains


def _sharpen(out: dict[str, np.ndarray], points: np.ndarray, picture: Picture, visibility: ViewVisibility, share: np.ndarray) -> None:
    """Multiply what the picture has in finer pixels into the albedo of points (n, 3), by the share (n,) that its view
    has in it.

    What a metal shows is what it mirrors, and no detail of its own.
    """
    share = share * silhouette_margin(visibility, points) * (1 - out["metallic"])
    seen = np.flatnonzero(share > 0.01)
    out["albedo"] = np.array(out["albedo"], np.float32)
    out["albedo"][seen] = np.clip(out["albedo"][seen] * (1 + share[seen, None] * (picture.at(points[seen]) - 1)), 0, 1)


def _read(
    target: Target, source: Source, lookup: Lookup, reach: np.ndarray, face_idx: np.ndarray, barycentric: np.ndarray
) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, ...], Places]:
    """What lookup says of the places that stand for places on the target; what surface_at says; and the places."""
    frame = surface_at(target, face_idx, barycentric)
    places = reproject(frame[0], unit(frame[1]), reach[face_idx], source)
    read = lookup(places)
    if places.from_behind.any():
        read["normal"] = np.where(places.from_behind[:, None], -read["normal"], read["normal"])
    return read, frame, places


def bake(
    target: Target,
    texels: Texels,
    source: Source,
    lookup: Lookup,
    reach: np.ndarray,
    samples: int = 1,
    threads: int = 1,
    progress: Callable = lambda iterable, total, label: iterable,
    height: bool = False,
    confidence: bool = False,
) -> Baked:
    """Bake what lookup says of the source into the texels.

    reach (t,) from reproject.vertex_reach. samples per texel (a square number) are taken where neighbouring texels
    differ, one elsewhere (supersample.supersample). values has albedo, roughness, metallic, tangent_normal (n, 3) and
    whatever else lookup gives besides normal; where they are asked for height (n,), how far above the target, along its
    normal, the source lies, and the lookup's confidence (n,), 0 where the normal leads to nothing and the nearest point
    serves."""
    reach = reach.astype(np.float32)
    values: dict[str, np.ndarray] = {}
    by_ray = np.empty(len(texels), bool)

    def read(face_idx: np.ndarray, barycentric: np.ndarray) -> tuple[dict[str, np.ndarray], Places]:
        out, frame, places = _read(target, source, lookup, reach, face_idx, barycentric)
        out["tangent_normal"] = encode_tangent_space(*frame[1:], out.pop("normal"))
        if height:
            out["height"] = dot(
                source.at(places.face_idx, places.barycentric, source.vertices) - frame[0], unit(frame[1])
            )
        certain = out.pop("confidence", None)
        if confidence:
            out["confidence"] = np.where(places.by_ray, certain, 0)
        return out, places

    def run(part: slice) -> None:
        found, places = read(texels.face_idx[part], texels.barycentric[part])
        for name, value in found.items():
            # setdefault is atomic: threads that come first at the same time agree on one array.
            if name not in values:
                values.setdefault(name, np.empty((*value.shape[:0:-1], len(texels)), np.float32).T)
            values[name][part] = value
        by_ray[part] = places.by_ray

    parts = [slice(s, min(s + TEXELS_AT_ONCE, len(texels))) for s in range(0, len(texels), TEXELS_AT_ONCE)]
    for _ in progress(mapped(run, parts, threads), len(parts), "bake"):
        pass
    report = {"texels": texels.inside, "nearest_point_share": float(1 - by_ray[: texels.inside].mean())}
    if samples > 1:
        report["supersampled_share"] = supersample(target, texels, values, lambda *at: read(*at)[0], samples, threads)
    seen = values.pop("seen", None)
    return Baked(values, seen, report)


def occlusion_tracer(
    target: Target, source: Source, reach: np.ndarray, normals: np.ndarray, rays: int, seed: int, threads: int = 1
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """trace(face_idx, barycentric) -> ambient_visibility (n,) of the source at places on the target; normals (v, 3) of the
    source."""
    lift = 5e-4 * source.extent

    def trace(face_idx: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        def run(part: slice) -> np.ndarray:
            points, facing, _, _ = surface_at(target, face_idx[part], barycentric[part])
            places = reproject(points, unit(facing), reach[face_idx[part]], source)
            at = source.at(places.face_idx, places.barycentric, source.vertices)
            geometric = source.face_normals[places.face_idx] * np.where(places.from_behind, -1, 1)[:, None]
            smooth = source.at(places.face_idx, places.barycentric, normals)
            side = dot(smooth, geometric)[:, None]
            smooth = unit(np.where(np.abs(side) > 0.2, smooth * np.sign(side), geometric))
            return ambient_visibility(at + geometric * lift, smooth, source.caster, rays, seed + part.start, lift=0.0)

        parts = [slice(s, s + 8192) for s in range(0, len(face_idx), 8192)]
        traced = list(mapped(run, parts, threads))
        return np.concatenate(traced) if traced else np.zeros(0, np.float32)

    return trace
