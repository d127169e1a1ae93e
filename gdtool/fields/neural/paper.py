"""Run the paper's method around its networks: initial distances, rays, the extracted mesh and the saved files."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, rays
from gdtool.geometry.grids import band_cells, extract_surface, fine_points, grid_over
from gdtool.geometry.meshes import TriMesh

# World units around the first geometry in which a ray looks for the surface, and its samples there: by whether depth
# shaped it (the views' own, or what their normals gave), or only silhouettes did.
_MEASURED, _BOUNDED = (0.03, 24), (0.08, 64)
POOL = 150_000  # points with known distances that the SDF network is fitted to
START_SHARE = 0.33  # most of the budget that fitting known distances may take
HALF_SHARE = 0.6  # share of that fit that runs in bfloat16
_RIM = 16  # pixels beside the silhouette whose rays must miss


@dataclass(frozen=True)
class PaperOptions:
    """Set the length and the variant of a fit.

    The steps are of the three phases. rule: "median" or "secant". budget: seconds, 0 for no limit. precision:
    "bfloat16" applies to the networks' layers while distances are first fitted.
    """

    distance_steps: int = 400
    volume_steps: int = 0
    surface_steps: int = 300
    batch: int = 512
    rule: str = "secant"
    brdf: str = "gltf"
    seed: int = 0
    budget: float = 0.0
    device: str = "cpu"
    precision: str = "float32"


def distance_pool(mesh: TriMesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (count, 3) and their signed distances (count,) to a closed mesh: three quarters near it, the rest
    in the box.
    """
    from gdtool.geometry.distance import closest_points, sample_surface, winding_number

    near = sample_surface(mesh, count * 3 // 4, rng)[0]
    spread = np.repeat([0.004, 0.015, 0.06], -(-len(near) // 3))[: len(near), None]
    points = np.concatenate(
        [near + spread * rng.standard_normal(near.shape), rng.uniform(-0.6, 0.6, (count - len(near), 3))]
    )
    distance = closest_points(points, mesh)[0]
    inside = winding_number(points, mesh) > 0.5
    order = rng.permutation(len(points))
    return points[order], np.where(inside, -distance, distance)[order]


def gather_pixels(
    cameras: list[Camera],
    mask: np.ndarray,
    images: dict[str, np.ndarray],
    mesh: TriMesh,
    device: str,
    reach: float,
):
    """Collect the rays of pixels fully inside the silhouettes, or outside but close to them, as `fit.Pixels`."""
    vertices = mesh.vertices
    import torch
    from scipy.ndimage import distance_transform_edt

    from gdtool.fields.neural.fit import Pixels
    from gdtool.geometry.rays import RayCaster

    caster = RayCaster(mesh)
    radius = float(np.linalg.norm(vertices, axis=1).max()) + 0.02
    parts: dict[str, list[np.ndarray]] = {}
    for k, camera in enumerate(cameras):
        inside = mask[k] > 0.99
        if not inside.any():
            continue
        outside = (mask[k] < 0.01) & (distance_transform_edt(mask[k] < 0.5) < _RIM)
        chosen = inside | outside
        origins, directions = (x[chosen] for x in rays(camera))
        hit = caster.first_hit(origins, directions)
        middle = -(origins * directions).sum(1)
        half = np.sqrt(np.maximum(radius**2 - ((origins + middle[:, None] * directions) ** 2).sum(1), 1e-4))
        hits = (hit.face_idx >= 0) & inside[chosen]
        distance_along = np.where(hits, hit.distance, 0.0)
        distance_along[~hits] = closest_approach(
            origins[~hits], directions[~hits], (middle - half)[~hits], (middle + half)[~hits], vertices
        )
        # A ray that has to miss passes the surface at some distance: a wider part of it is watched.
        around = np.where(hits, reach, max(2 * reach, 0.06))
        near, far = distance_along - around, distance_along + around
        row = {"origins": origins, "directions": directions, "inside": inside[chosen], "near": near, "far": far}
        for name, stack in images.items():
            value = stack[k][chosen]
            # Depth runs along the viewing axis, t along the ray.
            row[name] = value / -(directions @ camera.backward) if name == "depth" else value
        for name, value in row.items():
            parts.setdefault(name, []).append(np.asarray(value))
    joined = {
        name: torch.as_tensor(
            np.concatenate(value), device=device, dtype=torch.bool if name == "inside" else torch.float32
        )
        for name, value in parts.items()
    }
    fixed = ("origins", "directions", "inside", "near", "far")
    return Pixels(*(joined[name] for name in fixed), {n: v for n, v in joined.items() if n not in fixed})


def closest_approach(
    origins: np.ndarray,
    directions: np.ndarray,
    near: np.ndarray,
    far: np.ndarray,
    vertices: np.ndarray,
    samples: int = 32,
) -> np.ndarray:
    """Find where rays (n, 3) pass nearest to a vertex, among `samples` points between near and far (n,); distances
    (n,).
    """
    from scipy.spatial import cKDTree

    share = (np.arange(samples) + 0.5) / samples
    along = near[:, None] + (far - near)[:, None] * share
    points = origins[:, None] + along[..., None] * directions[:, None]
    distance = cKDTree(vertices[::4]).query(points.reshape(-1, 3), workers=-1)[0].reshape(along.shape)
    return np.take_along_axis(along, distance.argmin(1)[:, None], 1)[:, 0]


def evaluate_sdf(sdf, points: np.ndarray, device: str, chunk: int = 1 << 17) -> np.ndarray:
    """Evaluate the network's distances (n,) float32 at points (n, 3), in chunks."""
    import torch

    out = np.empty(len(points), np.float32)
    with torch.no_grad():
        for start in range(0, len(points), chunk):
            part = torch.as_tensor(points[start : start + chunk], dtype=torch.float32, device=device)
            out[start : start + chunk] = sdf(part).cpu().numpy()
    return out


def extract_network(sdf, step: float, device: str) -> TriMesh:
    """Extract the closed mesh of the network's zero set in the box, sampled every step where a coarse pass finds it."""
    factor = 4
    grid = grid_over(np.full(3, -0.56), np.full(3, 0.56), step, margin=2, multiple=factor)
    coarse_shape = tuple((n - 1) // factor + 1 for n in grid.shape)
    index = np.stack(np.meshgrid(*(np.arange(n) * factor for n in coarse_shape), indexing="ij"), -1).reshape(-1, 3)
    coarse = evaluate_sdf(sdf, grid.points(index), device).reshape(coarse_shape)
    close = np.abs(coarse) < factor * step
    cells = band_cells(coarse < 0, close[:-1, :-1, :-1] & close[1:, 1:, 1:])
    fine = fine_points(cells, factor)
    values = coarse
    for axis in range(3):
        values = np.repeat(values, factor, axis)
    values = np.ascontiguousarray(
        np.where(values < 0, -step, step)[: grid.shape[0], : grid.shape[1], : grid.shape[2]], np.float32
    )
    values[fine] = evaluate_sdf(sdf, grid.points(np.argwhere(fine)), device)
    return extract_surface(values, grid)


def network_materials(material, points: np.ndarray, device: str) -> dict[str, np.ndarray]:
    """Evaluate albedo (n, 3), roughness (n, 1) and metallic (n, 1) of the material network at points (n, 3)."""
    import torch

    out = []
    with torch.no_grad():
        for start in range(0, len(points), 1 << 17):
            out.append(
                material(torch.as_tensor(points[start : start + (1 << 17)], dtype=torch.float32, device=device))
                .cpu()
                .numpy()
            )
    value = np.concatenate(out)
    return {"albedo": value[:, :3], "roughness": value[:, 3:4], "metallic": value[:, 4:5]}


def fit_networks(
    cameras: list[Camera],
    mask: np.ndarray,
    images: dict[str, np.ndarray],
    mesh: TriMesh,
    options: PaperOptions,
    track: Callable,
):
    """Fit both networks to the views, starting from a closed mesh. track(count, label) iterates with progress.

    Returns the Fit and a dict of figures (errors, steps done).
    """
    import torch

    from gdtool.fields.neural.fit import Schedule, fit_distances, start, train

    rng = np.random.default_rng(options.seed)
    began = time.monotonic()
    fit = start(options.seed, options.device)
    pool = distance_pool(mesh, POOL, rng)
    points, distances = (torch.as_tensor(x, dtype=torch.float32, device=options.device) for x in pool)

    def sample(n: int):
        """Draw n points and distances of the pool."""
        pick = torch.as_tensor(rng.integers(0, len(points), n), device=options.device)
        return points[pick], distances[pick]

    def spent(share: float) -> float:
        """Return how much of this share of the budget is gone."""
        return (time.monotonic() - began) / (share * options.budget) if options.budget else 0.0

    error = fit_distances(
        fit,
        sample,
        options.distance_steps,
        4096,
        track,
        lambda: spent(START_SHARE),
        HALF_SHARE if options.precision == "bfloat16" else 0.0,
    )
    reach, samples = _MEASURED if "depth" in images else _BOUNDED
    pixels = gather_pixels(cameras, mask, images, mesh, options.device, reach)
    done = train(
        fit,
        pixels,
        Schedule(
            volume_steps=options.volume_steps,
            surface_steps=options.surface_steps,
            batch=options.batch,
            seed=options.seed,
            rule=options.rule,
            brdf=options.brdf,
            samples=samples,
        ),
        track=track,
        spent=lambda: spent(1.0),
    )
    figures = {"distance_error": error, "steps": done}
    if fit.history:
        figures |= {f"loss_{name}": value for name, value in fit.history[-1].items() if name != "step"}
    return fit, figures


def light_record(fit) -> dict:
    """Convert the fitted light to a record of light.json."""
    lights = fit.lights()
    return {
        "kind": "spherical_gaussians",
        "axes": lights.axes.tolist(),
        "sharpness": lights.sharpness.tolist(),
        "amplitudes": lights.amplitudes.detach().cpu().tolist(),
    }


def save_field(path, fit) -> None:
    """Write both networks to one safetensors file: names "sdf.…" and "material.…", float32."""
    from safetensors.torch import save_file

    tensors = {f"sdf.{k}": v for k, v in fit.sdf.state_dict().items()} | {
        f"material.{k}": v for k, v in fit.material.state_dict().items()
    }
    save_file(
        {name: value.detach().cpu().contiguous() for name, value in tensors.items()},
        str(path),
        {"encoding": "10 frequencies of pi", "skip": "4"},
    )
