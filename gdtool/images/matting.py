"""Cut out a subject by a trained network: U²-Net (Qin et al. 2020) as an ONNX file, run by onnxruntime."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError, ResourceError
from gdtool.core.native import imported_if_installed

SIDE = 320  # pixels, where the file leaves its input's size open
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's pictures, as it was trained with


def saliency(color: np.ndarray, network: str | Path) -> np.ndarray:
    """Find the coverage (h, w) of the subject of a picture, float32 in [0, 1].

    color (h, w, 3): sRGB in [0, 1]. network: an .onnx file with the structure of U²-Net. It takes one picture (1, 3, s,
    s), normalised as ImageNet's, and returns maps (1, 1, s, s). The first one is used, stretched to [0, 1] as the
    authors do.

    Raises ResourceError without onnxruntime, InputError for a file that is no such network or returns nothing finite.
    """
    from skimage.transform import resize

    onnxruntime = imported_if_installed("onnxruntime")
    if onnxruntime is None:
        raise ResourceError(
            "--matting", "needs the package onnxruntime", "pip install 'gdtool[matting]', or give a mask with --mask"
        )
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = 4  # what is wrong with a file is said below, in one line
    try:
        session = onnxruntime.InferenceSession(str(network), settings, providers=["CPUExecutionProvider"])
        (entry,) = session.get_inputs()
        side = entry.shape[-1] if isinstance(entry.shape[-1], int) else SIDE
        picture = resize(color, (side, side), order=1, anti_aliasing=True)
        picture = (picture / max(float(picture.max()), 1e-6) - MEAN) / DEVIATION
        output = np.asarray(
            session.run(None, {entry.name: np.moveaxis(picture, -1, 0)[None].astype(np.float32)})[0][0, 0]
        )
    except Exception as failure:  # onnxruntime's own errors have no common class
        raise InputError(
            network,
            f"is no network of U²-Net's structure: {str(failure).strip().splitlines()[0]}",
            "take u2net.onnx, u2netp.onnx or silueta.onnx",
        ) from None
    low, high = float(output.min()), float(output.max())
    if not (np.isfinite(low) and np.isfinite(high) and high > low):
        raise InputError(network, "finds nothing in the picture", "give a mask with --mask")
    return np.clip(resize((output - low) / (high - low), color.shape[:2], order=1), 0, 1).astype(np.float32)
