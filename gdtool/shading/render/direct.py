"""Estimate the direct light of an environment on surface points, with ray-cast shadows.

Directions are drawn from the light and from the reflection, and combined by multiple importance sampling. With
Schlick's Fresnel, F = f0 + (f90 − f0) w, reflected radiance is a linear combination of four sums over the directions,
since only w depends on the direction. So all that is computed for a pair of point and direction is scalar.

Unshadowed diffuse light needs neither rays nor samples: a table has the irradiance. The sampled directions only have to
estimate how much of it is hidden. V is the sum over visible directions, U the sum over all of them, B the table's
value. The estimate is V + β (B − U), a control variate, with β the visible share of U in the pixel. β is near 1 where
little is hidden and 0 where everything is. The estimate is unbiased for any β that does not depend on the noise.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from gdtool.geometry.hashing import splitmix64
from gdtool.shading.bsdf.reflection import PointReflection, rows_of, tensor_of
from gdtool.shading.lights.environment import LUMINANCE, Environment
from gdtool.shading.sampling import sobol

if TYPE_CHECKING:
    import torch

    from gdtool.shading.render.render import Renderer, ShadingPoints

# Directions that are drawn once from the light; each point uses a run of them.
POOL_SIZE = 1 << 16
# Pairs of point and direction that are shaded at once: enough that the cost of the calls is small beside them.
PAIRS_AT_ONCE = 1 << 17
# A direction with at least this share of the mean brightness of its point's directions always gets a shadow ray.
ROULETTE_SHARE = 0.5
# Share of the table's light that is added as visible light, so that pixels with next to none in their samples are lit.
VISIBLE_PRIOR = 0.02

# Rows of a point's sums. Each block has the specular sum, its part with the Fresnel weight w, and the diffuse sum; the
# first has the diffuse sum's part with w as well.
VISIBLE, VISIBLE_DIFFUSE, VISIBLE_DIFFUSE_FRESNEL = 0, 2, 3  # over the directions that nothing hides
ALL, ALL_DIFFUSE = 4, 6  # over all directions
KNOWN, KNOWN_DIFFUSE = 7, 9  # from tables, without directions
SUM_ROWS = 10


@dataclass(frozen=True)
class LightOptions:
    """Set how DirectLight estimates the light.

    mode: "sampled" converges to the exact value with more samples. "prefiltered" takes the reflection from the split
    sum, and only its visible share from samples. shadows: whether rays decide what is visible. control_variate: whether
    unshadowed diffuse light comes from the irradiance table.
    """

    mode: Literal["sampled", "prefiltered"] = "sampled"
    shadows: bool = True
    control_variate: bool = True


class _RayCounts(NamedTuple):
    """Count the shadow rays of a chunk of points: those cast, and those left out, for three reasons.

    below_horizon: the direction is below the horizon. convex: nothing can hide a point of a convex object. rare: the
    direction contributes little light.
    """

    cast: int = 0
    below_horizon: int = 0
    convex: int = 0
    rare: int = 0


class _Candidates(NamedTuple):
    """Hold the k directions of each of n points that may need shadow rays.

    direction: three (k, n) tensors. above (k, n) bool: above the horizon. brightness (k, n): luminance that would be
    reflected without shadows. roulette (k, n): uniform numbers in [0, 1).
    """

    direction: list
    above: torch.Tensor
    brightness: torch.Tensor
    roulette: torch.Tensor


class DirectLight:
    """Estimate the light that surface points reflect toward the eye.

    Args:
        renderer: casts shadow rays in its scene.
        environment: the light.
        samples: directions that a point draws from the light, and as many from its reflection; rounded to a power of
            two. 0 leaves shadows out, in mode "prefiltered" only. Directions are weighted by the balance heuristic
            (Veach 1997): f L cos / (n p_light + n p_reflection).
        seed: of the directions.
        brdf: "gltf" or "paper" (see brdf.Brdf).
        options: how to estimate.
    """

    def __init__(
        self,
        renderer: Renderer,
        environment: Environment,
        samples: int,
        seed: int = 0,
        brdf: str = "gltf",
        options: LightOptions = LightOptions(),
    ):
        from gdtool.shading.lights.prefilter import IrradianceMap, LightPyramid, Prefiltered

        self.renderer, self.environment, self.brdf, self.seed = renderer, environment, brdf, seed
        self.mode, self.shadows, self.control_variate = options.mode, options.shadows, options.control_variate
        # Runs start at multiples of their length, a power of two, so that each is a stratified set.
        self.samples = 1 << round(math.log2(samples)) if samples else 0
        if not self.samples and self.mode == "sampled":
            raise ValueError("sampled light needs samples")
        with ThreadPoolExecutor(renderer.caster.threads) as pool:
            irradiance = pool.submit(IrradianceMap, environment)
            prefiltered = (
                pool.submit(lambda: Prefiltered(LightPyramid(environment), brdf))
                if self.mode == "prefiltered"
                else None
            )
            if self.samples:
                directions, radiance, density = environment.sample(sobol(POOL_SIZE, 2, seed))
                roulette = np.random.default_rng(seed).random(POOL_SIZE)
                # Channels of the light's pool: x, y, z, red, green, blue, density, roulette number; of the
                # reflection's: three numbers for PointReflection.sample, and a roulette number.
                self.pool = self._as_runs(*directions.T, *radiance.T, density, roulette)
                self.pattern = self._as_runs(*sobol(POOL_SIZE, 3, seed + 1).T, roulette)
            self.pixels = tensor_of(
                np.concatenate([environment.image.reshape(-1, 3), environment.pdf.reshape(-1, 1)], 1)
            )
            self.irradiance = irradiance.result()
            self.prefiltered = None if prefiltered is None else prefiltered.result()

    def _as_runs(self, *values: np.ndarray):
        """Cut c arrays (POOL_SIZE,) into runs of k = samples numbers: a tensor (k, c, POOL_SIZE / k)."""
        return tensor_of(np.stack(values).reshape(len(values), -1, self.samples).transpose(2, 0, 1))

    def color(self, exposure: float = 1.0) -> Callable[[ShadingPoints], dict[str, np.ndarray]]:
        """Return the function that Renderer.buffers takes to shade points; it multiplies the radiance by exposure."""
        return lambda points: {"color": self.radiance(points) * np.float32(exposure)}

    def radiance(self, points: ShadingPoints) -> np.ndarray:
        """Estimate the linear radiance (n, 3) of n points toward the eye, emission included."""
        k = self.samples
        step = max(1, PAIRS_AT_ONCE // max(2 * k, 2))
        sums = np.zeros((SUM_ROWS, 3, len(points)), np.float32)
        runs = self._choose_runs(points) if k else None
        if self.mode == "prefiltered" and len(points):
            from gdtool.shading.lights.prefilter import lobe_roughness

            n_v = (rows_of(points.values["normal"]) * rows_of(points.view)).sum(0)
            self.prefiltered.prepare(lobe_roughness(tensor_of(points.values["roughness"]), n_v))

        started, counted = time.perf_counter(), np.zeros(len(_RayCounts._fields), np.int64)
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            counted += self._accumulate(points, part, None if runs is None else runs[:, part], sums[..., part])
        counts = _RayCounts(*counted.tolist())
        self.renderer.counts.spend(
            "directions",
            started,
            shadow_rays=counts.cast,
            shadow_rays_below_horizon=counts.below_horizon,
            shadow_rays_convex=counts.convex,
            shadow_rays_rare=counts.rare,
        )
        out = self._compose(points, sums)
        out += points.values["emissive"].T
        unlit = points.values["unlit"]
        if unlit.any():
            out[:, unlit] = points.values["albedo"].T[:, unlit]
        return out.T

    def _choose_runs(self, points: ShadingPoints) -> np.ndarray:
        """Choose each point's runs of directions in the two pools (of the light, of the reflection): indices (2, n).

        The samples of a pixel use neighbouring runs. Together these form one larger stratified set, and so do the first
        two, four or eight of them. A hash of the pixel's index chooses the block of runs and the first run in it.
        """
        k = self.samples
        block = min(1 << max(0, points.per_pixel - 1).bit_length(), max(1, POOL_SIZE // k // 16))
        out = np.empty((2, len(points)), np.int64)
        for which in (0, 1):
            number = _hash(points.pixel + (points.sample // block) * 0x5851F42D, self.seed * 2 + which)
            out[which] = (number // block) % (POOL_SIZE // k // block) * block + (
                (points.sample % block) ^ (number % block)
            )
        return out

    def _accumulate(self, points: ShadingPoints, part: slice, runs: np.ndarray | None, sums: np.ndarray) -> _RayCounts:
        """Compute the sums (SUM_ROWS, 3, n) of the n points that `part` selects, in place, and count their shadow rays.

        runs: the points' indices from _choose_runs(), or None for no samples.
        """
        import torch

        k = self.samples
        surface = PointReflection(points.view, points.values, part, self.brdf)
        result = torch.from_numpy(sums)
        result[KNOWN_DIFFUSE] = self.irradiance.lookup(surface.normal) / math.pi
        if self.mode == "prefiltered":
            result[KNOWN], result[KNOWN + 1] = self.prefiltered.specular(
                surface.normal, surface.view, surface.roughness
            )
        if not k:
            return _RayCounts()
        from_light, numbers = (
            torch.stack([sample.index_select(1, torch.from_numpy(run)) for sample in pool]).unbind(1)
            for pool, run in zip((self.pool, self.pattern), runs, strict=True)
        )
        from_reflection = surface.sample(*numbers[:3])
        lookup = self.pixels.index_select(0, self._pixel(*from_reflection).reshape(-1)).view(k, -1, 4)
        direction = [torch.cat(pair) for pair in zip(from_light[:3], from_reflection, strict=True)]
        *light, p_light = (torch.cat([from_light[3 + i], lookup[..., i]]) for i in range(4))
        terms, p_reflect, above = surface.evaluate(*direction)
        everything = 1 / (p_light + p_reflect).mul_(k).clamp_min_(1e-20)
        visible, counted = everything * above, _RayCounts()
        if self.shadows:
            luminance = sum(float(share) * c for share, c in zip(LUMINANCE, light, strict=True))
            brightness = surface.brightness(terms, luminance).mul_(visible)
            candidates = _Candidates(direction, above, brightness, torch.cat([from_light[7], numbers[3]]))
            counted = self._apply_shadows(points.position[part], surface, candidates, (visible, everything))
        # Only prefiltered light needs the visible share of the specular reflection.
        split = self.mode == "prefiltered"
        for first_row, weight, used_terms in (
            (VISIBLE, visible, terms),
            (ALL if split else ALL_DIFFUSE, everything, terms[:3] if split else terms[2:3]),
        ):
            for row, term in enumerate(used_terms, first_row):
                weighted = term * weight
                for channel, c in enumerate(light):
                    torch.sum(weighted * c, 0, out=result[row, channel])
        return counted

    def _pixel(self, x, y, z):
        """Find the flat index of the environment's pixels that directions (x, y, z) fall into, in float32."""
        import torch

        height, width = self.environment.image.shape[:2]
        row = (torch.acos(y.clamp(-1, 1)) * (height / math.pi)).long().clamp_max(height - 1)
        column = ((torch.atan2(z, x) * (0.5 / math.pi) + 0.5) * width).long().clamp(0, width - 1)
        return row * width + column

    def _apply_shadows(
        self, position: np.ndarray, surface: PointReflection, candidates: _Candidates, weights: tuple
    ) -> _RayCounts:
        """Cast shadow rays, and set the first of two weights (k, n) to 0 where something hides the light.

        Russian roulette saves rays toward little light. A direction brighter than ROULETTE_SHARE of the mean of its
        point's directions is always followed. A darker one is followed with a probability proportional to its
        brightness. Its weights are then divided by that probability, so that the mean stays the same.
        """
        import torch

        direction, above, brightness, roulette = candidates
        may_be_hidden = above
        hidden_points = self.renderer.may_be_hidden(position, surface.geometric.T.numpy())
        if hidden_points is not None:
            may_be_hidden = above & torch.from_numpy(hidden_points)
        chance = (brightness / (ROULETTE_SHARE * brightness.mean(0)).clamp_min(1e-20)).clamp_max_(1)
        follow = may_be_hidden & (roulette < chance)
        times = torch.where(may_be_hidden, torch.where(follow, chance.clamp_min_(1e-20).reciprocal_(), 0.0), 1.0)
        for weight in weights:
            weight *= times
        flat = follow.reshape(-1).nonzero()[:, 0]
        n = above.shape[1]
        origins = surface.offset_origins(position, 2e-4 * self.renderer.extent).index_select(1, flat % n)
        rays = torch.stack([c.reshape(-1).index_select(0, flat) for c in direction])
        weights[0].view(-1)[flat[torch.from_numpy(self.renderer.occluded(origins.numpy().T, rays.numpy().T))]] = 0.0
        above_count, may_be_hidden_count = int(above.sum()), int(may_be_hidden.sum())
        return _RayCounts(
            len(flat), above.numel() - above_count, above_count - may_be_hidden_count, may_be_hidden_count - len(flat)
        )

    def _compose(self, points: ShadingPoints, sums: np.ndarray) -> np.ndarray:
        """Compose radiance (3, n), without emission, from the points' sums (SUM_ROWS, 3, n)."""
        if not len(points):
            return np.empty((3, 0), np.float32)
        import torch

        from gdtool.shading.bsdf.closed_form import disney_mean, fresnel_loss

        values, totals = points.values, torch.from_numpy(sums)
        albedo, metallic, f0, f90 = (
            rows_of(values["albedo"]),
            *(tensor_of(values[name]) for name in ("metallic", "f0", "f90")),
        )
        f0 = f0 * (1 - metallic) + albedo * metallic
        # How much reflection grows toward grazing: to 1, or to what KHR_materials_specular leaves of a dielectric's.
        growth = f90 * (1 - metallic) + metallic - f0
        reflect = [f0 * totals[i] + growth * totals[i + 1] for i in (VISIBLE, ALL, KNOWN)]
        diffuse = [totals[i] for i in (VISIBLE_DIFFUSE, ALL_DIFFUSE, KNOWN_DIFFUSE)]
        starts = np.flatnonzero(np.diff(points.pixel, prepend=-1))

        def share(known: list) -> torch.Tensor:
            """Repeat each pixel's visible share for its points: (n,). known: visible, all and tabulated sums (3, n)."""
            return torch.from_numpy(
                np.repeat(_visible_share(*(x.numpy() for x in known), starts), np.diff(starts, append=len(points)))
            )

        if self.mode == "prefiltered":
            visible_shares = [1.0, 1.0] if not self.samples else [share(x) for x in (reflect, diffuse)]
            n_v, roughness = (rows_of(values["normal"]) * rows_of(points.view)).sum(0), tensor_of(values["roughness"])
            factor = (
                1 - f0 - growth * fresnel_loss(n_v) if self.brdf == "gltf" else disney_mean(roughness, n_v.clamp(0, 1))
            )
            specular, received = reflect[2] * visible_shares[0], diffuse[2] * visible_shares[1] * factor
        else:
            specular, received = reflect[0], diffuse[0]
            if self.brdf == "gltf":
                if self.control_variate:
                    received = received + share(diffuse) * (diffuse[2] - diffuse[1])
                received = (1 - f0) * received - growth * totals[VISIBLE_DIFFUSE_FRESNEL]
        return (specular + (albedo * (1 - metallic) * received).clamp_min_(0)).numpy()


def _visible_share(visible: np.ndarray, everything: np.ndarray, known: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Estimate the visible share of the light, 0 to 1, for each of m pixels.

    visible, everything, known (3, n): sums over visible directions, over all directions, and from tables, for the
    pixels' points. starts (m,): index of each pixel's first point.
    """
    r, g, b = LUMINANCE.astype(np.float32)
    v, u, k = (np.add.reduceat(r * x[0] + g * x[1] + b * x[2], starts) for x in (visible, everything, known))
    return np.clip((v + VISIBLE_PRIOR * k) / np.maximum(u + VISIBLE_PRIOR * k, np.float32(1e-20)), 0, 1)


def _hash(index: np.ndarray, seed: int) -> np.ndarray:
    """Hash indices (n,) and a seed to non-negative int64 by SplitMix64."""
    with np.errstate(over="ignore"):
        x = splitmix64(index.astype(np.uint64) + np.uint64((seed * 0x9E3779B97F4A7C15) % 2**64))
        return (x >> np.uint64(1)).astype(np.int64)
