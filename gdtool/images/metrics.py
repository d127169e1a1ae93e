"""Measure pictures against reference pictures by the "published" and the "masked" protocol (docs/metrics.md)."""

from __future__ import annotations

import numpy as np

from gdtool.images.color import srgb_from_linear

PUBLISHED_SIZE = 256  # pixels: side of the pictures in published tables
PSNR_MAX = 100.0  # dB, of equal pictures; JSON has no infinity
FULL = 0.99  # coverage from which a pixel lies wholly on the object
_C1, _C2 = 0.01, 0.03  # constants K1 and K2 of Wang et al. 2004


def psnr(image: np.ndarray, reference: np.ndarray, where: np.ndarray | None = None) -> float:
    """Compute the peak signal-to-noise ratio in dB for a range of 1, at most 100.

    where (h, w) bool: the pixels that count; all without it.
    """
    squared = (np.asarray(image, np.float64) - reference) ** 2
    error = float(squared.mean() if where is None else squared[where].mean())
    return float(min(-10 * np.log10(max(error, 1e-30)), PSNR_MAX))


def ssim(image: np.ndarray, reference: np.ndarray, where: np.ndarray | None = None) -> float:
    """Compute the structural similarity for a range of 1, mean over pixels and channels.

    The window is a Gaussian of 1.5 pixels (Wang et al. 2004). where (h, w) bool: the pixels that count; their windows
    still reach outside.
    """
    from skimage.metrics import structural_similarity

    _, values = structural_similarity(
        np.asarray(image, np.float64),
        np.asarray(reference, np.float64),
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        K1=_C1,
        K2=_C2,
        full=True,
        channel_axis=-1 if np.ndim(image) == 3 else None,
    )
    if where is not None:
        return float(values[where].mean())
    edge = 5  # half the window: there it would see beyond the picture
    return float(values[edge:-edge, edge:-edge].mean())


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize (h, w[, c]) by the average over each new pixel's area; returns the same array where the size fits."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[0] % height == 0 and image.shape[1] % width == 0:
        rows, columns = image.shape[0] // height, image.shape[1] // width
        return image.reshape(height, rows, width, columns, *image.shape[2:]).mean((1, 3))
    from skimage.transform import resize

    return resize(np.asarray(image, np.float64), (height, width), order=1, anti_aliasing=True, mode="edge")


