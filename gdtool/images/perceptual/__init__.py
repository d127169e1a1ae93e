"""Compare pictures as people do: LPIPS (Zhang et al. 2018) and FLIP (Andersson et al. 2020)."""

from gdtool.images.perceptual.measures import FIGURES, flip, load_lpips, missing, perceptual_metrics

__all__ = ["FIGURES", "flip", "load_lpips", "missing", "perceptual_metrics"]
