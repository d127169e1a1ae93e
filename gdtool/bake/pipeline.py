"""Bake the values of all texels of a mesh: look each texel up on the source surface, and average where it varies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gdtool.bake.occlusion import ambient_visibility
from gdtool.bake.picture import Picture
from gdtool.bake.project_views import ViewStack, ViewVisibility, observe, silhouette_margin
from gdtool.bake.reproject import Places, Source, reproject
from gdtool.bake.supersample import supersample
from gdtool.bake.target import TEXELS_AT_ONCE, Target, Texels, surface_at
from gdtool.core.threads import mapped
from gdtool.geometry.tangents import dot, encode_tangent_space, unit

# A function that looks up the material at n places: albedo (n, 3) linear, roughness (n,), metallic (n,), normal (n, 3)
# unit in world axes, and alpha (n,) where the source has one.
Lookup = Callable[[Places], dict[str, np.ndarray]]


@dataclass(frozen=True)
class ViewsOfSource:
    """Views of the source: their images, and the depths and silhouettes that their cameras see.

    images: (k, h, w[, c]) by domain: albedo linear, roughness, metallic, normal. mask (k, h, w): coverage. picture: the
    one of higher resolution that one of the views was made from.
    """

    visibilities: list[ViewVisibility]
    images: dict[str, np.ndarray]
    mask: np.ndarray
    picture: Picture | None = None


@dataclass(frozen=True)
class Baked:
    """The baked values of n texels: float32 arrays (n,) or (n, c) by name.

    seen (n,): the confidence in [0, 1] that views see the texel, None without views. report: figures for the manifest.
    """

    values: dict[str, np.ndarray]
    seen: np.ndarray | None
    report: dict[str, float] = field(default_factory=dict)

    def seen_share(self, inside: int) -> float:
        """Compute the share of the first `inside` texels that views see with a confidence above one half."""
        return 0.0 if self.seen is None else float((self.seen[:inside] > 0.5).mean())


@dataclass(frozen=True)
class BakeOptions:
    """Options of a bake.

    samples: per texel where neighbouring texels differ, a square number. height: whether to store how far the source
    lies above the target along the target's normal. confidence: whether to store the lookup's confidence.
    """

    samples: int = 1
    threads: int = 1
    height: bool = False
    confidence: bool = False


def vertex_lookup(source: Source, attributes: dict[str, np.ndarray], normals: np.ndarray) -> Lookup:
    """Make a lookup that interpolates attributes and unit normals (v, 3) of the source's vertices."""

    def lookup(places: Places) -> dict[str, np.ndarray]:
        out = {name: source.at(places.face_idx, places.barycentric, values) for name, values in attributes.items()}
        normal = source.at(places.face_idx, places.barycentric, normals)
        geometric = source.face_normals[places.face_idx]
        # A vertex normal that points to the other side of its face is damaged.
        out["normal"] = unit(np.where(dot(normal, geometric)[:, None] > 0, normal, geometric))
        return out

    return lookup


def with_views(lookup: Lookup, source: Source, views: ViewsOfSource) -> tuple[Lookup, list[str]]:
    """Make a lookup that blends what views show into the values of another lookup, by the views' confidence.

    It adds the value "seen" (n,), that confidence. Also returns the names of the values that come from views.
    """
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    domains: list[str] = [d for d in ("albedo", "roughness", "metallic", "normal") if d in views.images]
    encoded = {}
    for domain in domains:
        image = views.images[domain]
        image = srgb_from_linear(image) if domain == "albedo" else image
        encoded[domain] = np.asarray(image if image.ndim == 4 else image[..., None], np.float32)
    stack = np.concatenate(list(encoded.values()), -1)
    channel = np.cumsum([0, *(image.shape[-1] for image in encoded.values())])
    pictured = None
    if views.picture is not None and "albedo" in domains:
        pictured = next(
            k for k, visibility in enumerate(views.visibilities) if visibility.camera.name == views.picture.camera.name
        )

    images = ViewStack(views.visibilities, stack, views.mask, pictured, channel[1])

    def blended(places: Places) -> dict[str, np.ndarray]:
        out = dict(lookup(places))
        points = source.at(places.face_idx, places.barycentric, source.mesh.vertices)
        prior = [srgb_from_linear(out[d]) if d == "albedo" else out[d] for d in domains]
        prior = np.concatenate([p if p.ndim == 2 else p[:, None] for p in prior], 1)
        value, seen, shares = observe(points, out["normal"], images, prior)
        for k, domain in enumerate(domains):
            base, read = prior[:, channel[k] : channel[k + 1]], value[:, channel[k] : channel[k + 1]]
            share = seen[:, None]
            if domain == "normal":
                read = unit(read)
                # A view's normal refines the surface's: one that is 60 degrees off is taken for a mistake.
                share = share * np.clip((dot(read, base)[:, None] - 0.5) / 0.2, 0, 1)
            mixed = base + share * (read - base)
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

    return blended, domains


