"""Average an environment in advance: over solid angles, over the hemisphere, and over reflection lobes.

Images of directions use the equal-area octahedral map (Clarberg 2008, "Fast equal-area mapping of the (hemi)sphere
using SIMD"), with +Y in the middle. Every texel has the same solid angle, so halving an image averages exactly.
"""

from __future__ import annotations

import math
import threading
import time
from typing import NamedTuple

import numpy as np

from gdtool.shading.lights.environment import Environment


class RoughnessLevel(NamedTuple):
    """Describe a prefiltered image of the light for one roughness.

    side: of the image in texels; broad lobes vary slowly and need few. light_side: texels a side of the light's image
    over which the lobe is summed; 0 draws samples from the lobe instead.
    """

    roughness: float
    side: int
    light_side: int


ROUGHNESS_LEVELS = (
    RoughnessLevel(0.08, 256, 0),
    RoughnessLevel(0.14, 128, 0),
    RoughnessLevel(0.2, 128, 0),
    RoughnessLevel(0.3, 64, 64),
    RoughnessLevel(0.4, 32, 64),
    RoughnessLevel(0.5, 32, 32),
    RoughnessLevel(0.62, 32, 32),
    RoughnessLevel(0.78, 32, 32),
    RoughnessLevel(1.0, 32, 32),
)
# Half vectors drawn from a lobe, where it is sampled.
LOBE_SAMPLES = 64
# Normals of one matrix product, few enough that intermediate matrices stay in the cache.
NORMALS_AT_ONCE = 64
# Rows and columns of lobe_table().
TABLE_SIDE = 32


def octahedral(x, y, z):
    """Map unit directions (tensors of any shape) to image coordinates (s, t) in [0, 1], octahedral and equal-area."""
    import torch

    r = (1 - y.abs()).clamp_min(0).sqrt()
    v = r * (torch.atan2(z.abs(), x.abs()) * (2 / math.pi))
    u = r - v
    below = y < 0
    u, v = torch.where(below, 1 - v, u), torch.where(below, 1 - u, v)
    return 0.5 + 0.5 * torch.where(x < 0, -u, u), 0.5 + 0.5 * torch.where(z < 0, -v, v)


def octahedral_directions(side: int) -> np.ndarray:
    """List the unit directions (side * side, 3) of the texels' centres, row by row."""
    t, s = np.meshgrid((np.arange(side) + 0.5) / side * 2 - 1, (np.arange(side) + 0.5) / side * 2 - 1, indexing="ij")
    a, b = np.abs(s), np.abs(t)
    d = 1 - a - b
    r = 1 - np.abs(d)
    phi = np.where(r > 0, ((b - a) / np.where(r > 0, r, 1) + 1) * (np.pi / 4), 0)
    ring = r * np.sqrt(np.maximum(2 - r * r, 0))
    out = np.stack(
        [np.copysign(ring * np.cos(phi), s), np.copysign(1 - r * r, d), np.copysign(ring * np.sin(phi), t)], -1
    )
    return out.reshape(-1, 3)


class LightPyramid:
    """Hold an environment's mean radiance over solid angles of 1, 4, 16, … texels: a pyramid of octahedral images."""

    def __init__(self, environment: Environment):
        import torch

        height, width = environment.image.shape[:2]
        self.side = 1 << max(0, int(math.log2(math.sqrt(height * width) / 2)))
        x, y, z = (
            torch.as_tensor(np.ascontiguousarray(c), dtype=torch.float32)
            for c in environment.directions.reshape(-1, 3).T
        )
        s, t = octahedral(x, y, z)
        texel = (
            (t * self.side).long().clamp_max(self.side - 1) * self.side
            + (s * self.side).long().clamp_max(self.side - 1)
        ).numpy()
        area = np.repeat(environment.solid_angles, width)
        total = np.bincount(texel, area, self.side**2)
        image = np.stack([np.bincount(texel, area * c, self.side**2) for c in environment.image.reshape(-1, 3).T], 1)
        image = np.where(
            total[:, None] > 0,
            image / np.maximum(total, 1e-30)[:, None],
            environment.radiance(octahedral_directions(self.side)),
        )
        levels = [image.reshape(self.side, self.side, 3)]
        while len(levels[-1]) > 1:
            fine = levels[-1]
            levels.append(0.25 * (fine[0::2, 0::2] + fine[1::2, 0::2] + fine[0::2, 1::2] + fine[1::2, 1::2]))
        self.depth = len(levels)
        self.offsets = torch.tensor(np.concatenate([[0], np.cumsum([x.shape[0] ** 2 for x in levels])[:-1]]))
        self.texels = torch.as_tensor(np.concatenate([x.reshape(-1, 3) for x in levels]).T.copy(), dtype=torch.float32)
        self.texel_angle = 4 * math.pi / self.side**2

    def mean(self, x, y, z, solid_angle):
        """Read the mean radiance (3, k, n) around directions x, y, z (k, n).

        solid_angle (k, 1), in steradians: what to average over. The nearest texel is read, on the coarsest level whose
        texels are no larger than solid_angle.
        """
        level = (0.5 * (solid_angle * (1 / self.texel_angle)).log2()).long().clamp(0, self.depth - 1)
        side = self.side >> level
        s, t = octahedral(x, y, z)
        column = (s * side).long().minimum(side - 1)
        row = (t * side).long().minimum(side - 1)
        return self.texels.index_select(1, (row.mul_(side).add_(column).add_(self.offsets[level])).reshape(-1)).view(
            3, *column.shape
        )