def resized_views(
    images: dict[str, np.ndarray], mask: np.ndarray, height: int, width: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Resize Views.images and Views.mask by averages over the covered part of each new pixel.

    Normals are made unit again.
    """
    if mask.shape[1:] == (height, width):
        return images, mask
    small = np.stack([resized(coverage, height, width) for coverage in mask])
    out = {}
    for domain, stack in images.items():
        weight = (mask[..., None], small[..., None]) if stack.ndim == 4 else (mask, small)
        mean = np.stack([resized(image, height, width) for image in stack * weight[0]]) / np.maximum(weight[1], 1e-6)
        if domain == "normal":
            mean = mean / np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
        out[domain] = np.where(weight[1] > 0, mean, 0).astype(np.float32)
    return out, small.astype(np.float32)


def over_white(linear: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Composite linear straight color (h, w, 3) with coverage (h, w) over white; returns sRGB (h, w, 3).

    The sum is formed in sRGB, as viewers do.
    """
    return np.clip(srgb_from_linear(linear), 0, 1) * mask[..., None] + (1 - mask[..., None])


def color_metrics(
    color: np.ndarray, mask: np.ndarray, true_color: np.ndarray, true_mask: np.ndarray
) -> dict[str, float]:
    """Compute PSNR and SSIM of k pictures, as the mean of each one's figure.

    Colors are (k, h, w, 3) linear, coverages (k, h, w). *_published: over white, full frame, at 256^2. *_masked: in
    sRGB over the pixels that lie wholly on the reference's object, at the pictures' size; a result that is transparent
    there counts as black.
    """
    out: dict[str, list[float]] = {
        name: [] for name in ("psnr_published", "ssim_published", "psnr_masked", "ssim_masked")
    }
    for a, m, b, n in zip(color, mask, true_color, true_mask, strict=True):
        small, true_small = (resized(over_white(x, y), PUBLISHED_SIZE, PUBLISHED_SIZE) for x, y in ((a, m), (b, n)))
        out["psnr_published"].append(psnr(small, true_small))
        out["ssim_published"].append(ssim(small, true_small))
        where = n > FULL
        if where.any():
            a, b = (np.clip(srgb_from_linear(x), 0, 1) for x in (a, b))
            a, b = a * (m > 0)[..., None], b * (n > 0)[..., None]
            out["psnr_masked"].append(psnr(a, b, where))
            out["ssim_masked"].append(ssim(a, b, where))
    return {name: float(np.mean(values)) for name, values in out.items() if values}


def scalar_error(values: np.ndarray, true_values: np.ndarray, true_mask: np.ndarray) -> float:
    """Compute the mean absolute error over the pixels wholly on the reference's object; (k, h, w) each."""
    where = true_mask > FULL
    return float(np.abs(np.asarray(values, np.float64) - true_values)[where].mean()) if where.any() else float("nan")


def on_both_objects(mask: np.ndarray, true_mask: np.ndarray) -> np.ndarray:
    """Find the pixels wholly on the object in both, at which normals and depths can be compared."""
    return (mask > FULL) & (true_mask > FULL)


def normal_degrees(normal: np.ndarray, mask: np.ndarray, true_normal: np.ndarray, true_mask: np.ndarray) -> float:
    """Compute the mean angle, in degrees, between unit normals (k, h, w, 3) over the pixels on both objects."""
    where = on_both_objects(mask, true_mask)
    a, b = np.asarray(normal[where], np.float64), np.asarray(true_normal[where], np.float64)
    # The angle by atan2: arccos of a float32 dot product cannot tell 0 from 0.02 degrees.
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
    return float(np.degrees(angle).mean()) if where.any() else float("nan")


def depth_error(depth: np.ndarray, mask: np.ndarray, true_depth: np.ndarray, true_mask: np.ndarray) -> float:
    """Compute the mean absolute difference in world units over the pixels on both objects."""
    where = on_both_objects(mask, true_mask)
    return float(np.abs(np.asarray(depth, np.float64) - true_depth)[where].mean()) if where.any() else float("nan")


def mask_iou(mask: np.ndarray, true_mask: np.ndarray) -> float:
    """Compute the intersection over union of coverages, all pictures together."""
    both, either = np.minimum(mask, true_mask).sum(dtype=np.float64), np.maximum(mask, true_mask).sum(dtype=np.float64)
    return float(both / either) if either > 0 else 1.0


def views_metrics(
    images: dict[str, np.ndarray], mask: np.ndarray, true_images: dict[str, np.ndarray], true_mask: np.ndarray
) -> dict[str, float]:
    """Compute all figures of k views against k reference views, over the domains that both have.

    Albedo has figures of the masked protocol only: there is no published one.
    """
    shared = [domain for domain in true_images if domain in images]
    out = {"mask_iou": mask_iou(mask, true_mask)}
    for domain in shared:
        a, b = images[domain], true_images[domain]
        if domain in ("color", "albedo", "closed_form"):
            figures = color_metrics(a, mask, b, true_mask)
            if domain != "color":  # base color has no published protocol: the foreground is what counts
                figures = {name: value for name, value in figures.items() if name.endswith("_masked")}
            out |= {f"{domain}_{name}": value for name, value in figures.items()}
        elif domain == "normal":
            out["normal_degrees"] = normal_degrees(a, mask, b, true_mask)
        elif domain == "depth":
            out["depth_error"] = depth_error(a, mask, b, true_mask)
        else:
            out[f"{domain}_error"] = scalar_error(a, b, true_mask)
    return {name: value for name, value in out.items() if np.isfinite(value)}
