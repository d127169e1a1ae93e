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
# Share of what a point's directions bring on average that one must bring for its shadow ray to be certain.
RARE = 0.5
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
            self.dice = tensor_of(np.random.default_rng(seed).random(POOL))
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
        step = max(1, PAIRS // max(2 * k, 8))
        sums = np.zeros((len(points), SUMS, 3), np.float32)
        runs = self._runs(points) if k else None
        if self.mode == "prefiltered" and len(points):
            from gdtool.shading.prefilter import lobe_roughness

            n_v = np.einsum("ij,ij->i", points.values["normal"], points.view)
            self.prefiltered.prepare(lobe_roughness(tensor_of(points.values["roughness"]), tensor_of(n_v)))

        at, counted = time.perf_counter(), np.zeros(4, np.int64)
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            counted += self._chunk(points, part, None if runs is None else runs[:, part], sums[part])
        cast, below, convex, rare = counted.tolist()
        self.renderer.counts.spend("directions", at, shadow_rays=cast, shadow_rays_below_horizon=below, shadow_rays_convex=convex, shadow_rays_rare=rare)
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

    def _chunk(self, points: Points, part: slice, runs: np.ndarray | None, sums: np.ndarray) -> tuple[int, int, int, int]:
        """Fill sums; the counts of _hide."""
        import torch

        k = self.samples
        surface = Surface(points.view, points.values, part, self.brdf)
        result = torch.from_numpy(sums)
        result[:, 9] = tensor_of(self.irradiance.lookup(points.values["normal"][part])) / math.pi
        if self.mode == "prefiltered":
            normal, view = (tensor_of(x[part]) for x in (points.values["normal"], points.view))
            result[:, 7], result[:, 8] = self.prefiltered.specular(normal, view, tensor_of(points.values["roughness"][part]))
        if not k:
            return 0, 0, 0, 0
        light_run, pattern_run = torch.from_numpy(runs[0]), torch.from_numpy(runs[1])

        def run_of(pool, run):
            return pool.reshape(POOL // k, k, *pool.shape[1:]).index_select(0, run)

        *toward, p_light, light = (run_of(pool, light_run) for pool in self.pool)
        mirrored = surface.sample(*(run_of(u, pattern_run) for u in self.pattern))
        pixel = self._pixel(*mirrored)
        flat = pixel.reshape(-1)
        direction = [torch.cat(pair, 1) for pair in zip(toward, mirrored, strict=True)]
        light = torch.cat([light, self.image.index_select(0, flat).view(*pixel.shape, 3)], 1)
        p_light = torch.cat([p_light, self.density.index_select(0, flat).view_as(pixel)], 1)
        terms, p_reflect, above = surface.evaluate(*direction)
        everything = 1 / (k * (p_light + p_reflect)).clamp_min(1e-20)
        weight, counted = above * everything, (0, 0, 0, 0)
        if self.shadows:
            brightness = surface.brightness(terms, light @ tensor_of(LUMINANCE)) * weight
            dice = torch.cat([run_of(self.dice, light_run), run_of(self.dice, pattern_run)], 1)
            counted = self._hide(points, part, surface, direction, (weight, everything), above, brightness, dice)
        # Only prefiltered light asks what share of the reflection is visible.
        split = self.mode == "prefiltered"
        kept = terms[:3] if split else terms[2:3]
        parts = torch.bmm(torch.stack([*(term * weight for term in terms), *(term * everything for term in kept)], 1), light)
        result[:, :4] = parts[:, :4]
        result[:, 4 if split else 6:7] = parts[:, 4:]
        return counted

    def _pixel(self, x, y, z):
        """Environment.pixel_of in float32."""
        import torch

        height, width = self.environment.image.shape[:2]
        row = (torch.acos(y.clamp(-1, 1)) * (height / math.pi)).long().clamp_max(height - 1)
        column = ((torch.atan2(z, x) * (0.5 / math.pi) + 0.5) * width).long().clamp(0, width - 1)
        return row * width + column

    def _hide(self, points: Points, part: slice, surface: Surface, direction, weights, above, brightness, dice) -> tuple[int, int, int, int]:
        """Take the first of two weights (n, m) from directions that something hides; how many shadow rays that took, and how
        many directions needed none: below the horizon, on convex objects, and for bringing too little light.

        A direction that brings less than RARE of what its point's directions do on average is followed only with the
        probability brightness / (RARE of that), and counts for as many more (Russian roulette): the mean stays what it is.
        Both weights tell so, and where nothing is hidden they stay the same.
        """
        import torch

        columns = above.shape[1]
        flat = above.reshape(-1).nonzero()[:, 0]
        lit = len(flat)
        inner = self.renderer.may_be_hidden(points.position[part], surface.geometric_rows.numpy())
        if inner is not None:
            flat = flat[torch.from_numpy(inner)[flat // columns]]
        asked = len(flat)
        chance = (brightness / (RARE * brightness.mean(1, keepdim=True)).clamp_min(1e-20)).reshape(-1)[flat].clamp_max_(1)
        follow = dice.reshape(-1)[flat] < chance
        visible, everything = (weight.reshape(-1) for weight in weights)
        times = torch.where(follow, 1 / chance.clamp_min(1e-20), 0.0)
        visible[flat] *= times
        everything[flat] *= times
        flat = flat[follow]
        origins = surface.lifted(points.position[part], 2e-4 * self.renderer.extent)[(flat // columns).numpy()]
        rays = torch.stack([c.reshape(-1)[flat] for c in direction], 1).numpy()
        visible[flat[torch.from_numpy(self.renderer.occluded(origins, rays))]] = 0.0
        return len(flat), above.numel() - lit, lit - asked, asked - len(flat)

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
    v, u, b = (np.add.reduceat(np.einsum("ij,j->i", x, LUMINANCE), starts) for x in (visible, everything, known))
    return np.clip((v + PRIOR * b) / np.maximum(u + PRIOR * b, 1e-20), 0, 1).astype(np.float32)[:, None]


def _scrambled(index: np.ndarray, seed: int) -> np.ndarray:
    """Well-mixed non-negative integers from (n,) indices: the finaliser of SplitMix64 (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        x = index.astype(np.uint64) + np.uint64((seed * 0x9E3779B97F4A7C15) % 2**64)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return ((x ^ (x >> np.uint64(31))) >> np.uint64(1)).astype(np.int64)
