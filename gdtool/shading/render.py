"""Images of a scene by Embree: exact buffers of its geometry and material, and lit color.

A pixel is a box: its value is the mean over samples spread evenly inside it. Every pixel of the object's projected
bounds gets BASE samples; those where coverage, normal or material changes get all that were asked for.

Transparency: MASK as glTF says; BLEND is seen where alpha >= 0.5 and not there below, since a buffer has one surface.
Faces are seen from both sides, whatever the material's doubleSided says.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.cameras import Camera, project, rays
from gdtool.geometry.rays import RayCaster
from gdtool.shading.environment import Environment
from gdtool.shading.surface_points import SurfaceLookup

BASE = 4
# Alpha-tested layers that a ray passes at most.
MAX_LAYERS = 32
# A pixel whose samples differ by more than this (standard deviation) gets all samples.
TOLERANCE = {"normal": 0.03, "albedo": 0.012, "roughness": 0.02, "metallic": 0.02}
DOMAINS = ("normal", "depth", "albedo", "roughness", "metallic")
# Samples that are held at once: bounds the memory.
BAND_SAMPLES = 1 << 20


def pixel_pattern(count: int) -> np.ndarray:
    """(count, 2) points in [0, 1)² of the R2 sequence (Roberts 2018): every prefix is spread evenly, sums to the centre."""
    ratio = 1.32471795724474602596
    out = (0.5 + np.arange(count)[:, None] * np.array([1 / ratio, 1 / ratio**2])) % 1.0
    # The base prefix is centred, so that a plane's average is its value at the pixel's centre.
    out[:BASE] += 0.5 - out[:BASE].mean(0)
    if count > BASE:
        out[BASE:] += (0.5 - out[BASE:].mean(0)) * 0.5
    return np.clip(out, 0, 1 - 1e-9)


@dataclass
class Points:
    """Seen points, one a sample: pixel (n,) flat index, which sample of the pixel (n,), position (n, 3), view (n, 3) unit
    toward the eye, depth (n,), and the attributes of SurfaceLookup. Samples from BASE on are those of refined pixels:
    there are more of them, so each needs less light."""

    pixel: np.ndarray
    sample: np.ndarray
    position: np.ndarray
    view: np.ndarray
    depth: np.ndarray
    values: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass
class Counts:
    """What a rendering did and did not need to do."""

    pixels: int = 0
    pixels_in_bounds: int = 0
    pixels_refined: int = 0
    samples: int = 0
    shadow_rays: int = 0
    shadow_rays_below_horizon: int = 0
    notes: dict[str, float] = field(default_factory=dict)


class Renderer:
    """A scene made ready for rendering: ray casters and material lookup."""

    def __init__(self, scene: Scene, threads: int | None = None):
        self.scene = scene
        self.lookup = SurfaceLookup(scene)
        self.caster = RayCaster(scene.vertices, scene.faces, threads)
        tested = self.lookup.alpha_faces()
        self.tested = tested if tested.any() else None
        self.solid_caster, self.tested_faces, self.tested_caster = self.caster, None, None
        if self.tested is not None:
            self.solid_caster = RayCaster(scene.vertices, scene.faces[~tested], threads)
            self.tested_faces = np.flatnonzero(tested)
            self.tested_caster = RayCaster(scene.vertices, scene.faces[tested], threads)
        used = scene.vertices[np.unique(scene.faces)]
        self.bounds = np.stack([used.min(0), used.max(0)])
        self.extent = float((self.bounds[1] - self.bounds[0]).max()) or 1.0
        self.counts = Counts()

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits that are there after the alpha test: face_idx (n,), distance (n,), barycentric (n, 3)."""
        hits = self.caster.first_hit(origins, directions)
        face_idx, distance, barycentric = hits.face_idx, hits.distance, hits.barycentric
        if self.tested is None:
            return face_idx, distance, barycentric
        active = np.flatnonzero(face_idx >= 0)
        step = 1e-6 * self.extent
        for layer in range(MAX_LAYERS):
            active = active[(face_idx[active] >= 0)]
            active = active[self.tested[face_idx[active]]]
            alpha, cutoff = self.lookup.alpha(face_idx[active], barycentric[active])
            active = active[alpha < cutoff]
            if not len(active):
                break
            passed = distance[active] + step * (layer + 1)
            further = self.caster.first_hit(origins[active] + directions[active] * passed[:, None], directions[active])
            face_idx[active], barycentric[active] = further.face_idx, further.barycentric
            distance[active] = further.distance + passed
        else:
            face_idx[active] = -1
        return face_idx, distance, barycentric

    def occluded(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(n,) bool: whether a surface that passes the alpha test lies along each ray."""
        out = self.solid_caster.occluded(origins, directions)
        if self.tested is None:
            return out
        active = np.flatnonzero(~out)
        origin = origins[active].astype(np.float64)
        for _ in range(MAX_LAYERS):
            hits = self.tested_caster.first_hit(origin, directions[active])
            found = hits.found
            active, origin = active[found], origin[found]
            if not len(active):
                break
            alpha, cutoff = self.lookup.alpha(self.tested_faces[hits.face_idx[found]], hits.barycentric[found])
            out[active[alpha >= cutoff]] = True
            through = alpha < cutoff
            active = active[through]
            origin = origin[through] + directions[active] * (hits.distance[found][through] + 1e-5 * self.extent)[:, None]
        return out

    def window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Rows and columns (top, bottom, left, right) of the object's projected bounds."""
        used = self.scene.vertices if len(self.scene.vertices) < 200_000 else _corners(self.bounds)
        pixels, depth = project(camera, used)
        if camera.projection == "perspective" and (depth <= 1e-6).any():
            return 0, camera.height, 0, camera.width
        low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int)
        return (max(low[1], 0), min(high[1], camera.height), max(low[0], 0), min(high[0], camera.width))

    def see(self, camera: Camera, pixel: np.ndarray, sample: np.ndarray, pattern: np.ndarray) -> Points:
        """Points that samples at pixel (n,) + pattern[sample] see; the pattern's length sets the texture footprint."""
        position = np.stack([pixel % camera.width, pixel // camera.width], 1) + pattern[sample]
        origins, directions = rays(camera, position)
        along = -(directions @ camera.backward)
        if camera.projection == "orthographic":
            # Start in front of the object, not at a plane that may cut it.
            back = max(0.0, float((_corners(self.bounds) @ camera.backward).max()) - float(camera.position @ camera.backward)) + 1e-3 * self.extent
            origins = origins + camera.backward * back
        else:
            back = 0.0
        face_idx, distance, barycentric = self.trace(origins, directions)
        hit = np.flatnonzero(face_idx >= 0)
        face_idx, barycentric, directions = face_idx[hit], barycentric[hit], directions[hit]
        distance = distance[hit]
        depth = distance * along[hit] - back
        width = camera.pixel_size if camera.projection == "orthographic" else depth / camera.fx
        footprint = width / np.sqrt(len(pattern)) * np.ones(len(hit))
        values = self.lookup.attributes(face_idx, barycentric, footprint, directions)
        self.counts.samples += len(pixel)
        return Points(pixel[hit], sample[hit], origins[hit] + directions * distance[:, None], -directions, depth, values)

    def buffers(self, camera: Camera, samples: int = 16, shade=None) -> dict[str, np.ndarray]:
        """Domain images (h, w[, c]) float32 and "mask": see render_buffers. shade(points) -> {"color": (n, 3)} adds an
        image."""
        height, width = camera.height, camera.width
        top, bottom, left, right = self.window(camera)
        self.counts.pixels += height * width
        self.counts.pixels_in_bounds += max(bottom - top, 0) * max(right - left, 0)
        total = _Sums(height * width)
        rows = max(1, BAND_SAMPLES // max(1, (right - left) * BASE))
        for start in range(top, bottom, rows):
            stop = min(start + rows, bottom)
            pixel = (np.arange(start, stop)[:, None] * width + np.arange(left, right)[None]).ravel()
            self._band(camera, pixel, samples, total, shade)
        return total.images(camera, () if shade is None else ("color",))

    def _band(self, camera: Camera, pixel: np.ndarray, samples: int, total: _Sums, shade) -> None:
        base = min(BASE, samples)
        pattern = pixel_pattern(samples)
        asked = np.repeat(pixel, base)
        points = self.see(camera, asked, np.tile(np.arange(base), len(pixel)), pattern[:base])
        total.add(points, asked, shade)
        if samples <= base or not len(points):
            return
        chosen = total.uneven(pixel, camera.width, camera.height)
        self.counts.pixels_refined += len(chosen)
        more = samples - base
        for start in range(0, len(chosen), max(1, BAND_SAMPLES // more)):
            part = chosen[start:start + max(1, BAND_SAMPLES // more)]
            again = np.repeat(part, more)
            total.add(self.see(camera, again, np.tile(np.arange(base, samples), len(part)), pattern), again, shade)


class _Sums:
    """Sums over samples, a row a pixel."""

    def __init__(self, pixels: int):
        self.pixels = pixels
        self.asked, self.seen = np.zeros(pixels), np.zeros(pixels)
        self.sums: dict[str, np.ndarray] = {}
        self.squares: dict[str, np.ndarray] = {}

    def add(self, points: Points, asked: np.ndarray, shade) -> None:
        self.asked += np.bincount(asked, minlength=self.pixels)
        if not len(points):
            return
        values = {k: points.values[k] for k in ("normal", "albedo", "roughness", "metallic")}
        values["depth"] = points.depth
        if shade is not None:
            values |= shade(points)
        self.seen += np.bincount(points.pixel, minlength=self.pixels)
        for name, value in values.items():
            value = value.reshape(len(points), -1)
            if name not in self.sums:
                self.sums[name] = np.zeros((self.pixels, value.shape[1]))
                self.squares[name] = np.zeros(self.pixels)
            for c in range(value.shape[1]):
                self.sums[name][:, c] += np.bincount(points.pixel, value[:, c], self.pixels)
            if name in TOLERANCE:
                self.squares[name] += np.bincount(points.pixel, np.einsum("ij,ij->i", value, value, dtype=np.float64), self.pixels)

    def uneven(self, pixel: np.ndarray, width: int, height: int) -> np.ndarray:
        """Of the pixels given, those partly covered, beside covered ones, or whose samples differ."""
        partly = (self.seen > 0) & (self.seen < self.asked)
        covered = np.pad((self.seen > 0).reshape(height, width), 1)
        around = np.zeros((height, width), bool)
        for dy in range(3):
            for dx in range(3):
                around |= covered[dy:dy + height, dx:dx + width]
        chosen = partly | ((self.seen == 0) & around.ravel())
        count = np.maximum(self.seen, 1)
        for name, limit in TOLERANCE.items():
            if name in self.sums:
                mean = self.sums[name] / count[:, None]
                variance = self.squares[name] / count - np.einsum("ij,ij->i", mean, mean)
                chosen |= (variance > limit**2) & (self.seen > 0)
        return pixel[chosen[pixel]]

    def images(self, camera: Camera, more: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
        shape = (camera.height, camera.width)
        out = {"mask": (self.seen / np.maximum(self.asked, 1)).reshape(shape).astype(np.float32)}
        count = np.maximum(self.seen, 1)[:, None]
        for name in (*DOMAINS, *more):
            if name not in self.sums:
                self.sums[name] = np.zeros((self.pixels, 3 if name in ("normal", "albedo", "color") else 1))
        for name, value in self.sums.items():
            mean = value / count
            if name == "normal":
                length = np.linalg.norm(mean, axis=1, keepdims=True)
                mean = np.where(length > 1e-6, mean / np.maximum(length, 1e-6), 0)
            image = mean.reshape(*shape, -1).astype(np.float32)
            out[name] = image if image.shape[2] == 3 else image[..., 0]
        return out


def _corners(bounds: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a box (2, 3)."""
    return np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3)


def render_buffers(scene: Scene, camera: Camera, samples: int = 16) -> dict[str, np.ndarray]:
    """Exact buffers of a scene: normal (h, w, 3) shading normals in world axes, depth (h, w), albedo (h, w, 3) linear,
    roughness, metallic (h, w), mask (h, w) coverage. Averages over the covered part; 0 where nothing is seen."""
    return Renderer(scene).buffers(camera, samples)


def render_color(scene: Scene, camera: Camera, environment: Environment, samples: int = 16, light_samples: int = 16,
                 seed: int = 0, brdf: str = "gltf") -> tuple[np.ndarray, np.ndarray]:
    """Lit color (h, w, 3) linear radiance, direct light with shadows, and mask (h, w)."""
    from gdtool.shading.direct import DirectLight

    renderer = Renderer(scene)
    light = DirectLight(renderer, environment, light_samples, seed, brdf)
    images = renderer.buffers(camera, samples, light.color())
    return images["color"], images["mask"]


def closed_form_image(frame: dict[str, np.ndarray], camera: Camera, lobes, brdf: str = "gltf") -> np.ndarray:
    """(h, w, 3) unshadowed linear radiance of a view's own maps under spherical Gaussians; 0 where nothing is seen."""
    import torch

    from gdtool.shading.closed_form import shade

    inside = frame["mask"] > 0
    view = -rays(camera)[1][inside]
    maps = [torch.tensor(x, dtype=torch.float32) for x in (frame["normal"][inside], view, frame["albedo"][inside],
                                                           frame["roughness"][inside], frame["metallic"][inside])]
    out = np.zeros((*inside.shape, 3), np.float32)
    with torch.no_grad():
        out[inside] = shade(*maps, lobes.to(torch.float32), brdf).numpy()
    return out
