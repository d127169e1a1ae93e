"""Evaluate and sample the reflection of many surface points, in several directions each.

The vectors of pairs of point and direction are three tensors, one for each component, so that sums run over numbers
that are adjacent in memory.
"""

from __future__ import annotations

import math

import numpy as np

from gdtool.shading.lights.environment import LUMINANCE
from gdtool.shading.sampling import orthonormal_basis

# The least share of directions that are drawn from the specular lobe; some are needed to keep weights bounded.
MIN_SPECULAR_SHARE = 0.1
# The least n·v that is shaded. Normal maps may turn a normal away from the eye: such points are shaded as grazing.
MIN_VIEW_COSINE = 0.02


def tensor_of(x: np.ndarray):
    """Convert an array to a contiguous float32 tensor."""
    import torch

    return torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)


def rows_of(x: np.ndarray, part: slice = slice(None)):
    """Convert the vectors x[part] of an array (m, c) to a float32 tensor (c, n), one row for each component."""
    return tensor_of(x.T[:, part])


class PointReflection:
    """Evaluate and sample the reflection of n points toward the eye, in k directions each.

    Directions are three (k, n) tensors, one for each component.

    Args:
        toward: (m, 3) unit directions to the eye.
        values: attributes of the m points, as SurfaceLookup.attributes returns them.
        part: slice that selects the n points among the m.
        brdf: "gltf" or "paper" (see brdf.Brdf).
    """

    def __init__(self, toward: np.ndarray, values: dict[str, np.ndarray], part: slice, brdf: str):
        from gdtool.shading.bsdf.brdf import alpha_of

        self.brdf = brdf
        self.normal, self.view, self.geometric = (
            rows_of(x, part) for x in (values["normal"], toward, values["geometric_normal"])
        )
        self.albedo, self.metallic, self.roughness = (
            rows_of(values["albedo"], part),
            tensor_of(values["metallic"][part]),
            tensor_of(values["roughness"][part]),
        )
        # As brdf.f0_of.
        self.f0 = tensor_of(values["f0"][part]) * (1 - self.metallic) + self.albedo * self.metallic
        self.alpha = alpha_of(self.roughness)
        self.n_v_exact = (self.normal * self.view).sum(0)
        self.n_v = self.n_v_exact.clamp_min(MIN_VIEW_COSINE)
        strongest = self.f0.amax(0)
        reflect = strongest + (1 - strongest) * (1 - self.n_v) ** 5
        diffuse = self.albedo.amax(0) * (1 - self.metallic)
        self.share = (reflect / (reflect + diffuse).clamp_min(1e-6)).clamp(MIN_SPECULAR_SHARE, 1.0)

    def offset_origins(self, position: np.ndarray, offset: float):
        """Move positions (n, 3) along the geometric normal, to start shadow rays from: a (3, n) tensor.

        offset: distance in world units.
        """
        import torch

        return torch.from_numpy((position.T + np.float32(offset) * self.geometric.numpy()).astype(np.float32))

    def brightness(self, terms, luminance):
        """Estimate the luminance (k, n) that is reflected of light with a luminance (k, n).

        terms: the first result of evaluate().
        """
        import torch

        weights = torch.from_numpy(LUMINANCE.astype(np.float32))
        f0, diffuse = weights @ self.f0, weights @ self.albedo * (1 - self.metallic)
        return luminance * (f0 * terms[0] + (1 - f0) * terms[1] + diffuse * terms[2])

    def evaluate(self, x, y, z):
        """Evaluate the reflection of light from directions (x, y, z), three (k, n) tensors.

        Returns:
            Four (k, n) terms: D V c, D V c w, d c / π and d c w / π. D is the normal distribution, V the visibility
                term, c = n·l, w = (1 − v·h)^5 Schlick's Fresnel weight, and d the factor of the diffuse model.
            The density (k, n), per steradian, with which sample() draws the direction.
            Whether the direction (k, n) lies above the horizons of both the shading and the geometric normal.
        """
        from gdtool.shading.bsdf.brdf import disney_diffuse, ndf, visibility_gltf, visibility_paper

        nx, ny, nz = self.normal
        vx, vy, vz = self.view
        gx, gy, gz = self.geometric
        n_l = nx * x + ny * y + nz * z
        l_v = vx * x + vy * y + vz * z
        above = (n_l > 0) & (gx * x + gy * y + gz * z > 0)
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
        """Draw directions, three (k, n) tensors, from uniform numbers u, v and pick (k, n) in [0, 1).

        Where pick is below the share of the specular lobe, the view is mirrored at a random visible normal (spherical
        caps, Dupuy & Benyoub 2023). Elsewhere the direction has a cosine-weighted density.
        """
        import torch

        (tx, ty, tz), (bx, by, bz) = orthonormal_basis(*self.normal)
        (nx, ny, nz), (vx, vy, vz) = self.normal, self.view
        a = self.alpha
        ex, ey = tx * vx + ty * vy + tz * vz, bx * vx + by * vy + bz * vz
        length = (ex * ex + ey * ey + self.n_v * self.n_v).rsqrt()
        ex, ey, ez = ex * length, ey * length, self.n_v * length
        # The view in the space where the GGX lobe is a hemisphere, then a point of the cap of its visible normals.
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