class IrradianceMap:
    """Tabulate an environment's irradiance, ∫ L max(0, n·l) dl, for normals on a lat-long grid."""

    def __init__(self, environment: Environment, height: int = 48):
        import torch

        small = environment.downsampled(64).subdivided(64)
        # The first and last row are the poles: with rows that begin half a step away, they err by 0.7 % under a studio.
        theta = np.arange(height) / (height - 1) * np.pi
        phi = ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5) * 2 * np.pi
        ring = np.sin(theta)[:, None]
        normals = np.stack(
            [ring * np.cos(phi), np.broadcast_to(np.cos(theta)[:, None], (height, 2 * height)), ring * np.sin(phi)], -1
        )
        weighted = torch.as_tensor(
            (small.image * small.solid_angles[:, None, None]).reshape(-1, 3), dtype=torch.float32
        )
        toward = torch.as_tensor(small.directions.reshape(-1, 3).T, dtype=torch.float32)
        parts = torch.as_tensor(normals.reshape(-1, 3), dtype=torch.float32).split(NORMALS_AT_ONCE)
        self.values = (
            torch.cat([(part @ toward).clamp_min_(0) @ weighted for part in parts])
            .numpy()
            .reshape(height, 2 * height, 3)
        )
        # One column more on each side, copied from the opposite side.
        self.wrapped = torch.from_numpy(
            np.concatenate([self.values[:, -1:], self.values, self.values[:, :1]], 1).transpose(2, 0, 1).copy()
        )

    def lookup(self, normals):
        """Interpolate the irradiance (3, n) of unit normals (3, n) bilinearly."""
        import torch

        height, width = self.values.shape[:2]
        nx, ny, nz = normals
        y = torch.acos(ny.clamp(-1, 1)) * ((height - 1) / math.pi)
        x = (torch.atan2(nz, nx) * (0.5 / math.pi) + 0.5) * width + 0.5
        return _bilinear(self.wrapped, y, x)


class Prefiltered:
    """Look up the specular reflection of an environment as a product of two tables.

    The first is the light averaged over the reflection lobe seen along the normal: an image for each of
    ROUGHNESS_LEVELS, made when first needed. The second is the share of light that the lobe reflects, by n·v and
    roughness. This is the split sum of Karis 2013 ("Real shading in Unreal Engine 4"). The first table is read in a
    direction between the mirror direction and the normal, since rough lobes lean that way (Lagarde & de Rousiers 2014,
    "Moving Frostbite to PBR").
    """

    def __init__(self, pyramid: LightPyramid, brdf: str = "gltf"):
        self.pyramid, self.brdf = pyramid, brdf
        self.images: dict[int, object] = {}
        self.seconds = 0.0
        self.locks = [threading.Lock() for _ in ROUGHNESS_LEVELS]
        self.table = lobe_table(brdf)

    def specular(self, normal, view, roughness):
        """Return two (3, n) tensors a, b such that the reflected light is f0 a + (1 − f0) b.

        normal, view (3, n): unit vectors. roughness (n,) in [0, 1].
        """
        import torch

        n_v = (normal * view).sum(0)
        mirror = 2 * n_v * normal - view
        # Under the two lights tried this is nearer to the integral than the mirror direction. The weight of Lagarde &
        # de Rousiers, (1 − r)(√(1 − r) + r), is better from r = 0.3 or 0.5 on, and worse below.
        middle = torch.lerp(normal, mirror, 1 - roughness**2)
        middle = middle / (middle * middle).sum(0).sqrt().clamp_min(1e-12)
        below, above, fraction = _levels(lobe_roughness(roughness, n_v))
        light = torch.zeros(3, normal.shape[1])
        for level in torch.unique(torch.cat([below, above])).tolist():
            weight = torch.where(above == level, fraction, 0.0) + torch.where(below == level, 1 - fraction, 0.0)
            used = (weight > 0).nonzero()[:, 0]
            if len(used):
                light.index_add_(
                    1, used, weight[used] * read_octahedral(self._image(level), *middle.index_select(1, used))
                )
        share = _bilinear(self.table, n_v.clamp(0, 1) * TABLE_SIDE - 0.5, roughness.clamp(0, 1) * TABLE_SIDE - 0.5)
        return light * share[0], light * share[1]

    def prepare(self, roughness: np.ndarray) -> None:
        """Make the prefiltered images that roughness (n,) needs.

        Images that another thread is making at the moment come last, so that threads share the work.
        """
        import torch

        needed = torch.unique(torch.cat(_levels(torch.as_tensor(roughness))[:2])).tolist()
        for level in sorted(needed, key=lambda level: self.locks[level].locked()):
            self._image(level)

    def _image(self, level: int):
        """Return the prefiltered image of a level. The first call makes it; other threads wait for it."""
        with self.locks[level]:
            if level not in self.images:
                started = time.perf_counter()
                self.images[level] = filtered_light(self.pyramid, *ROUGHNESS_LEVELS[level])
                self.seconds += time.perf_counter() - started
        return self.images[level]


