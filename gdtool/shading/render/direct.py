"""Direct light of an environment with shadows: multiple importance sampling of the light and the reflection, Embree
visibility.

Everything per pair of point and direction is a scalar: with Schlick's Fresnel, F = f0 + (f90 − f0) w, reflected
radiance is a linear combination of four sums over the directions, in which only w depends on them.

Diffuse light that nothing hides is known without rays and without noise: irradiance from a table. The sampled
directions only have to say what is hidden. With V the sum over visible directions, U over all of them and B what is
known, the estimate is V + β (B − U), β the visible share of U in the pixel: a control variate where little is hidden, 0
where everything is, and unbiased for any β that does not depend on the noise."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Literal

import numpy as np

from gdtool.shading.bsdf.reflection import Surface, rows_of, tensor_of
from gdtool.shading.lights.environment import LUMINANCE, Environment
from gdtool.shading.sampling import sobol

if TYPE_CHECKING:
    from gdtool.shading.render.render import Points, Renderer

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


class DirectLight:
    """An estimator of the light that points reflect toward the eye.

    samples: directions a point draws from the light, and as many from its reflection, each weighted by the balance
    heuristic (Veach 1997): f L cos / (n p_light + n p_reflection). mode "sampled" becomes exact as samples grow;
    "prefiltered" takes reflection from the split sum and from the samples only its visible share, none when samples
    is 0. shadows False leaves visibility out. known False leaves out what is known without rays.
    """

    def __init__(
        self,
        renderer: Renderer,
        environment: Environment,
        samples: int,
        seed: int = 0,
        brdf: str = "gltf",
        shadows: bool = True,
        mode: Literal["sampled", "prefiltered"] = "sampled",
        known: bool = True,
    ):
        from gdtool.shading.lights.prefilter import IrradianceMap, LightPyramid, Prefiltered

        self.renderer, self.environment, self.brdf, self.shadows, self.seed = renderer, environment, brdf, shadows, seed
        self.mode, self.known = mode, known
        # Runs start at multiples of their length, a power of two, so that each is a stratified set of its own.
        self.samples = 1 << round(math.log2(samples)) if samples else 0
        if not self.samples and mode == "sampled":
            raise ValueError("sampled light needs samples")
        with ThreadPoolExecutor(renderer.caster.threads) as pool:
            known_light = pool.submit(IrradianceMap, environment)
            prefiltered = (
                pool.submit(lambda: Prefiltered(LightPyramid(environment), brdf)) if mode == "prefiltered" else None
            )
            if self.samples:
                directions, radiance, density = environment.sample(sobol(POOL, 2, seed))
                dice = np.random.default_rng(seed).random(POOL)
                # Runs of (x, y, z, red, green, blue, density, dice) for the light and of three numbers and dice for the
                # reflection.
                self.pool = self._runs_of(*directions.T, *radiance.T, density, dice)
                self.pattern = self._runs_of(*sobol(POOL, 3, seed + 1).T, dice)
            self.pixels = tensor_of(
                np.concatenate([environment.image.reshape(-1, 3), environment.pdf.reshape(-1, 1)], 1)
            )
            self.irradiance = known_light.result()
            self.prefiltered = None if prefiltered is None else prefiltered.result()

    def _runs_of(self, *values: np.ndarray):
        """(k, c, POOL / k) of c arrays (POOL,)."""
        return tensor_of(np.stack(values).reshape(len(values), -1, self.samples).transpose(2, 0, 1))

    def color(self, exposure: float = 1.0) -> Callable[[Points], dict[str, np.ndarray]]:
        """The shading that Renderer.buffers takes for a color image."""
        return lambda points: {"color": self.radiance(points) * np.float32(exposure)}

    def radiance(self, points: Points) -> np.ndarray:
        """(n, 3) linear radiance toward the eye, emission included."""
        k = self.samples
        step = max(1, PAIRS // max(2 * k, 2))
        sums = np.zeros((SUMS, 3, len(points)), np.float32)
        runs = self._runs(points) if k else None
        if self.mode == "prefiltered" and len(points):
            from gdtool.shading.lights.prefilter import lobe_roughness

            n_v = (rows_of(points.values["normal"]) * rows_of(points.view)).sum(0)
            self.prefiltered.prepare(lobe_roughness(tensor_of(points.values["roughness"]), n_v))

        at, counted = time.perf_counter(), np.zeros(4, np.int64)
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            counted += self._chunk(points, part, None if runs is None else runs[:, part], sums[..., part])
        cast, below, convex, rare = counted.tolist()
        self.renderer.counts.spend(
            "directions",
            at,
            shadow_rays=cast,
            shadow_rays_below_horizon=below,
            shadow_rays_convex=convex,
            shadow_rays_rare=rare,
        )
        out = self._combined(points, sums)
        out += points.values["emissive"].T
        unlit = points.values["unlit"]
        if unlit.any():
            out[:, unlit] = points.values["albedo"].T[:, unlit]
        return out.T

    def _runs(self, points: Points) -> np.ndarray:
        """(2, n) which run of the pool and of the pattern each point takes.

        The samples of a pixel take neighbouring runs, which together are one larger stratified set, and so are its
        first two, four, eight of them. Which block of runs that is, and where in it the pixel begins, is drawn by its
        number."""
        k = self.samples
        block = min(1 << max(0, points.together - 1).bit_length(), max(1, POOL // k // 16))
        out = np.empty((2, len(points)), np.int64)
        for which in (0, 1):
            number = _scrambled(points.pixel + (points.sample // block) * 0x5851F42D, self.seed * 2 + which)
            out[which] = (number // block) % (POOL // k // block) * block + ((points.sample % block) ^ (number % block))
        return out

    def _chunk(
        self, points: Points, part: slice, runs: np.ndarray | None, sums: np.ndarray
    ) -> tuple[int, int, int, int]:
        """Fill sums (SUMS, 3, n); the counts of _hide."""
        import torch

        k = self.samples
        surface = Surface(points.view, points.values, part, self.brdf)
        result = torch.from_numpy(sums)
        result[9] = self.irradiance.lookup(surface.normal) / math.pi
        if self.mode == "prefiltered":
            result[7], result[8] = self.prefiltered.specular(surface.normal, surface.view, surface.roughness)
        if not k:
            return 0, 0, 0, 0
        drawn, numbers = (
            torch.stack([one.index_select(1, torch.from_numpy(run)) for one in pool]).unbind(1)
            for pool, run in zip((self.pool, self.pattern), runs, strict=True)
        )
        mirrored = surface.sample(*numbers[:3])
        found = self.pixels.index_select(0, self._pixel(*mirrored).reshape(-1)).view(k, -1, 4)
        direction = [torch.cat(pair) for pair in zip(drawn[:3], mirrored, strict=True)]
        *light, p_light = (torch.cat([drawn[3 + i], found[..., i]]) for i in range(4))
        terms, p_reflect, above = surface.evaluate(*direction)
        everything = 1 / (p_light + p_reflect).mul_(k).clamp_min_(1e-20)
        visible, counted = everything * above, (0, 0, 0, 0)
        if self.shadows:
            luminance = sum(float(share) * c for share, c in zip(LUMINANCE, light, strict=True))
            brightness = surface.brightness(terms, luminance).mul_(visible)
            counted = self._hide(
                points,
                part,
                surface,
                direction,
                (visible, everything),
                above,
                brightness,
                torch.cat([drawn[7], numbers[3]]),
            )
        # Only prefiltered light asks what share of the reflection is visible.
        split = self.mode == "prefiltered"
        for which, weight, kept in (
            (0, visible, terms),
            (4 if split else 6, everything, terms[:3] if split else terms[2:3]),
        ):
            for row, term in enumerate(kept, which):
                weighted = term * weight
                for channel, c in enumerate(light):
                    torch.sum(weighted * c, 0, out=result[row, channel])
        return counted

    def _pixel(self, x, y, z):
        """Environment.pixel_of in float32."""
        import torch

        height, width = self.environment.image.shape[:2]
        row = (torch.acos(y.clamp(-1, 1)) * (height / math.pi)).long().clamp_max(height - 1)
        column = ((torch.atan2(z, x) * (0.5 / math.pi) + 0.5) * width).long().clamp(0, width - 1)
        return row * width + column

    def _hide(
        self, points: Points, part: slice, surface: Surface, direction, weights, above, brightness, dice
    ) -> tuple[int, int, int, int]:
        """Take the first of two weights (m, n) from directions that something hides; how many shadow rays that took,
        and how many directions needed none: below the horizon, on convex objects, and for bringing too little light.

        A direction that brings less than RARE of what its point's directions do on average is followed only with the
        probability brightness / (RARE of that), and counts for as many more (Russian roulette): the mean stays what it
        is. Both weights tell so, and where nothing is hidden they stay the same."""
        import torch

        ask = above
        inner = self.renderer.may_be_hidden(points.position[part], surface.geometric.T.numpy())
        if inner is not None:
            ask = above & torch.from_numpy(inner)
        chance = (brightness / (RARE * brightness.mean(0)).clamp_min(1e-20)).clamp_max_(1)
        follow = ask & (dice < chance)
        times = torch.where(ask, torch.where(follow, chance.clamp_min_(1e-20).reciprocal_(), 0.0), 1.0)
        for weight in weights:
            weight *= times
        flat = follow.reshape(-1).nonzero()[:, 0]
        n = above.shape[1]
        origins = surface.lifted(points.position[part], 2e-4 * self.renderer.extent).index_select(1, flat % n)
        rays = torch.stack([c.reshape(-1).index_select(0, flat) for c in direction])
        weights[0].view(-1)[flat[torch.from_numpy(self.renderer.occluded(origins.numpy().T, rays.numpy().T))]] = 0.0
        lit, asked = int(above.sum()), int(ask.sum())
        return len(flat), above.numel() - lit, lit - asked, asked - len(flat)

    def _combined(self, points: Points, sums: np.ndarray) -> np.ndarray:
        """(3, n) radiance without emission."""
        if not len(points):
            return np.empty((3, 0), np.float32)
        import torch

        from gdtool.shading.bsdf.closed_form import disney_mean, fresnel_loss

        values, sums = points.values, torch.from_numpy(sums)
        albedo, metallic, f0, f90 = (
            rows_of(values["albedo"]),
            *(tensor_of(values[name]) for name in ("metallic", "f0", "f90")),
        )
        f0 = f0 * (1 - metallic) + albedo * metallic
        # How much reflection grows toward grazing: to 1, or to what KHR_materials_specular leaves of a dielectric's.
        growth = f90 * (1 - metallic) + metallic - f0
        reflect = [f0 * sums[i] + growth * sums[i + 1] for i in (0, 4, 7)]
        diffuse = [sums[i] for i in (2, 6, 9)]
        starts = np.flatnonzero(np.diff(points.pixel, prepend=-1))

        def share(known: list) -> torch.Tensor:
            return torch.from_numpy(
                np.repeat(_share(*(x.numpy() for x in known), starts), np.diff(starts, append=len(points)))
            )

        if self.mode == "prefiltered":
            seen = [1.0, 1.0] if not self.samples else [share(x) for x in (reflect, diffuse)]
            n_v, roughness = (rows_of(values["normal"]) * rows_of(points.view)).sum(0), tensor_of(values["roughness"])
            factor = (
                1 - f0 - growth * fresnel_loss(n_v) if self.brdf == "gltf" else disney_mean(roughness, n_v.clamp(0, 1))
            )
            specular, received = reflect[2] * seen[0], diffuse[2] * seen[1] * factor
        else:
            specular, received = reflect[0], diffuse[0]
            if self.brdf == "gltf":
                if self.known:
                    received = received + share(diffuse) * (diffuse[2] - diffuse[1])
                received = (1 - f0) * received - growth * sums[3]
        return (specular + (albedo * (1 - metallic) * received).clamp_min_(0)).numpy()


def _share(visible: np.ndarray, everything: np.ndarray, known: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(m,) visible share of light in each run of points (3, n) that begins at starts (m,)."""
    r, g, b = LUMINANCE.astype(np.float32)
    v, u, k = (np.add.reduceat(r * x[0] + g * x[1] + b * x[2], starts) for x in (visible, everything, known))
    return np.clip((v + PRIOR * k) / np.maximum(u + PRIOR * k, np.float32(1e-20)), 0, 1)


def _scrambled(index: np.ndarray, seed: int) -> np.ndarray:
    """Well-mixed non-negative integers from (n,) indices: the finaliser of SplitMix64 (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        x = index.astype(np.uint64) + np.uint64((seed * 0x9E3779B97F4A7C15) % 2**64)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return ((x ^ (x >> np.uint64(31))) >> np.uint64(1)).astype(np.int64)
