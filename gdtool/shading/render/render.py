"""Images of a scene by Embree: exact buffers of its geometry and material, and lit color.

A pixel is a box: its value is the mean over samples spread evenly inside it. Every pixel of the object's projected
bounds gets BASE samples; their number is doubled as long as coverage, or a mean that is not yet known to TOLERANCE,
asks for more, up to the number that is allowed.

Transparency: MASK as glTF says; BLEND is seen where alpha >= 0.5 and not there below, since a buffer has one surface.
Faces are seen from both sides, whatever the material's doubleSided says.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from gdtool.assets.scene import Scene
from gdtool.cameras import Camera, project, rays
from gdtool.geometry.rays import RayCaster, is_convex
from gdtool.geometry.vectors import dot
from gdtool.images.color import srgb_from_linear
from gdtool.shading.render.pattern import pixel_pattern
from gdtool.shading.render.surface_points import SurfaceLookup

BASE = 4
# Samples up to which pixels beside the object's outline, or beside an uneven pixel, get more whatever their own say:
# what makes the other one uneven may reach in between theirs.
EDGE = 8
# Alpha-tested layers that a ray passes at most.
MAX_LAYERS = 32
# Error of a pixel's mean as a picture stores it (sRGB, (n + 1) / 2) above which it gets more samples: of buffers, and
# of color, whose noise costs more to take away.
TOLERANCE = {"normal": 0.009, "albedo": 0.009, "roughness": 0.009, "metallic": 0.009, "color": 0.018}
# What values are multiplied by for a picture; None: the sRGB curve.
STORED = {"normal": 0.5, "albedo": None, "roughness": 1.0, "metallic": 1.0, "color": None}
# Samples spread evenly know a mean better than random ones do, the more of them the better: measured, the error of n is
# SPREAD n^SPREAD_POWER times the standard error (0.47 for 4, 0.25 for 64; tests/shading/test_pattern.py).
SPREAD, SPREAD_POWER = 0.65, -0.2
# Directions to the light are spread over a pixel's samples less evenly.
COLOR_SPREAD = 0.8
DOMAINS = ("normal", "depth", "albedo", "roughness", "metallic")
# Samples that a thread works on at once: with four such bands a thread waiting, what is held at once.
BAND_SAMPLES = 1 << 16


@dataclass(frozen=True)
class Goal:
    """When to stop before all samples are taken: after seconds, or when the color's error, estimated from what the last
    samples changed, is psnr dB (of 1, sRGB, over the covered pixels)."""

    seconds: float | None = None
    psnr: float | None = None


@dataclass
class Points:
    """Seen points, one a sample: pixel (n,) flat index, which sample of the pixel (n,), position (n, 3), view (n, 3)
    unit toward the eye, depth (n,), and the attributes of SurfaceLookup. The samples of a pixel follow each other;
    together is how many a pixel that is seen in full has once these are added."""

    pixel: np.ndarray
    sample: np.ndarray
    position: np.ndarray
    view: np.ndarray
    depth: np.ndarray
    values: dict[str, np.ndarray]
    together: int = 1

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
    shadow_rays_convex: int = 0
    shadow_rays_rare: int = 0
    estimated_psnr: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def spend(self, what: str, since: float, **more: int) -> None:
        """Add the seconds since a time of time.perf_counter, and to other counts by name; threads may call at once."""
        with self.lock:
            self.seconds[what] = self.seconds.get(what, 0.0) + time.perf_counter() - since
            for name, count in more.items():
                setattr(self, name, getattr(self, name) + count)


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
        self.convex = self.tested is None and is_convex(scene.vertices, scene.faces)
        self.counts = Counts()
        self.pool = ThreadPoolExecutor(self.caster.threads)

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
            origin = (
                origin[through] + directions[active] * (hits.distance[found][through] + 1e-5 * self.extent)[:, None]
            )
        return out

    def may_be_hidden(self, position: np.ndarray, geometric_normal: np.ndarray) -> np.ndarray | None:
        """(n,) bool: whether anything can lie in front of points, or None where all may; no point on the outside of a
        convex scene is hidden from any direction above its horizon."""
        if not self.convex:
            return None
        return ((position - self.bounds.mean(0)) * geometric_normal).sum(1) <= 0

    def window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Rows and columns (top, bottom, left, right) of the object's projected bounds."""
        used = self.scene.vertices if len(self.scene.vertices) < 200_000 else _corners(self.bounds)
        pixels, depth = project(camera, used)
        if camera.projection == "perspective" and (depth <= 1e-6).any():
            return 0, camera.height, 0, camera.width
        low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int)
        return (max(low[1], 0), min(high[1], camera.height), max(low[0], 0), min(high[0], camera.width))

    def see(self, camera: Camera, pixel: np.ndarray, pattern: np.ndarray, first: int, emission: bool = True) -> Points:
        """Points that pixels (m,) see at the places pattern[first:], of which a pixel has as many as pattern (k, 2) has
        rows."""
        sample = np.arange(first, len(pattern))
        x, y = (
            (start[:, None] + offset).ravel()
            for start, offset in zip((pixel % camera.width, pixel // camera.width), pattern[first:].T, strict=True)
        )
        pixel, sample = np.repeat(pixel, len(sample)), np.tile(sample, len(pixel))
        origins, directions = rays(camera, np.stack([x, y]).T)
        along = -dot(directions.T, camera.backward)
        if camera.projection == "orthographic":
            # Start in front of the object, not at a plane that may cut it.
            back = (
                max(
                    0.0,
                    float((_corners(self.bounds) @ camera.backward).max()) - float(camera.position @ camera.backward),
                )
                + 1e-3 * self.extent
            )
            origins += camera.backward * back
        else:
            back = 0.0
        at = time.perf_counter()
        face_idx, distance, barycentric = self.trace(origins, directions)
        self.counts.spend("rays", at, samples=len(pixel))
        hit = np.flatnonzero(face_idx >= 0)
        if len(hit) < len(pixel):
            pixel, sample, face_idx, distance, along = (x.take(hit) for x in (pixel, sample, face_idx, distance, along))
            origins, directions, barycentric = (x.T.take(hit, axis=1).T for x in (origins, directions, barycentric))
        depth = distance * along
        depth -= back
        width = camera.pixel_size if camera.projection == "orthographic" else depth / camera.fx
        values = self.lookup.attributes(face_idx, barycentric, width / np.sqrt(len(pattern)), directions, emission)
        position = directions * distance[:, None]
        position += origins
        return Points(pixel, sample, position, -directions, depth, values, len(pattern))

    def each(self, work: Callable[[Camera], dict], cameras: Iterable[Camera]) -> Iterator[dict]:
        """work(camera) of each, in order, two at once: while the sums of one are looked through, the other one's rays
        are traced."""
        with ThreadPoolExecutor(min(2, self.caster.threads)) as pool:
            yield from pool.map(work, cameras)

    def buffers(self, camera: Camera, samples: int = 16, shade=None, goal: Goal = Goal()) -> dict[str, np.ndarray]:
        """Domain images (h, w[, c]) float32 and "mask": see render_buffers. shade(points) -> {"color": (n, 3)} adds an
        image. samples: the most that a pixel gets."""
        begun = time.perf_counter()
        height, width = camera.height, camera.width
        top, bottom, left, right = self.window(camera)
        self.counts.spend(
            "bounds", begun, pixels=height * width, pixels_in_bounds=max(bottom - top, 0) * max(right - left, 0)
        )
        total, pattern = _Sums(height * width), pixel_pattern(samples, BASE)
        pixel = (np.arange(top, bottom)[:, None] * width + np.arange(left, right)[None]).ravel()
        done, taken = 0, 0
        tolerance = {
            name: limit if goal.psnr is None else min(limit, 0.5 * 10 ** (-goal.psnr / 20))
            for name, limit in TOLERANCE.items()
        }
        while len(pixel) and done < samples:
            count = min(max(2 * done, BASE), samples)
            more = count - done
            # Several bands are as many for one thread as for the other, or one waits; a small picture is one band.
            bands = -(-len(pixel) * more // BAND_SAMPLES)
            step = -(-len(pixel) // (bands if bands == 1 else -(-bands // self.caster.threads) * self.caster.threads))

            def look(part: np.ndarray, first: int = done, count: int = count) -> tuple[np.ndarray, int, Points, dict]:
                at = time.perf_counter()
                points = self.see(camera, part, pattern[:count], first, shade is not None)
                shaded = shade(points) if shade is not None and len(points) else {}
                self.counts.spend("samples", at, pixels_refined=len(part) if first == BASE else 0)
                return part, count - first, points, shaded

            waiting: deque = deque()
            for start in range(0, len(pixel), step):
                waiting.append(self.pool.submit(look, pixel[start : start + step]))
                if len(waiting) > 4 * self.caster.threads:
                    total.add(*waiting.popleft().result())
            for found in waiting:
                total.add(*found.result())
            taken += len(pixel) * more
            change = total.change()
            done = count
            if done >= samples or not total.seen.any():
                break
            if goal.psnr is not None and done > BASE and change is not None and change >= goal.psnr:
                break
            pixel, error = total.uneven(pixel, width, height, tolerance, done)
            if goal.seconds is not None:
                spent = time.perf_counter() - begun
                room = int((goal.seconds - spent) / spent * taken / done) if goal.seconds > spent else 0
                if room < len(pixel):
                    pixel = np.sort(pixel[np.argsort(-error, kind="stable")[:room]])
        self.counts.estimated_psnr = total.change()
        return total.images(camera, () if shade is None else ("color",))


class _Sums:
    """Sums over samples, a row a pixel."""

    def __init__(self, pixels: int):
        self.pixels = pixels
        self.asked, self.seen = np.zeros(pixels), np.zeros(pixels)
        self.sums: dict[str, np.ndarray] = {}
        self.squares: dict[str, np.ndarray] = {}
        self.before: np.ndarray | None = None

    def add(self, asked: np.ndarray, times: int, points: Points, shaded: dict[str, np.ndarray]) -> None:
        """What pixels (m,) saw with so many samples each."""
        self.asked[asked] += times
        if not len(points):
            return
        values = {k: points.values[k] for k in ("normal", "albedo", "roughness", "metallic")}
        values["depth"] = points.depth
        values |= shaded
        # The samples of a pixel follow each other.
        starts = np.flatnonzero(np.diff(points.pixel, prepend=-1))
        owner = points.pixel[starts]
        self.seen[owner] += np.diff(starts, append=len(points))
        for name, value in values.items():
            value = np.ascontiguousarray(np.atleast_2d(value.T), np.float64 if name == "depth" else np.float32)
            if name not in self.sums:
                self.sums[name] = np.zeros((self.pixels, len(value)))
                self.squares[name] = np.zeros((self.pixels, len(value)))
            self.sums[name][owner] += np.add.reduceat(value, starts, axis=1).T
            if name in STORED:
                self.squares[name][owner] += np.add.reduceat(value * value, starts, axis=1).T

    def error(self, name: str, pixel: np.ndarray) -> np.ndarray:
        """Squared error (n,) to expect of the means of pixels (n,), as a picture stores them, mean over the
        channels."""
        count = np.maximum(self.seen[pixel], 1)[:, None]
        mean = self.sums[name][pixel] / count
        variance = np.maximum(self.squares[name][pixel] / count - mean * mean, 0)
        slope = _srgb_slope(mean) if STORED[name] is None else STORED[name]
        spread = COLOR_SPREAD if name == "color" else SPREAD * count**SPREAD_POWER
        return (variance / count * (slope * spread) ** 2).mean(1)

    def change(self) -> float | None:
        """The color's error in dB as the last change of the means tells it: half of the samples against all of them."""
        if "color" not in self.sums:
            return None
        covered = np.flatnonzero(self.seen)
        mean = np.clip(self.sums["color"] / np.maximum(self.seen, 1)[:, None], 0, 1)
        out = None
        if self.before is not None and len(covered):
            moved = ((srgb_from_linear(mean[covered]) - srgb_from_linear(self.before[covered])) ** 2).mean(1)
            # A pixel that got nothing new is as good as its samples say.
            self.moved[covered] = np.where(self.asked[covered] > self.asked_before[covered], moved, self.moved[covered])
            out = float(-10 * np.log10(max(self.moved[covered].mean(), 1e-10)))
        elif len(covered):
            self.moved = np.zeros(self.pixels)
            self.moved[covered] = self.error("color", covered)
        self.before, self.asked_before = mean, self.asked.copy()
        return out

    def uneven(
        self, pixel: np.ndarray, width: int, height: int, tolerance: dict[str, float], done: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of the pixels given, those partly covered, those whose means are not known to their tolerance, and as long as
        few samples (done) may have missed something those at the outline and beside any of the others; and how badly
        each is known, squared, in units of the tolerance."""
        seen = self.seen[pixel]
        partly = (seen > 0) & (seen < self.asked[pixel])
        if done <= EDGE:
            covered = (self.seen > 0).reshape(height, width)
            whole = (self.seen == self.asked).reshape(height, width) & covered
            partly |= ((seen == 0) & _beside(covered)[pixel]) | ((seen > 0) & _beside(~whole)[pixel])
        worst = np.zeros(len(pixel))
        some = np.flatnonzero(seen > 0)
        for name in STORED:
            if name in self.sums:
                worst[some] = np.maximum(worst[some], self.error(name, pixel[some]) / tolerance[name] ** 2)
        chosen = partly | (worst > 1)
        if done <= EDGE:
            found = np.zeros(width * height, bool)
            found[pixel[chosen]] = True
            chosen |= (seen > 0) & _beside(found.reshape(height, width))[pixel]
        return pixel[chosen], np.where(partly, np.inf, worst)[chosen]

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


def _beside(inside: np.ndarray) -> np.ndarray:
    """(h * w,) bool: pixels that are inside (h, w), or have a neighbour of eight that is."""
    padded = np.pad(inside, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return (rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]).ravel()


def _srgb_slope(x: np.ndarray) -> np.ndarray:
    """Derivative of the sRGB curve; 0 beyond 1, where a picture is clipped."""
    inside = np.clip(x, 0.0031308, 1)
    return np.where(x > 1, 0.0, np.where(x <= 0.0031308, 12.92, 1.055 / 2.4 * inside ** (1 / 2.4 - 1)))


def _corners(bounds: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a box (2, 3)."""
    return np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3)


def render_buffers(scene: Scene, camera: Camera, samples: int = 16) -> dict[str, np.ndarray]:
    """Exact buffers of a scene: normal (h, w, 3) shading normals in world axes, depth (h, w), albedo (h, w, 3) linear,
    roughness, metallic (h, w), mask (h, w) coverage. Averages over the covered part; 0 where nothing is seen."""
    return Renderer(scene).buffers(camera, samples)