def lobe_roughness(roughness, n_v):
    """Convert roughness (n,) seen at cosine n_v (n,) to that of a lobe of equal solid angle, seen along the normal.

    A tilt of the half vector moves the reflected direction by twice the tilt in the plane of view and normal, and by
    n·v times that across the plane. So the lobe's solid angle shrinks by n·v, α by its root, and roughness by its
    fourth root. Measured on a normal-mapped glossy metal under a studio: 28.7 dB inside the outline with it, 26.8
    without.
    """
    return roughness * n_v.clamp(0.05, 1) ** 0.25


def _levels(roughness):
    """Find the indices of the roughness levels below and above roughness (n,), and the fraction (n,) between them.

    Both indices are the same where roughness is exactly a level's.
    """
    import torch

    known = torch.tensor([level.roughness for level in ROUGHNESS_LEVELS])
    inside = roughness.clamp(ROUGHNESS_LEVELS[0].roughness, 1.0).contiguous()
    above = torch.searchsorted(known, inside)
    below = torch.where(known[above] == inside, above, above - 1)
    fraction = (inside - known[below]) / (known[above] - known[below]).clamp_min(1e-6)
    return below, above, fraction


def filtered_light(pyramid: LightPyramid, roughness: float, side: int, light_side: int):
    """Average the light over the GGX lobe seen along its normal, weighted by the cosine, for every normal of an image.

    side: of the image in texels. light_side: see RoughnessLevel. Returns an octahedral image (3, side + 2, side + 2);
    its border repeats the texels across the octahedron's edges, so that bilinear lookups need no special case.
    """
    import torch

    normal = torch.as_tensor(octahedral_directions(side), dtype=torch.float32)
    a2 = roughness**4
    image = (
        _sum_all_texels(pyramid, normal, a2, light_side) if light_side else _sum_lobe_samples(pyramid, normal, a2)
    ).reshape(side, side, 3)
    # Beyond an edge of the octahedral map, the same edge follows in reverse order.
    rows = torch.cat([image[:1].flip(1), image, image[-1:].flip(1)])
    columns = torch.cat([rows[:, :1].flip(0), rows, rows[:, -1:].flip(0)], 1)
    return columns.permute(2, 0, 1).contiguous()