def _sharpen(
    out: dict[str, np.ndarray], points: np.ndarray, picture: Picture, visibility: ViewVisibility, share: np.ndarray
) -> None:
    """Multiply the picture's fine detail into the albedo of points (n, 3).

    visibility: of the view that the picture belongs to; share (n,) in [0, 1]: that view's share in the albedo, which
    scales the detail. Metals are left out: the picture shows a reflection there, not detail of the material.
    """
    share = share * silhouette_margin(visibility, points) * (1 - out["metallic"])
    seen = np.flatnonzero(share > 0.01)
    out["albedo"] = np.array(out["albedo"], np.float32)
    out["albedo"][seen] = np.clip(out["albedo"][seen] * (1 + share[seen, None] * (picture.at(points[seen]) - 1)), 0, 1)


def _read(
    target: Target, source: Source, lookup: Lookup, reach: np.ndarray, face_idx: np.ndarray, barycentric: np.ndarray
) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, ...], Places]:
    """Look up the source at points of the target.

    Returns the lookup's values, the target's positions and frames (target.surface_at), and the points' places on the
    source.
    """
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
    options: BakeOptions = BakeOptions(),
    progress: Callable = lambda iterable, total, label: iterable,
) -> Baked:
    """Bake the values that `lookup` reads from the source into the texels.

    reach (t,): how far from each triangle to look for the source (reproject.cage_offsets). progress(iterable, total,
    label) reports the parts done.

    The values are albedo, roughness, metallic, tangent_normal (n, 3), and everything else that lookup returns, except
    normal. Options add height (n,) and confidence (n,). The confidence is 0 where no ray along the normal meets the
    source, so that the nearest point was read instead. Where neighbouring texels differ, values are means over several
    samples (supersample.supersample).
    """
    reach = reach.astype(np.float32)
    values: dict[str, np.ndarray] = {}
    by_ray = np.empty(len(texels), bool)

    def read(face_idx: np.ndarray, barycentric: np.ndarray) -> tuple[dict[str, np.ndarray], Places]:
        out, frame, places = _read(target, source, lookup, reach, face_idx, barycentric)
        out["tangent_normal"] = encode_tangent_space(*frame[1:], out.pop("normal"))
        if options.height:
            out["height"] = dot(
                source.at(places.face_idx, places.barycentric, source.mesh.vertices) - frame[0], unit(frame[1])
            )
        certain = out.pop("confidence", None)
        if options.confidence:
            out["confidence"] = np.where(places.by_ray, certain, 0)
        return out, places

    def run(part: slice) -> None:
        values_here, places = read(texels.face_idx[part], texels.barycentric[part])
        for name, value in values_here.items():
            # setdefault is atomic: threads that get here at the same time agree on one array.
            if name not in values:
                values.setdefault(name, np.empty((*value.shape[:0:-1], len(texels)), np.float32).T)
            values[name][part] = value
        by_ray[part] = places.by_ray

    parts = [slice(s, min(s + TEXELS_AT_ONCE, len(texels))) for s in range(0, len(texels), TEXELS_AT_ONCE)]
    for _ in progress(mapped(run, parts, options.threads), len(parts), "bake"):
        pass
    report = {"texels": texels.inside, "nearest_point_share": float(1 - by_ray[: texels.inside].mean())}
    if options.samples > 1:
        report["supersampled_share"] = supersample(
            target, texels, values, lambda *at: read(*at)[0], options.samples, options.threads
        )
    seen = values.pop("seen", None)
    return Baked(values, seen, report)


def occlusion_tracer(
    target: Target, source: Source, reach: np.ndarray, normals: np.ndarray, rays: int, seed: int, threads: int = 1
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Make the function trace(face_idx, barycentric) -> (n,): ambient visibility of the source at points of the target.

    reach (t,): see bake(). normals (v, 3): the source's vertex normals. rays: their number per point.
    """
    lift = 5e-4 * source.extent

    def trace(face_idx: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
        def run(part: slice) -> np.ndarray:
            points, facing, _, _ = surface_at(target, face_idx[part], barycentric[part])
            places = reproject(points, unit(facing), reach[face_idx[part]], source)
            at = source.at(places.face_idx, places.barycentric, source.mesh.vertices)
            geometric = source.face_normals[places.face_idx] * np.where(places.from_behind, -1, 1)[:, None]
            smooth = source.at(places.face_idx, places.barycentric, normals)
            side = dot(smooth, geometric)[:, None]
            smooth = unit(np.where(np.abs(side) > 0.2, smooth * np.sign(side), geometric))
            return ambient_visibility(at + geometric * lift, smooth, source.caster, rays, seed + part.start, lift=0.0)

        parts = [slice(s, s + 8192) for s in range(0, len(face_idx), 8192)]
        traced = list(mapped(run, parts, threads))
        return np.concatenate(traced) if traced else np.zeros(0, np.float32)

    return trace
