"""Errors of baked maps against the model: at the texels, and across the seams of the charts.

The truth of a texel is the model's own material (bilinear in its textures, linear light) and interpolated normal at the
point of its surface nearest to the texel's centre.
"""

from __future__ import annotations

import numpy as np

from benchmarks.bake.cases import Case, read_low
from gdtool.geometry.meshes import TriMesh

# Texels that are scored: a few at creases, where the nearest face is a matter of chance, weigh little among so many.
CHOSEN = 1_000_000
SEAM_POINTS = 20_000


class Truth:
    """A case made ready: its target, and true values at some texels of each size."""

    def __init__(self, case: Case):
        from gdtool.assets.load import load_scene
        from gdtool.bake.inputs import target_of
        from gdtool.shading.render.surface_points import SurfaceLookup

        self.scene = load_scene(case.glb)
        self.target = target_of(read_low(case))[0]
        self._lookup = SurfaceLookup(self.scene)
        self._of: dict[int, dict] = {}
        self._seams: dict[int, Seams] = {}

    def material(self, points: np.ndarray) -> dict[str, np.ndarray]:
        """albedo (n, 3) sRGB, roughness, metallic (n,) and normal (n, 3) of the model nearest to points (n, 3)."""
        from gdtool.geometry.distance import barycentric_of, closest_points
        from gdtool.images.color import srgb_from_linear

        _, near, at = closest_points(points, TriMesh(self.scene.vertices, self.scene.faces))
        read = self._lookup.attributes(near, barycentric_of(at, self.scene.vertices[self.scene.faces[near]]))
        return {**read, "albedo": srgb_from_linear(read["albedo"])}

    def seams(self, size: int) -> Seams:
        """Made once for a size."""
        if size not in self._seams:
            self._seams[size] = Seams(self, size)
        return self._seams[size]

    def at(self, size: int) -> dict[str, np.ndarray]:
        """texel (n,), face_idx (n,), barycentric (n, 3), and albedo (sRGB), roughness, metallic, normal of the model
        there."""
        if size not in self._of:
            from gdtool.bake.target import texels_of

            texels, target = texels_of(self.target, size, rings=0), self.target
            chosen = np.sort(np.random.default_rng(0).choice(texels.inside, min(CHOSEN, texels.inside), replace=False))
            face_idx, barycentric = texels.face_idx[chosen], texels.barycentric[chosen].astype(np.float64)
            points = np.einsum("nk,nkc->nc", barycentric, target.mesh.vertices[target.mesh.faces[face_idx]])
            read = self.material(points)
            # Models whose winding and normals disagree are common: outside is where the mesh that is baked has it.
            side = np.where((read["normal"] * target.normals[face_idx].mean(1)).sum(1) < 0, -1.0, 1.0)
            self._of[size] = {
                "texel": texels.texel[chosen],
                "face_idx": face_idx,
                "barycentric": barycentric,
                "covered": texels.inside / size**2,
                "albedo": read["albedo"],
                "normal": _unit(read["normal"].astype(np.float64)) * side[:, None],
                "roughness": read["roughness"],
                "metallic": read["metallic"],
            }
        return self._of[size]


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio for a range of 1, at most 120."""
    return float(min(-10 * np.log10(max(np.mean((np.asarray(a, np.float64) - b) ** 2), 1e-12)), 120))


def texel_errors(
    truth: Truth, size: int, maps: dict[str, np.ndarray], corners: dict[str, np.ndarray] | None = None
) -> dict[str, float]:
    """Errors of maps albedo (s, s, 3) sRGB, roughness, metallic (s, s) and normal (s, s, 3) as stored, all floats.

    corners: the frames another baker encoded in (corner_normals, corner_tangents (t, 3, 3), corner_signs (t, 3)); ours
    else."""
    true = truth.at(size)
    row, column = np.divmod(true["texel"].astype(np.int64), size)
    read = {name: image[row, column] for name, image in maps.items()}
    if corners is None:
        corners = {
            "corner_normals": truth.target.normals,
            "corner_tangents": truth.target.tangents[..., :3],
            "corner_signs": truth.target.tangents[..., 3],
        }
    normal, tangent = (
        np.einsum("nk,nkc->nc", true["barycentric"], corners[k][true["face_idx"]])
        for k in ("corner_normals", "corner_tangents")
    )
    bitangent = np.cross(normal, tangent) * corners["corner_signs"][true["face_idx"], 0][:, None]
    local = 2.0 * read["normal"] - 1
    world = _unit(local[:, :1] * tangent + local[:, 1:2] * bitangent + local[:, 2:] * normal)
    cosine = (world * true["normal"]).sum(1)
    out = {f"{name} dB": decibels(read[name], true[name]) for name in ("albedo", "roughness", "metallic")}
    out["normal deg"] = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
    # What no ray found is black; so are parts of some models.
    out["missed"] = float(((read["albedo"].max(-1) <= 0) & (true["albedo"].max(-1) > 2 / 255)).mean())
    return out


class Seams:
    """Points to either side of the charts' seams and of other edges, and the model's material there."""

    def __init__(self, truth: Truth, size: int):
        from gdtool.bake.target import texel_width
        from gdtool.geometry.tangents import edge_pairs

        target, rng = truth.target, np.random.default_rng(1)
        one, two = edge_pairs(target.mesh.faces)
        start = [target.uv[target.face_uvs[half // 3, half % 3]] for half in (one, two)]
        end = [target.uv[target.face_uvs[half // 3, (half % 3 + 1) % 3]] for half in (one, two)]
        seam = (np.abs(start[0] - end[1]).max(1) > 1e-9) | (np.abs(end[0] - start[1]).max(1) > 1e-9)
        self.sides = []
        for chosen in (np.flatnonzero(seam), np.flatnonzero(~seam)):
            if not len(chosen):
                self.sides = []
                break
            pick, along = rng.choice(chosen, SEAM_POINTS), rng.uniform(0.1, 0.9, SEAM_POINTS)
            pair = [
                _beside(target, half[pick], t, texel_width(target, size))
                for half, t in ((one, along), (two, 1 - along))
            ]
            read = [truth.material(points) for _, points in pair]
            self.sides.append(
                (
                    [uv for uv, _ in pair],
                    {name: np.abs(read[0][name] - read[1][name]).mean() for name in ("albedo", "roughness")},
                )
            )

    def ratio(self, name: str, image: np.ndarray) -> float | None:
        """How much more the two sides of seams differ in the map (s, s, c) than in the model, over the same for other
        edges.

        Where other edges differ less than in the model (of surfaces that lie in one another its nearest is a matter of
        chance) the seams are held against the model. The map is read bilinearly a texel to either side. Creases and
        parts' borders, where charts like to end, are steps of the model: its own difference at the same points is what
        is divided by. None where there are no seams."""
        if not self.sides:
            return None
        step = 0.5 / 255
        more = [
            (np.abs(bilinear(image, uv[0]) - bilinear(image, uv[1])).mean() + step) / (true[name] + step)
            for uv, true in self.sides
        ]
        return float(more[0] / max(more[1], 1.0))


def _beside(target, half: np.ndarray, along: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (n, 2) and positions (n, 3) `width` inside the triangles of half-edges (n,), `along` (n,) the
    edge."""
    face, k = half // 3, half % 3
    corners = target.mesh.vertices[target.mesh.faces[face]]
    at = np.arange(len(face))
    a, b, c = (corners[at, (k + i) % 3] for i in range(3))
    length = np.maximum(np.linalg.norm(b - a, axis=1), 1e-12)
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / length
    inward = np.minimum(width / np.maximum(height, 1e-12), 0.5)
    weight = np.zeros((len(face), 3))
    weight[at, k], weight[at, (k + 1) % 3], weight[at, (k + 2) % 3] = (
        (1 - along) * (1 - inward),
        along * (1 - inward),
        inward,
    )
    return np.einsum("nk,nkc->nc", weight, target.uv[target.face_uvs[face]]), np.einsum("nk,nkc->nc", weight, corners)


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(n, c) of image (s, s, c) between texel centres at uv (n, 2)."""
    size = image.shape[0]
    x, y = np.clip(uv * size - 0.5, 0, size - 1.001).T
    column, row = x.astype(int), y.astype(int)
    fx, fy = (x - column)[:, None], (y - row)[:, None]
    upper = image[row, column] * (1 - fx) + image[row, column + 1] * fx
    lower = image[row + 1, column] * (1 - fx) + image[row + 1, column + 1] * fx
    return upper * (1 - fy) + lower * fy


def scored(
    truth: Truth, maps: dict[str, np.ndarray], corners: dict[str, np.ndarray] | None = None
) -> dict[str, float | None]:
    """Errors before and after 8 bits, and across seams, of maps (linear albedo (s, s, 3), roughness, metallic, normal
    as stored)."""
    from gdtool.images.color import srgb_from_linear

    size = maps["albedo"].shape[0]
    before = {**maps, "albedo": srgb_from_linear(np.clip(maps["albedo"], 0, 1))}
    after = {name: np.rint(np.clip(image, 0, 1) * np.float32(255)) / np.float32(255) for name, image in before.items()}
    stored = texel_errors(truth, size, after, corners)
    out: dict[str, float | None] = texel_errors(truth, size, before, corners)
    out |= {f"8-bit {name}": stored[name] for name in ("albedo dB", "roughness dB", "normal deg")}
    out["seam albedo"] = truth.seams(size).ratio("albedo", after["albedo"])
    out["seam roughness"] = truth.seams(size).ratio("roughness", after["roughness"][..., None])
    return out