def _sum_all_texels(pyramid: LightPyramid, normal, a2: float, light_side: int):
    """Average the light for normals (n, 3), weighted by the lobe, over all texels of a level of the pyramid: (n, 3).

    a2: α². light_side: texels a side of the level; the finest level is taken where none is as large.
    """
    import torch

    level = max(0, (pyramid.side // light_side).bit_length() - 1)
    side = pyramid.side >> level
    light = pyramid.texels[:, pyramid.offsets[level] : pyramid.offsets[level] + side * side].T.contiguous()
    toward = torch.as_tensor(octahedral_directions(side), dtype=torch.float32)
    out = []
    for part in normal.split(NORMALS_AT_ONCE):
        cosine = (part @ toward.T).clamp_(0, 1)
        # (n·h)² is (1 + n·l) / 2, so that D's bracket is (1 + a2)/2 − (1 − a2)/2 n·l.
        weight = torch.mul(cosine, -0.5 * (1 - a2)).add_(0.5 * (1 + a2)).square_().reciprocal_().mul_(cosine)
        out.append(weight @ light / weight.sum(1, keepdim=True))
    return torch.cat(out)


def _sum_lobe_samples(pyramid: LightPyramid, normal, a2: float):
    """Average the light for normals (n, 3) over LOBE_SAMPLES directions drawn from the lobe: (n, 3).

    a2: α². The pyramid is read over twice the solid angle that a sample stands for, so that samples overlap (after
    Křivánek & Colbert 2008, "Real-time shading with filtered importance sampling").
    """
    import torch

    from gdtool.shading.sampling import orthonormal_basis

    u = (torch.arange(LOBE_SAMPLES) + 0.5) / LOBE_SAMPLES
    phi = torch.arange(LOBE_SAMPLES) * (math.pi * (3 - math.sqrt(5)))
    cosine = ((1 - u) / (1 + (a2 - 1) * u)).sqrt()
    density = a2 / (math.pi * ((1 - cosine**2) + a2 * cosine**2) ** 2) / 4
    # A half vector at angle θ reflects the normal to 2 θ.
    up, ring = 2 * cosine**2 - 1, 2 * cosine * (1 - cosine**2).clamp_min(0).sqrt()
    weight, angle, ring, up, phi = (
        up.clamp_min(0),
        (2 / (LOBE_SAMPLES * density))[:, None],
        ring[:, None],
        up[:, None],
        phi[:, None],
    )
    out = []
    for part in normal.split(1024):
        n = part.unbind(1)
        tangent, bitangent = orthonormal_basis(*n)
        direction = [
            t * (ring * phi.cos()) + b * (ring * phi.sin()) + c * up
            for t, b, c in zip(tangent, bitangent, n, strict=True)
        ]
        out.append((pyramid.mean(*direction, angle) * weight[:, None]).sum(1).T)
    return torch.cat(out) / weight.sum()


def read_octahedral(image, x, y, z):
    """Interpolate an octahedral image of filtered_light bilinearly at unit directions x, y, z (n,): (3, n)."""
    side = image.shape[1] - 2
    s, t = octahedral(x, y, z)
    return _bilinear(image, t * side + 0.5, s * side + 0.5)


def _bilinear(image, row, column):
    """Interpolate an image (c, h, w) at rows and columns (n,), texel centres at integers, clamped at the border."""
    channels, height, width = image.shape
    row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
    r, c = row.long().clamp_max(height - 2), column.long().clamp_max(width - 2)
    flat = image.reshape(channels, -1)
    at = r * width + c
    fr, fc = row - r, column - c
    upper, lower = (
        flat.index_select(1, at + start).lerp(flat.index_select(1, at + start + 1), fc) for start in (0, width)
    )
    return upper.lerp(lower, fr)


def lobe_table(brdf: str = "gltf", samples: int = 256):
    """Tabulate the share of light that the specular lobe reflects, by n·v and roughness: (2, TABLE_SIDE, TABLE_SIDE).

    The first table is the integral of D V (n·l) over light directions, the second that of D V (n·l) (1 − v·h)^5. Both
    are means over `samples` directions that are drawn from the lobe's visible normals.
    """
    import torch

    from gdtool.shading.bsdf.reflection import PointReflection
    from gdtool.shading.sampling import sobol

    side = (np.arange(TABLE_SIDE) + 0.5) / TABLE_SIDE
    n_v, roughness = (x.ravel() for x in np.meshgrid(side, side, indexing="ij"))
    count = len(n_v)
    view = np.stack([np.sqrt(1 - n_v**2), 0 * n_v, n_v], 1)
    normal = np.tile((0.0, 0.0, 1.0), (count, 1))
    values = {
        "normal": normal,
        "geometric_normal": normal,
        "albedo": np.ones((count, 3)),
        "metallic": np.ones(count),
        "roughness": roughness,
        "f0": np.full(count, 0.04),
    }
    surface = PointReflection(view, values, slice(None), brdf)
    uniform = [torch.as_tensor(u, dtype=torch.float32)[:, None].expand(-1, count) for u in sobol(samples, 2, 7).T]
    direction = surface.sample(*uniform, torch.zeros(samples, count))
    terms, density, above = surface.evaluate(*direction)
    weight = above / density.clamp_min(1e-20)
    # For a metal every sample is a visible normal: the specular share is 1.
    return torch.stack([(terms[0] * weight).mean(0), (terms[1] * weight).mean(0)]).reshape(2, TABLE_SIDE, TABLE_SIDE)
