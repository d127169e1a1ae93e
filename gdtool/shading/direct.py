"""Direct light of an environment with shadows: multiple importance sampling of the light and the reflection, Embree visibility.

Everything per pair of point and direction is a scalar: with Schlick's Fresnel, F = f0 + (f90 − f0) w, reflected radiance is a
linear combination of four sums over the directions, in which only w depends on them.

Diffuse light that nothing hides is known without rays and without noise: irradiance from a table. The sampled directions
only have to say what is hidden. With V the sum over visible directions, U over all of them and B what is known, the
estimate is V + β (B − U), β the visible share of U in the pixel: a control variate where little is hidden, 0 where
everything is, and unbiased for any β that does not depend on the noise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np

from gdtool.shading.environment import LUMINANCE, Environment
from gdtool.shading.reflection import Surface, tensor_of

if TYPE_CHECKING:
    from gdtool.shading.render import Points, Renderer

# Directions drawn once from the light; each point takes its own run of them.
POOL = 1 << 16
# Point-times-direction pairs shaded at once: many enough that calls cost little beside them.
PAIRS = 1 << 17
# Sums of a point: of visible directions reflection, its part w, diffuse, its part w; of all directions the first three;
# known without directions reflection, its part w, diffuse.
SUMS = 10
# What little all directions together found counts as so much visible light of what is known.
PRIOR = 0.02


def sobol(count: int, dimensions: int, seed: int) -> np.ndarray:
    """(count, dimensions) scrambled Sobol points in [0, 1); count a power of two keeps every aligned run stratified."""
    import torch

    return torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed).draw(count, dtype=torch.float64).numpy()


class DirectLight:
    """An estimator of the light that points reflect toward the eye.

    samples: directions a point draws from the light, and as many from its reflection, each weighted by the balance
    heuristic (Veach 1997): f L cos / (n p_light + n p_reflection). mode "sampled" becomes exact as samples grow;
    "prefiltered" takes reflection from the split sum and from the samples only its visible share, none when samples
    is 0. shadows False leaves visibility out. known False leaves out what is known without rays.
    """

    def __init__(self, renderer: Renderer, environment: Environment, samples: int, seed: int = 0, brdf: str = "gltf", shadows: bool = True,
                 mode: Literal["sampled", "prefiltered"] = "sampled", known: bool = True):
        from gdtool.shading.prefilter import IrradianceMap, LightPyramid, Prefiltered

        self.renderer, self.environment, self.brdf, self.shadows, self.seed = renderer, environment, brdf, shadows, seed
        self.mode, self.known = mode, known
        # Runs start at multiples of their length, a power of two, so that each is a stratified set of its own.
        self.samples = 1 << round(math.log2(samples)) if samples else 0
        if self.samples:
            directions, radiance, density = environment.sample(sobol(POOL, 2, seed))
            self.pool = tuple(tensor_of(x) for x in (*directions.T, density, radiance))
            self.pattern = tuple(tensor_of(x) for x in sobol(POOL, 3, seed + 1).T)
        elif mode == "sampled":
            raise ValueError("sampled light needs samples")
        self.irradiance = IrradianceMap(environment)
        self.image, self.density = tensor_of(environment.image.reshape(-1, 3)), tensor_of(environment.pdf.reshape(-1))
        self.prefiltered = Prefiltered(LightPyramid(environment), brdf) if mode == "prefiltered" else None

    def color(self, exposure: float = 1.0) -> Callable[[Points], dict[str, np.ndarray]]:
        """The shading that Renderer.buffers takes for a color image."""
        return lambda points: {"color": self.radiance(points) * np.float32(exposure)}

    def radiance(self, points: Points) -> np.ndarray:
        """(n, 3) linear radiance toward the eye, emission included."""
        k = self.samples
        step = max(1, PAIRS // max(k, 8))
        sums = np.zeros((len(points), SUMS, 3), np.float32)
        runs = self._runs(points) if k else None
        if self.mode == "prefiltered" and len(points):
            from gdtool.shading.prefilter import lobe_roughness

            n_v = np.einsum("ij,ij->i", points.values["normal"], points.view)
            self.prefiltered.prepare(lobe_roughness(tensor_of(points.values["roughness"]), tensor_of(n_v)))

        at, counted = time.perf_counter(), np.zeros(3, np.int64)
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            counted += self._chunk(points, part, None if runs is None else runs[:, part], sums[part])
        cast, below, convex = counted.tolist()
        self.renderer.counts.spend("directions", at, shadow_rays=cast, shadow_rays_below_horizon=below, shadow_rays_convex=convex)
        out = self._combined(points, sums)
        out += points.values["emissive"]
        unlit = points.values["unlit"]
        out[unlit] = points.values["albedo"][unlit]
        return out

    def _runs(self, points: Points) -> np.ndarray:
        """(2, n) which run of the pool and of the pattern each point takes.

        The samples of a pixel take neighbouring runs, which together are one larger stratified set, and so are its first
        two, four, eight of them. Which block of runs that is, and where in it the pixel begins, is drawn by its number.
        """
        k = self.samples
        block = min(1 << max(0, points.together - 1).bit_length(), max(1, POOL // k // 16))
        out = np.empty((2, len(points)), np.int64)
        for which in (0, 1):
            number = _scrambled(points.pixel + (points.sample // block) * 0x5851F42D, self.seed * 2 + which)
            out[which] = (number // block) % (POOL // k // block) * block + ((points.sample % block) ^ (number % block))
        return out

    def _chunk(self, points: Points, part: slice, runs: np.ndarray | None, sums: np.ndarray) -> tuple[int, int, int]:
        """Fill sums; shadow rays cast, directions that needed none below the horizon, and on convex objects."""
        import torch

        k = self.samples
        surface = Surface(points.view, points.values, part, self.brdf)
        result = torch.from_numpy(sums)
        result[:, 9] = tensor_of(self.irradiance.lookup(points.values["normal"][part])) / math.pi
        if self.mode == "prefiltered":
            normal, view = (tensor_of(x[part]) for x in (points.values["normal"], points.view))
            result[:, 7], result[:, 8] = self.prefiltered.specular(normal, view, tensor_of(points.values["roughness"][part]))
        if not k:
            return 0, 0, 0
        light_run, pattern_run = torch.from_numpy(runs[0]), torch.from_numpy(runs[1])

        def run_of(pool, run):
            return pool.reshape(POOL // k, k, *pool.shape[1:]).index_select(0, run)

        x, y, z, p_light, light = (run_of(part, light_run) for part in self.pool)
        first = self._gather(points, part, surface, (x, y, z), light, p_light, k)
        direction = surface.sample(*(run_of(u, pattern_run) for u in self.pattern))
        pixel = self._pixel(*direction)
        flat = pixel.reshape(-1)
        terms, p_reflect, above = evaluated = surface.evaluate(*direction)
        second = self._gather(points, part, surface, direction, self.image.index_select(0, flat).view(*pixel.shape, 3),
                              self.density.index_select(0, flat).view_as(pixel), k, evaluated)
        result[:, :7] = first[0] + second[0]
        return first[1] + second[1], first[2] + second[2], first[3] + second[3]

    def _pixel(self, x, y, z):
        """Environment.pixel_of in float32."""
        import torch

        height, width = self.environment.image.shape[:2]
        row = (torch.acos(y.clamp(-1, 1)) * (height / math.pi)).long().clamp_max(height - 1)
        column = ((torch.atan2(z, x) * (0.5 / math.pi) + 0.5) * width).long().clamp(0, width - 1)
        return row * width + column

    def _gather(self, points: Points, part: slice, surface: Surface, direction, light, p_light, k: int, evaluated=None):
        """The first seven sums (n, 7, 3), shadow rays cast, directions that needed none below the horizon, and on convex
        objects."""
        import torch

        terms, p_reflect, above = surface.evaluate(*direction) if evaluated is None else evaluated
        everything = 1 / (k * (p_light + p_reflect)).clamp_min(1e-20)
        weight = above * everything
        flat = above.reshape(-1).nonzero()[:, 0]
        lit = len(flat)
        if self.shadows and lit:
            owner = (flat // k).numpy()
            inner = self.renderer.may_be_hidden(points.position[part], surface.geometric_rows.numpy())
            if inner is not None:
                chosen = inner[owner]
                flat, owner = flat[torch.from_numpy(chosen)], owner[chosen]
            origins = surface.lifted(points.position[part], 2e-4 * self.renderer.extent)[owner]
            rays = torch.stack([c.reshape(-1)[flat] for c in direction], 1).numpy()
            weight.reshape(-1)[flat[torch.from_numpy(self.renderer.occluded(origins, rays))]] = 0.0
        else:
            flat = flat[:0]
        # Only prefiltered light asks what share of the reflection is visible.
        kept = slice(0, 3) if self.mode == "prefiltered" else slice(2, 3)
        parts = torch.bmm(torch.stack([*(term * weight for term in terms), *(term * everything for term in terms[kept])], 1), light)
        sums = parts if self.mode == "prefiltered" else torch.cat([parts[:, :4], torch.zeros(len(parts), 2, 3), parts[:, 4:]], 1)
        return sums, len(flat), above.numel() - lit, lit - len(flat) if self.shadows else 0

    def _combined(self, points: Points, sums: np.ndarray) -> np.ndarray:
        """(n, 3) radiance without emission."""
        if not len(points):
            return np.empty((0, 3), np.float32)
        values = points.values
        albedo, metallic = values["albedo"], values["metallic"][:, None]
        f0 = values["f0"][:, None] * (1 - metallic) + albedo * metallic
        # How much reflection grows toward grazing: to 1, or to what KHR_materials_specular leaves of a dielectric's.
        growth = values["f90"][:, None] * (1 - metallic) + metallic - f0
        n_v = np.einsum("ij,ij->i", values["normal"], points.view)
        reflect = [f0 * sums[:, i] + growth * sums[:, i + 1] for i in (0, 4, 7)]
        diffuse = [sums[:, i] for i in (2, 6, 9)]
        starts = np.flatnonzero(np.diff(points.pixel, prepend=-1))
        owner = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(points)))
        if self.mode == "prefiltered":
            import torch

            from gdtool.shading.closed_form import disney_mean, fresnel_loss

            seen = [1.0, 1.0] if not self.samples else [_share(*x, starts)[owner] for x in (reflect, diffuse)]
            cosine, roughness = tensor_of(n_v), tensor_of(values["roughness"])
            if self.brdf == "gltf":
                factor = 1 - f0 - growth * torch.as_tensor(fresnel_loss(cosine)).numpy()[:, None]
            else:
                factor = torch.as_tensor(disney_mean(roughness, cosine.clamp(0, 1))).numpy()[:, None]
            specular, received = reflect[2] * seen[0], diffuse[2] * seen[1] * factor
        else:
            specular, received = reflect[0], diffuse[0]
            if self.known and self.brdf == "gltf":
                received = received + _share(*diffuse, starts)[owner] * (diffuse[2] - diffuse[1])
            if self.brdf == "gltf":
                received = (1 - f0) * received - growth * sums[:, 3]
        return (specular + np.maximum(albedo * (1 - metallic) * received, 0)).astype(np.float32)


def _share(visible: np.ndarray, everything: np.ndarray, known: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(m, 1) visible share of light in each run of points (n, 3) that begins at starts (m,)."""
    v, u, b = (np.add.reduceat(x @ LUMINANCE, starts) for x in (visible, everything, known))
    return np.clip((v + PRIOR * b) / np.maximum(u + PRIOR * b, 1e-20), 0, 1).astype(np.float32)[:, None]


def _scrambled(index: np.ndarray, seed: int) -> np.ndarray:
    """Well-mixed non-negative integers from (n,) indices: the finaliser of SplitMix64 (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        x = index.astype(np.uint64) + np.uint64((seed * 0x9E3779B97F4A7C15) % 2**64)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return ((x ^ (x >> np.uint64(31))) >> np.uint64(1)).astype(np.int64)
