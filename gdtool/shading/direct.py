"""Direct light of an environment with shadows: multiple importance sampling of the light and the reflection, Embree visibility.

Everything per pair of point and direction is a scalar: with Schlick's Fresnel, F = f0 + (1 − f0) w, reflected radiance is a
linear combination of four sums over the directions, in which only w depends on them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from gdtool.shading.environment import Environment

if TYPE_CHECKING:
    from gdtool.shading.render import Points, Renderer

# Directions drawn once from the light; each point takes its own run of them.
POOL = 1 << 16
# Point-times-direction pairs shaded at once: few enough for the cache.
PAIRS = 1 << 15
MIN_SPECULAR_SHARE = 0.1
# Normal maps may turn a normal away from the eye: such points are shaded as seen at grazing.
MIN_VIEW_COSINE = 0.02


def sobol(count: int, dimensions: int, seed: int) -> np.ndarray:
    """(count, dimensions) scrambled Sobol points in [0, 1); count a power of two keeps every aligned run stratified."""
    import torch

    return torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed).draw(count, dtype=torch.float64).numpy()


class DirectLight:
    """An estimator of the light that points reflect toward the eye.

    samples: directions a point draws from the light, and as many from its reflection (a quarter of that for the extra
    samples of refined pixels). Each direction is weighted by the balance heuristic (Veach 1997):
    f L cos / (n p_light + n p_reflection). shadows False leaves visibility out.
    """

    def __init__(self, renderer: Renderer, environment: Environment, samples: int, seed: int = 0, brdf: str = "gltf", shadows: bool = True):
        self.renderer, self.environment, self.brdf, self.shadows, self.seed = renderer, environment, brdf, shadows, seed
        # Runs start at multiples of their length, a power of two, so that each is a stratified set of its own.
        self.samples = 1 << max(0, round(math.log2(max(1, samples))))
        directions, radiance, density = environment.sample(sobol(POOL, 2, seed))

        self.pool = tuple(tensor_of(x) for x in (*directions.T, density, radiance))
        self.pattern = tuple(tensor_of(x) for x in sobol(POOL, 3, seed + 1).T)
        self.irradiance = IrradianceMap(environment)
        self.image, self.density = tensor_of(environment.image.reshape(-1, 3)), tensor_of(environment.pdf.reshape(-1))

    def color(self, exposure: float = 1.0) -> Callable[[Points], dict[str, np.ndarray]]:
        """The shading that Renderer.buffers takes for a color image."""
        return lambda points: {"color": self.radiance(points) * np.float32(exposure)}

    def radiance(self, points: Points) -> np.ndarray:
        """(n, 3) linear radiance toward the eye, emission included."""
        out = np.empty((len(points), 3), np.float32)
        from gdtool.shading.render import BASE

        extra = len(points) > 0 and int(points.sample[0]) >= BASE
        k = max(min(2, self.samples), self.samples // 4) if extra else self.samples
        step = max(1, PAIRS // k)
        # The samples of a pixel take neighbouring runs of the pool, which together are one larger stratified set. Which of
        # them a sample takes is turned by the pixel's own number: a run's place in its block fixes its strata.
        together = int(points.sample.max(initial=0)) - BASE + 1 if extra else BASE
        block = min(1 << max(0, together - 1).bit_length(), POOL // k)
        within = (points.sample - BASE if extra else points.sample) % block
        runs = np.empty((2, len(points)), np.int64)
        for which in (0, 1):
            number = _scrambled(points.pixel, self.seed * 4 + 2 * extra + which)
            runs[which] = (number // block) % (POOL // k // block) * block + (within ^ (number % block))

        def shade(start: int) -> tuple[int, int]:
            part = slice(start, start + step)
            out[part], cast, below = self._chunk(points, part, runs[:, part], k)
            return cast, below

        with ThreadPoolExecutor(self.renderer.caster.threads) as pool:
            counted = list(pool.map(shade, range(0, len(points), step)))
        counts = self.renderer.counts
        counts.shadow_rays += sum(cast for cast, _ in counted)
        counts.shadow_rays_below_horizon += sum(below for _, below in counted)
        out += points.values["emissive"]
        unlit = points.values["unlit"]
        out[unlit] = points.values["albedo"][unlit]
        return out

    def _chunk(self, points: Points, part: slice, runs: np.ndarray, k: int) -> tuple[np.ndarray, int, int]:
        import torch

        surface = _Surface(points, part, self.brdf)
        light_run, pattern_run = torch.from_numpy(runs[0]), torch.from_numpy(runs[1])

        def run_of(pool, run):
            return pool.reshape(POOL // k, k, *pool.shape[1:])[run]

        x, y, z, p_light, light = (run_of(part, light_run) for part in self.pool)
        first = self._gather(points, part, surface, (x, y, z), light, p_light, k)
        direction = surface.sample(*(run_of(u, pattern_run) for u in self.pattern))
        pixel = self._pixel(*direction)
        second = self._gather(points, part, surface, direction, self.image[pixel], self.density[pixel], k)
        received = tensor_of(self.irradiance.lookup(points.values["normal"][part]))
        return surface.combine(first[0] + second[0], received).numpy(), first[1] + second[1], first[2] + second[2]

    def _pixel(self, x, y, z):
        """Environment.pixel_of in float32."""
        import torch

        height, width = self.environment.image.shape[:2]
        row = (torch.acos(y.clamp(-1, 1)) * (height / math.pi)).long().clamp_max(height - 1)
        column = ((torch.atan2(z, x) * (0.5 / math.pi) + 0.5) * width).long().clamp(0, width - 1)
        return row * width + column

    def _gather(self, points: Points, part: slice, surface: _Surface, direction, light, p_light, k: int):
        """The four sums over visible directions and the diffuse one over all (n, 5, 3), shadow rays cast, and directions
        that needed none."""
        import torch

        terms, p_reflect, above = surface.evaluate(*direction)
        everything = 1 / (k * (p_light + p_reflect)).clamp_min(1e-20)
        weight = above * everything
        flat = above.reshape(-1).nonzero()[:, 0]
        if self.shadows and len(flat):
            owner = (flat // k).numpy()
            origins = surface.lifted(points, part, 2e-4 * self.renderer.extent)[owner]
            rays = torch.stack([c.reshape(-1)[flat] for c in direction], 1).numpy()
            weight.reshape(-1)[flat[torch.from_numpy(self.renderer.occluded(origins, rays))]] = 0.0
        sums = torch.bmm(torch.stack([*(term * weight for term in terms), terms[2] * everything], 1), light)
        return sums, len(flat), above.numel() - len(flat)


class IrradianceMap:
    """∫ L max(0, n·l) dl of an environment for normals on a lat-long grid, read bilinearly."""

    def __init__(self, environment: Environment, height: int = 48):
        small = environment.shrunk(64)
        # Grid points lie on pixel centres in angle.
        theta = (np.arange(height) + 0.5) / height * np.pi
        phi = ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5) * 2 * np.pi
        ring = np.sin(theta)[:, None]
        normals = np.stack([ring * np.cos(phi), np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height)), ring * np.sin(phi)], -1)
        weighted = (small.image * small.solid_angles[:, None, None]).reshape(-1, 3).astype(np.float32)
        cosine = normals.reshape(-1, 3).astype(np.float32) @ small.directions.reshape(-1, 3).T.astype(np.float32)
        self.values = (np.maximum(cosine, 0) @ weighted).reshape(height, 2 * height, 3)

    def lookup(self, normals: np.ndarray) -> np.ndarray:
        """(n, 3) from unit normals (n, 3)."""
        height, width = self.values.shape[:2]
        y = np.clip(np.arccos(np.clip(normals[:, 1], -1, 1)) * np.float32(height / np.pi) - 0.5, 0, height - 1)
        x = (np.arctan2(normals[:, 2], normals[:, 0]) * np.float32(0.5 / np.pi) + np.float32(0.5)) * width - 0.5
        y0, x0 = np.minimum(y.astype(np.int64), height - 2), np.floor(x).astype(np.int64)
        fy, fx = (y - y0)[:, None], (x - x0)[:, None]
        left, right = x0 % width, (x0 + 1) % width
        upper = self.values[y0, left] * (1 - fx) + self.values[y0, right] * fx
        lower = self.values[y0 + 1, left] * (1 - fx) + self.values[y0 + 1, right] * fx
        return (upper * (1 - fy) + lower * fy).astype(np.float32)


def tensor_of(x: np.ndarray):
    """A float32 tensor of an array."""
    import torch

    return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)


def _scrambled(index: np.ndarray, seed: int) -> np.ndarray:
    """Well-mixed non-negative integers from (n,) indices: the finaliser of SplitMix64 (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        x = index.astype(np.uint64) + np.uint64((seed * 0x9E3779B97F4A7C15) % 2**64)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return ((x ^ (x >> np.uint64(31))) >> np.uint64(1)).astype(np.int64)


class _Surface:
    """Reflection of n points: evaluated and sampled for k directions each, vectors as three (n, k) tensors."""

    def __init__(self, points: Points, part: slice, brdf: str):
        from gdtool.shading.brdf import alpha_of, f0_of

        def tensor(x):
            return tensor_of(x[part])

        values = points.values
        self.brdf = brdf
        normal, view, self.geometric_rows = tensor(values["normal"]), tensor(points.view), tensor(values["geometric_normal"])
        self.albedo, self.metallic = tensor(values["albedo"]), tensor(values["metallic"])
        roughness = tensor(values["roughness"])
        self.f0 = f0_of(self.albedo, self.metallic, tensor(values["f0"])[:, None])
        self.roughness, self.alpha = roughness[:, None], alpha_of(roughness)[:, None]
        self.normal, self.view, self.geometric = ([c[:, None] for c in v.unbind(1)] for v in (normal, view, self.geometric_rows))
        self.n_v_exact = (normal * view).sum(1)[:, None]
        self.n_v = self.n_v_exact.clamp_min(MIN_VIEW_COSINE)
        strongest = self.f0.amax(1)[:, None]
        reflect = strongest + (1 - strongest) * (1 - self.n_v) ** 5
        diffuse = (self.albedo.amax(1) * (1 - self.metallic))[:, None]
        self.share = (reflect / (reflect + diffuse).clamp_min(1e-6)).clamp(MIN_SPECULAR_SHARE, 1.0)

    def lifted(self, points: Points, part: slice, offset: float) -> np.ndarray:
        """(n, 3) float32 positions a little off the surface, on the seen side."""
        return (points.position[part] + offset * self.geometric_rows.numpy()).astype(np.float32)

    def evaluate(self, x, y, z):
        """[D V c, D V c w, d c / π, d c w / π] with c = n·l and d the diffuse model's factor; density of sample(); and 1.0
        where the direction is above the horizon of both the shading and the true normal."""
        from gdtool.shading.brdf import disney_diffuse, ndf, visibility_gltf, visibility_paper

        nx, ny, nz = self.normal
        vx, vy, vz = self.view
        gx, gy, gz = self.geometric
        n_l = nx * x + ny * y + nz * z
        l_v = vx * x + vy * y + vz * z
        above = ((n_l > 0) & (gx * x + gy * y + gz * z > 0)).to(n_l.dtype)
        cosine = n_l.clamp(0, 1)
        # |l + v|² = 2 + 2 l·v, so the half vector itself is not needed.
        n_h = ((n_l + self.n_v_exact) * (2 + 2 * l_v).clamp_min(1e-12).rsqrt()).clamp(0, 1)
        v_h = (0.5 + 0.5 * l_v).clamp(0, 1).sqrt()
        d = ndf(self.alpha, n_h)
        if self.brdf == "gltf":
            v = visibility_gltf(self.alpha, cosine, self.n_v)
            diffuse = cosine * (1 / math.pi)
        else:
            v = visibility_paper(self.roughness, cosine, self.n_v)
            diffuse = cosine * (1 / math.pi) * disney_diffuse(self.roughness, cosine, self.n_v.clamp(0, 1), v_h)
        t = 1 - v_h
        w = (t * t) * (t * t) * t
        specular = d * v * cosine
        # Visible normals (Heitz 2018): p = D G1(v) / (4 n·v) with Smith's G1.
        a2 = self.alpha * self.alpha
        g1 = 2 / (1 + (a2 + (1 - a2) * self.n_v * self.n_v).sqrt() / self.n_v)
        density = d * (self.share * g1 / (4 * self.n_v)) + cosine * ((1 - self.share) * (1 / math.pi))
        return (specular, specular * w, diffuse, diffuse * w), density, above

    def sample(self, u, v, pick):
        """Directions (three (n, k)) from uniform numbers: visible normals mirrored, or cosine-weighted."""
        import torch

        (tx, ty, tz), (bx, by, bz) = frame(*self.normal)
        (nx, ny, nz), (vx, vy, vz) = self.normal, self.view
        a = self.alpha
        ex, ey = tx * vx + ty * vy + tz * vz, bx * vx + by * vy + bz * vz
        length = (ex * ex + ey * ey + self.n_v * self.n_v).rsqrt()
        ex, ey, ez = ex * length, ey * length, self.n_v * length
        # Spherical caps (Dupuy & Benyoub 2023).
        sx, sy = a * ex, a * ey
        length = (sx * sx + sy * sy + ez * ez).rsqrt()
        sx, sy, sz = sx * length, sy * length, ez * length
        phi = 2 * math.pi * v
        cos_phi, sin_phi = phi.cos(), phi.sin()
        z = (1 - u) * (1 + sz) - sz
        ring = (1 - z * z).clamp_min(0).sqrt()
        mx, my, mz = a * (ring * cos_phi + sx), a * (ring * sin_phi + sy), (z + sz).clamp_min(1e-6)
        length = (mx * mx + my * my + mz * mz).rsqrt()
        mx, my, mz = mx * length, my * length, mz * length
        twice = 2 * (mx * ex + my * ey + mz * ez)
        radius = u.sqrt()
        glossy = pick < self.share
        x = torch.where(glossy, twice * mx - ex, radius * cos_phi)
        y = torch.where(glossy, twice * my - ey, radius * sin_phi)
        z = torch.where(glossy, twice * mz - ez, (1 - u).clamp_min(0).sqrt())
        return x * tx + y * bx + z * nx, x * ty + y * by + z * ny, x * tz + y * bz + z * nz

    def combine(self, sums, irradiance):
        """(n, 3) radiance from the sums (n, 5, 3) and the unshadowed irradiance (n, 3).

        Diffuse light is the known irradiance times the share of it that the samples found visible: where nothing is in
        the way that is free of noise, and in full shadow it is 0.
        """
        share = sums[:, 2] / sums[:, 4].clamp_min(1e-20)
        received = irradiance * share if self.brdf == "gltf" else sums[:, 2] * math.pi
        diffuse = self.albedo * (1 - self.metallic)[:, None] * (received / math.pi)
        if self.brdf == "gltf":
            diffuse = (1 - self.f0) * (diffuse - self.albedo * (1 - self.metallic)[:, None] * sums[:, 3]).clamp_min(0)
        return self.f0 * sums[:, 0] + (1 - self.f0) * sums[:, 1] + diffuse


def frame(x, y, z):
    """Tangent and bitangent of unit normals, three components each (Duff et al. 2017)."""
    import torch

    sign = torch.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
