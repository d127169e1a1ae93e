"""Direct light of an environment with shadows: multiple importance sampling of the light and the reflection, Embree visibility."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gdtool.shading.environment import Environment

if TYPE_CHECKING:
    from gdtool.shading.render import Points, Renderer

# Directions drawn once from the light; each point takes its own run of them.
POOL = 1 << 16
# Point-times-direction pairs shaded at once.
PAIRS = 1 << 19
MIN_SPECULAR_SHARE = 0.1


def sobol(count: int, dimensions: int, seed: int) -> np.ndarray:
    """(count, dimensions) scrambled Sobol points in [0, 1); count a power of two keeps every aligned run stratified."""
    from scipy.stats import qmc

    return np.ascontiguousarray(qmc.Sobol(dimensions, scramble=True, seed=np.random.default_rng(seed)).random(count))


class DirectLight:
    """An estimator of the light that points reflect toward the eye.

    samples: directions a point draws from the light, and as many from its reflection (a quarter of that for the extra
    samples of refined pixels). Each direction is weighted by the
    balance heuristic (Veach 1997): f L cos / (n p_light + n p_reflection).
    """

    def __init__(self, renderer: Renderer, environment: Environment, samples: int, seed: int = 0, brdf: str = "gltf"):
        import torch

        self.renderer, self.environment, self.samples, self.brdf = renderer, environment, max(1, samples), brdf
        self.seed = seed
        directions, radiance, density = environment.sample(sobol(POOL, 2, seed))
        self.pool = tuple(torch.tensor(x, dtype=torch.float32) for x in (directions, radiance, density))
        self.pattern = torch.tensor(sobol(POOL, 3, seed + 1), dtype=torch.float32)
        self.rng = np.random.default_rng([seed, 7])

    def radiance(self, points: Points) -> np.ndarray:
        """(n, 3) linear radiance toward the eye, emission included."""
        out = np.empty((len(points), 3), np.float32)
        k = max(1, self.samples // 4) if points.extra else self.samples
        step = max(1, PAIRS // k)
        for start in range(0, len(points), step):
            part = slice(start, start + step)
            out[part] = self._chunk(points, part, k)
        out += points.values["emissive"]
        unlit = points.values["unlit"]
        out[unlit] = points.values["albedo"][unlit]
        return out

    def _chunk(self, points: Points, part: slice, k: int) -> np.ndarray:
        import torch

        from gdtool.shading.brdf import alpha_of, f0_of

        def tensor(x):
            return torch.as_tensor(np.ascontiguousarray(x[part]), dtype=torch.float32)

        values = points.values
        normal, geometric, view = tensor(values["normal"]), tensor(values["geometric_normal"]), tensor(points.view)
        albedo, roughness, metallic = tensor(values["albedo"]), tensor(values["roughness"]), tensor(values["metallic"])
        n = len(normal)
        runs = torch.from_numpy(self.rng.integers(0, POOL // k, n) * k)
        index = runs[:, None] + torch.arange(k)
        surface = _Surface(normal, view, albedo, roughness, metallic, alpha_of(roughness), f0_of(albedo, metallic, 0.04), self.brdf)

        direction, light, p_light = (x[index] for x in self.pool)
        value, p_reflect, cosine = surface.evaluate(direction)
        weighted = value * light / (k * (p_light + p_reflect))[..., None]
        total = self._visible(points, part, geometric, direction, weighted, cosine)

        direction = surface.sample(self.pattern[index])
        flat = direction.reshape(-1, 3).numpy()
        pixel = torch.from_numpy(self.environment.pixel_of(flat)).reshape(n, k)
        light, p_light = self._image()[0][pixel], self._image()[1][pixel]
        value, p_reflect, cosine = surface.evaluate(direction)
        weighted = value * light / (k * (p_light + p_reflect))[..., None]
        return (total + self._visible(points, part, geometric, direction, weighted, cosine)).numpy()

    def _image(self):
        import torch

        if not hasattr(self, "_tensors"):
            self._tensors = (torch.tensor(self.environment.image.reshape(-1, 3), dtype=torch.float32),
                             torch.tensor(self.environment.pdf.reshape(-1), dtype=torch.float32))
        return self._tensors

    def _visible(self, points: Points, part: slice, geometric, direction, weighted, cosine):
        """Sum (n, 3) over directions (n, k, 3) of the weighted light that nothing blocks."""
        import torch

        above = (cosine > 0) & ((direction * geometric[:, None]).sum(-1) > 0) & (weighted.amax(-1) > 0)
        flat = above.reshape(-1).nonzero()[:, 0]
        counts = self.renderer.counts
        counts.shadow_rays += len(flat)
        counts.shadow_rays_below_horizon += above.numel() - len(flat)
        owner = (flat // direction.shape[1]).numpy()
        offset = 2e-4 * self.renderer.extent
        origins = (points.position[part] + offset * geometric.numpy())[owner]
        free = ~self.renderer.occluded(origins, direction.reshape(-1, 3)[flat].numpy())
        lit = torch.zeros(above.numel(), dtype=torch.float32)
        lit[flat[torch.from_numpy(free)]] = 1.0
        return (weighted * lit.reshape(above.shape)[..., None]).sum(1)


class _Surface:
    """Reflection of n points: evaluated and sampled for k directions each."""

    def __init__(self, normal, view, albedo, roughness, metallic, alpha, f0, brdf):
        self.normal, self.view, self.brdf = normal, view, brdf
        self.albedo, self.roughness, self.metallic, self.alpha, self.f0 = albedo, roughness, metallic, alpha, f0
        # Normal maps may turn a normal away from the eye: shade such points as seen at grazing.
        self.n_v = (normal * view).sum(-1).clamp_min(0.02)
        diffuse = (albedo.amax(-1) * (1 - metallic))
        reflect = f0.amax(-1) + (1 - f0.amax(-1)) * (1 - self.n_v) ** 5
        self.share = (reflect / (reflect + diffuse).clamp_min(1e-6)).clamp(MIN_SPECULAR_SHARE, 1.0)

    def evaluate(self, direction):
        """BRDF times cosine (n, k, 3), density of sample() (n, k), and n·l (n, k)."""
        import math

        from gdtool.shading.brdf import ndf, reflectance
        from gdtool.shading.sg import normalize

        normal = self.normal[:, None]
        n_l = (direction * normal).sum(-1)
        half = normalize(direction + self.view[:, None])
        n_h, v_h = (half * normal).sum(-1), (half * self.view[:, None]).sum(-1).clamp(0, 1)
        n_v, alpha = self.n_v[:, None], self.alpha[:, None]
        diffuse, specular = reflectance(self.brdf, self.albedo[:, None], self.roughness[:, None], self.metallic[:, None],
                                        self.f0[:, None], n_l.clamp(0, 1), n_v, n_h, v_h)
        value = (diffuse + specular) * n_l.clamp_min(0)[..., None]
        # Visible normals (Heitz 2018): p = D G1(v) / (4 n·v), G1 of Smith.
        a2 = alpha * alpha
        g1 = 2 / (1 + ((a2 + (1 - a2) * n_v * n_v).sqrt() / n_v))
        p_specular = ndf(alpha, n_h) * g1 / (4 * n_v)
        density = self.share[:, None] * p_specular + (1 - self.share[:, None]) * n_l.clamp_min(0) / math.pi
        return value, density, n_l

    def sample(self, uniform):
        """Directions (n, k, 3) from uniform (n, k, 3): visible normals mirrored, or cosine-weighted."""
        import math

        import torch

        from gdtool.shading.sg import normalize

        tangent, bitangent = frame(self.normal)
        local_view = torch.stack([(tangent * self.view).sum(-1), (bitangent * self.view).sum(-1), self.n_v], -1)
        local_view = normalize(local_view)[:, None]
        u, v, pick = uniform.unbind(-1)
        phi = 2 * math.pi * v
        # Spherical-cap form of visible normals (Dupuy & Benyoub 2023).
        alpha = self.alpha[:, None]
        stretched = normalize(torch.stack([alpha * local_view[..., 0], alpha * local_view[..., 1], local_view[..., 2]], -1))
        z = (1 - u) * (1 + stretched[..., 2]) - stretched[..., 2]
        ring = (1 - z * z).clamp_min(0).sqrt()
        cap = torch.stack([ring * phi.cos(), ring * phi.sin(), z], -1) + stretched
        micro = normalize(torch.stack([alpha * cap[..., 0], alpha * cap[..., 1], cap[..., 2].clamp_min(1e-6)], -1))
        mirrored = 2 * (micro * local_view).sum(-1, keepdim=True) * micro - local_view
        radius = u.sqrt()
        cosine = torch.stack([radius * phi.cos(), radius * phi.sin(), (1 - u).clamp_min(0).sqrt()], -1)
        local = torch.where((pick < self.share[:, None])[..., None], mirrored, cosine)
        world = local[..., :1] * tangent[:, None] + local[..., 1:2] * bitangent[:, None] + local[..., 2:] * self.normal[:, None]
        return normalize(world)


def frame(normal):
    """Tangent and bitangent (n, 3) of unit normals (Duff et al. 2017)."""
    import torch

    x, y, z = normal.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1), torch.stack([b, sign + y * y * a, -y], -1)
