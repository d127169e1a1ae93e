"""Render images of a scene by ray casting: buffers of its geometry and material, and lit color.

A pixel is a box: its value is the mean over samples spread evenly inside it. Sampling is adaptive. Every pixel in the
object's projected bounds gets BASE_SAMPLES. The number doubles, up to the limit of the call, while the pixel is partly
covered or the standard error of its mean is above TOLERANCE.

Transparency: MASK materials are cut out as glTF says. BLEND materials are opaque where alpha >= 0.5 and absent below,
since a buffer holds one surface. Faces are seen from both sides, whatever the material's doubleSided says.
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
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.rays import RayCaster, is_convex
from gdtool.geometry.vectors import dot
from gdtool.images.color import srgb_from_linear
from gdtool.shading.render.pattern import pixel_pattern
from gdtool.shading.render.surface_points import SurfaceLookup

# Samples of every pixel in bounds: the fewest from which an error can be estimated.
BASE_SAMPLES = 4
# While pixels have at most this many samples, those beside an outline or beside an unresolved pixel get more too: the
# detail that leaves the neighbour unresolved may pass between their samples.
OUTLINE_SAMPLES = 8
# The most alpha-tested layers that a ray passes through; what is behind them is not hit.
MAX_LAYERS = 32
# The standard error of a pixel's mean, in the units a picture stores (sRGB, (n + 1) / 2), above which it gets more
# samples. Color has a larger one, since its noise costs more to reduce.
TOLERANCE = {"normal": 0.009, "albedo": 0.009, "roughness": 0.009, "metallic": 0.009, "color": 0.018}
# Factor from a value to the units a picture stores; None: the sRGB curve.
STORED_SCALE = {"normal": 0.5, "albedo": None, "roughness": 1.0, "metallic": 1.0, "color": None}
# The error of a mean over n evenly spread samples is ERROR_SCALE n^ERROR_POWER times the standard error of random ones:
# 0.47 for 4 and 0.25 for 64, measured in tests/shading/test_pattern.py.
ERROR_SCALE, ERROR_POWER = 0.65, -0.2
# The same factor for color, whose directions to the light are spread less evenly over a pixel's samples.
COLOR_ERROR_SCALE = 0.8
DOMAINS = ("normal", "depth", "albedo", "roughness", "metallic")
# Samples that a thread works on at once. Up to four such bands wait for each thread, which bounds the memory.
BAND_SAMPLES = 1 << 16


@dataclass(frozen=True)
class Goal:
    """Set when a view ends before its pixels have all their samples.

    seconds: limit of the time, None for none. psnr: estimated PSNR of the color in dB (peak 1, sRGB, over the covered
    pixels) at which the view is done, None for none.
    """

    seconds: float | None = None
    psnr: float | None = None


@dataclass
class ShadingPoints:
    """Hold n surface points that a camera sees, one for each sample that hits; the samples of a pixel are consecutive.

    pixel (n,): flat index. sample (n,): number within the pixel. position (n, 3). view (n, 3): unit, toward the eye.
    depth (n,): along the viewing axis, in world units. values: attributes as SurfaceLookup.attributes returns them.
    per_pixel: samples that a pixel has had when these are done.
    """

    pixel: np.ndarray
    sample: np.ndarray
    position: np.ndarray
    view: np.ndarray
    depth: np.ndarray
    values: dict[str, np.ndarray]
    per_pixel: int = 1

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass
class Counts:
    """Count the work that a renderer did and left out, over all its views. seconds: the time of each step, by name."""

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
        """Add the seconds since a time.perf_counter() to the step `what`, and numbers to other counts; thread-safe."""
        with self.lock:
            self.seconds[what] = self.seconds.get(what, 0.0) + time.perf_counter() - since
            for name, count in more.items():
                setattr(self, name, getattr(self, name) + count)


class Renderer:
    """Render views of one scene; holds its ray casters, material lookup and thread pool.

    threads: of the pool, None for as many as there are cores.
    """

    def __init__(self, scene: Scene, threads: int | None = None):
        self.scene = scene
        self.lookup = SurfaceLookup(scene)
        self.caster = RayCaster(TriMesh(scene.vertices, scene.faces), threads)
        tested = self.lookup.alpha_faces()
        self.tested = tested if tested.any() else None
        self.solid_caster, self.tested_faces, self.tested_caster = self.caster, None, None
        if self.tested is not None:
            self.solid_caster = RayCaster(TriMesh(scene.vertices, scene.faces[~tested]), threads)
            self.tested_faces = np.flatnonzero(tested)
            self.tested_caster = RayCaster(TriMesh(scene.vertices, scene.faces[tested]), threads)
        used = scene.vertices[np.unique(scene.faces)]
        self.bounds = np.stack([used.min(0), used.max(0)])
        self.extent = float((self.bounds[1] - self.bounds[0]).max()) or 1.0
        self.convex = self.tested is None and is_convex(TriMesh(scene.vertices, scene.faces))
        self.counts = Counts()
        self.pool = ThreadPoolExecutor(self.caster.threads)

    def trace(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first hits of n rays that pass the alpha test.

        Takes origins and unit directions (n, 3). Returns face_idx (n,), -1 for no hit, distance (n,) and barycentric
        (n, 3).
        """
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
        """Test whether a surface that passes the alpha test is hit by each ray: (n,) bool.

        origins, directions (n, 3): the directions are unit.
        """
        out = self.solid_caster.occluded(origins, directions)
        if self.tested is None:
            return out
        active = np.flatnonzero(~out)
        origin = origins[active].astype(np.float64)
        for _ in range(MAX_LAYERS):
            hits = self.tested_caster.first_hit(origin, directions[active])
            hit = hits.is_hit
            active, origin = active[hit], origin[hit]
            if not len(active):
                break
            alpha, cutoff = self.lookup.alpha(self.tested_faces[hits.face_idx[hit]], hits.barycentric[hit])
            out[active[alpha >= cutoff]] = True
            through = alpha < cutoff
            active = active[through]
            origin = origin[through] + directions[active] * (hits.distance[hit][through] + 1e-5 * self.extent)[:, None]
        return out

    def may_be_hidden(self, position: np.ndarray, geometric_normal: np.ndarray) -> np.ndarray | None:
        """Test whether anything can lie in front of points (n, 3): (n,) bool, or None where it can for all points.

        geometric_normal (n, 3): unit. Of a convex scene, nothing hides a point on the outside from a direction above
        its horizon.
        """
        if not self.convex:
            return None
        return ((position - self.bounds.mean(0)) * geometric_normal).sum(1) <= 0

    def window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Find the rows and columns (top, bottom, left, right) of the object's projected bounds."""
        used = self.scene.vertices if len(self.scene.vertices) < 200_000 else _box_corners(self.bounds)
        pixels, depth = project(camera, used)
        if camera.projection == "perspective" and (depth <= 1e-6).any():
            return 0, camera.height, 0, camera.width
        low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int)
        return (max(low[1], 0), min(high[1], camera.height), max(low[0], 0), min(high[0], camera.width))

    def trace_pixels(
        self, camera: Camera, pixel: np.ndarray, pattern: np.ndarray, first: int, emission: bool = True
    ) -> ShadingPoints:
        """Find the surface points that pixels (m,) see at the subpixel offsets pattern[first:].

        pixel: flat indices. pattern (k, 2): offsets in [0, 1) of all samples that a pixel then has; those before
        `first` are done already. emission: whether to look up the emission.
        """
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
                    float((_box_corners(self.bounds) @ camera.backward).max())
                    - float(camera.position @ camera.backward),
                )
                + 1e-3 * self.extent
            )
            origins += camera.backward * back
        else:
            back = 0.0
        started = time.perf_counter()
        face_idx, distance, barycentric = self.trace(origins, directions)
        self.counts.spend("rays", started, samples=len(pixel))
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
        return ShadingPoints(pixel, sample, position, -directions, depth, values, len(pattern))

    def render_each(self, work: Callable[[Camera], dict], cameras: Iterable[Camera]) -> Iterator[dict]:
        """Yield work(camera) for each camera, in order, with two cameras at a time in threads.

        One view's rays are traced while the sums of the other are evaluated.
        """
        with ThreadPoolExecutor(min(2, self.caster.threads)) as pool:
            yield from pool.map(work, cameras)

    def buffers(self, camera: Camera, samples: int = 16, shade=None, goal: Goal = Goal()) -> dict[str, np.ndarray]:
        """Render one view: an image (h, w[, c]) float32 for each domain, and "mask", as render_buffers returns them.

        Args:
            camera: the view.
            samples: the most samples of a pixel.
            shade: function from ShadingPoints to {"color": (n, 3)}; with it, the result has the image "color".
            goal: when to stop earlier.
        """
        started = time.perf_counter()
        height, width = camera.height, camera.width
        top, bottom, left, right = self.window(camera)
        self.counts.spend(
            "bounds", started, pixels=height * width, pixels_in_bounds=max(bottom - top, 0) * max(right - left, 0)
        )
        film, pattern = _Film(height * width), pixel_pattern(samples, BASE_SAMPLES)
        pixel = (np.arange(top, bottom)[:, None] * width + np.arange(left, right)[None]).ravel()
        done, taken = 0, 0
        tolerance = {
            name: limit if goal.psnr is None else min(limit, 0.5 * 10 ** (-goal.psnr / 20))
            for name, limit in TOLERANCE.items()
        }
        while len(pixel) and done < samples:
            count = min(max(2 * done, BASE_SAMPLES), samples)
            self._add_samples(film, camera, pixel, pattern[:count], done, shade)
            taken += len(pixel) * (count - done)
            psnr = film.update_psnr()
            done = count
            if done >= samples or not film.hits.any():
                break
            if goal.psnr is not None and done > BASE_SAMPLES and psnr is not None and psnr >= goal.psnr:
                break
            pixel, error = film.unresolved(pixel, width, height, tolerance, done)
            if goal.seconds is not None:
                spent = time.perf_counter() - started
                room = int((goal.seconds - spent) / spent * taken / done) if goal.seconds > spent else 0
                if room < len(pixel):
                    pixel = np.sort(pixel[np.argsort(-error, kind="stable")[:room]])
        self.counts.estimated_psnr = film.update_psnr()
        return film.images(camera, () if shade is None else ("color",))

    def _add_samples(
        self, film: _Film, camera: Camera, pixel: np.ndarray, pattern: np.ndarray, first: int, shade
    ) -> None:
        """Add the samples pattern[first:] of pixels (m,) to the film, a band of pixels in each task of the thread pool.

        shade: see buffers().
        """
        more = len(pattern) - first
        # Each thread gets as many bands as the others, or one would wait; a small picture is one band.
        bands = -(-len(pixel) * more // BAND_SAMPLES)
        step = -(-len(pixel) // (bands if bands == 1 else -(-bands // self.caster.threads) * self.caster.threads))

        def trace_band(part: np.ndarray) -> tuple[np.ndarray, int, ShadingPoints, dict]:
            started = time.perf_counter()
            points = self.trace_pixels(camera, part, pattern, first, shade is not None)
            shaded = shade(points) if shade is not None and len(points) else {}
            self.counts.spend("samples", started, pixels_refined=len(part) if first == BASE_SAMPLES else 0)
            return part, more, points, shaded

        waiting: deque = deque()
        for start in range(0, len(pixel), step):
            waiting.append(self.pool.submit(trace_band, pixel[start : start + step]))
            if len(waiting) > 4 * self.caster.threads:
                film.add(*waiting.popleft().result())
        for band in waiting:
            film.add(*band.result())


class _Film:
    """Accumulate the sums and the sums of squares of samples, a row for each pixel.

    samples (p,): samples of each of p pixels. hits (p,): those of them that hit the surface.
    """

    def __init__(self, pixels: int):
        self.pixels = pixels
        self.samples, self.hits = np.zeros(pixels), np.zeros(pixels)
        self.sums: dict[str, np.ndarray] = {}
        self.squares: dict[str, np.ndarray] = {}
        # Set by update_psnr: means and samples at its last call, and each pixel's squared error.
        self.last_mean: np.ndarray | None = None
        self.last_samples: np.ndarray | None = None
        self.squared_change: np.ndarray | None = None

    def add(self, pixel: np.ndarray, times: int, points: ShadingPoints, shaded: dict[str, np.ndarray]) -> None:
        """Add `times` samples of each of pixels (m,): the points that they hit, and shaded values by name."""
        self.samples[pixel] += times
        if not len(points):
            return
        values = {k: points.values[k] for k in ("normal", "albedo", "roughness", "metallic")}
        values["depth"] = points.depth
        values |= shaded
        # The samples of a pixel follow each other.
        starts = np.flatnonzero(np.diff(points.pixel, prepend=-1))
        owner = points.pixel[starts]
        self.hits[owner] += np.diff(starts, append=len(points))
        for name, value in values.items():
            value = np.ascontiguousarray(np.atleast_2d(value.T), np.float64 if name == "depth" else np.float32)
            if name not in self.sums:
                self.sums[name] = np.zeros((self.pixels, len(value)))
                self.squares[name] = np.zeros((self.pixels, len(value)))
            self.sums[name][owner] += np.add.reduceat(value, starts, axis=1).T
            if name in STORED_SCALE:
                self.squares[name][owner] += np.add.reduceat(value * value, starts, axis=1).T

    def error(self, name: str, pixel: np.ndarray) -> np.ndarray:
        """Estimate the squared error (n,) of the means of pixels (n,), averaged over channels.

        name: a key of STORED_SCALE. The unit is that of the stored picture, for example sRGB values in [0, 1] for
        albedo.
        """
        count = np.maximum(self.hits[pixel], 1)[:, None]
        mean = self.sums[name][pixel] / count
        variance = np.maximum(self.squares[name][pixel] / count - mean * mean, 0)
        slope = _srgb_slope(mean) if STORED_SCALE[name] is None else STORED_SCALE[name]
        spread = COLOR_ERROR_SCALE if name == "color" else ERROR_SCALE * count**ERROR_POWER
        return (variance / count * (slope * spread) ** 2).mean(1)

    def update_psnr(self) -> float | None:
        """Estimate the color's PSNR in dB from what changed since the last call; None at the first call or without
        color.

        A pass doubles a pixel's samples, so the mean over half of them is compared with the mean over all.
        """
        if "color" not in self.sums:
            return None
        covered = np.flatnonzero(self.hits)
        mean = np.clip(self.sums["color"] / np.maximum(self.hits, 1)[:, None], 0, 1)
        psnr = None
        if self.last_mean is not None and len(covered):
            change = ((srgb_from_linear(mean[covered]) - srgb_from_linear(self.last_mean[covered])) ** 2).mean(1)
            # A pixel without new samples keeps its last estimate.
            self.squared_change[covered] = np.where(
                self.samples[covered] > self.last_samples[covered], change, self.squared_change[covered]
            )
            psnr = float(-10 * np.log10(max(self.squared_change[covered].mean(), 1e-10)))
        elif len(covered):
            self.squared_change = np.zeros(self.pixels)
            self.squared_change[covered] = self.error("color", covered)
        self.last_mean, self.last_samples = mean, self.samples.copy()
        return psnr

    def unresolved(
        self, pixel: np.ndarray, width: int, height: int, tolerance: dict[str, float], done: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Choose the pixels among (m,) that need more samples, and estimate the squared error of each.

        Chosen are partly covered pixels, and pixels whose error exceeds the tolerance. As long as pixels have few
        samples (done <= OUTLINE_SAMPLES), also pixels at the outline, and neighbours of a chosen one.

        tolerance: the largest standard error of each domain. done: samples that each pixel has.

        Returns:
            The chosen pixels (n,), and their squared error (n,) in units of the squared tolerance; inf where partly
                covered.
        """
        hits = self.hits[pixel]
        partly = (hits > 0) & (hits < self.samples[pixel])
        if done <= OUTLINE_SAMPLES:
            covered = (self.hits > 0).reshape(height, width)
            whole = (self.hits == self.samples).reshape(height, width) & covered
            partly |= ((hits == 0) & _dilate(covered)[pixel]) | ((hits > 0) & _dilate(~whole)[pixel])
        worst = np.zeros(len(pixel))
        some = np.flatnonzero(hits > 0)
        for name in STORED_SCALE:
            if name in self.sums:
                worst[some] = np.maximum(worst[some], self.error(name, pixel[some]) / tolerance[name] ** 2)
        chosen = partly | (worst > 1)
        if done <= OUTLINE_SAMPLES:
            image = np.zeros(width * height, bool)
            image[pixel[chosen]] = True
            chosen |= (hits > 0) & _dilate(image.reshape(height, width))[pixel]
        return pixel[chosen], np.where(partly, np.inf, worst)[chosen]

    def images(self, camera: Camera, more: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
        """Compute the mean images (h, w[, c]) float32 of DOMAINS and of the names in `more`, and the mask (h, w)."""
        shape = (camera.height, camera.width)
        out = {"mask": (self.hits / np.maximum(self.samples, 1)).reshape(shape).astype(np.float32)}
        count = np.maximum(self.hits, 1)[:, None]
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


def _dilate(inside: np.ndarray) -> np.ndarray:
    """Dilate a bool image (h, w) by one pixel in all eight directions; flat (h * w,)."""
    padded = np.pad(inside, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return (rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]).ravel()


def _srgb_slope(x: np.ndarray) -> np.ndarray:
    """Differentiate the sRGB curve at linear values x; 0 beyond 1, where a picture is clipped."""
    inside = np.clip(x, 0.0031308, 1)
    return np.where(x > 1, 0.0, np.where(x <= 0.0031308, 12.92, 1.055 / 2.4 * inside ** (1 / 2.4 - 1)))


def _box_corners(bounds: np.ndarray) -> np.ndarray:
    """List the corners (8, 3) of a box (2, 3)."""
    return np.stack(np.meshgrid(*bounds.T, indexing="ij"), -1).reshape(-1, 3)


def render_buffers(scene: Scene, camera: Camera, samples: int = 16) -> dict[str, np.ndarray]:
    """Render a scene's buffers for one camera.

    Returns:
        By name, float32: normal (h, w, 3) shading normals in world axes, depth (h, w) in world units, albedo (h, w, 3)
            linear, roughness and metallic (h, w), mask (h, w) coverage in [0, 1]. Values are means over the covered
            part of a pixel, and 0 where nothing is seen.
    """
    return Renderer(scene).buffers(camera, samples)
