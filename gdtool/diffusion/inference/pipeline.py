"""Sample the views of a picture, and warn the user where they are likely to be poor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from gdtool.cameras import rig
from gdtool.core.errors import UsageError
from gdtool.core.stage import Output
from gdtool.diffusion.checkpoint import wonder3d
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.data.objects import condition_batch
from gdtool.diffusion.inference.compiled import sample_compiled
from gdtool.diffusion.inference.conditions import Conditions
from gdtool.diffusion.inference.familiarity import describe_doubts, describe_unfamiliar, read_ranges
from gdtool.diffusion.inference.result import views_from_images
from gdtool.diffusion.inference.sampling import SamplingOptions, averages_mirror_image, sample_images
from gdtool.diffusion.inference.shape import make_guides
from gdtool.diffusion.network.encoding import BACKGROUND
from gdtool.diffusion.network.known import KnownImages
from gdtool.diffusion.network.model import Model
from gdtool.folders.views import Views


def choose_domains(asked: tuple[str, ...] | None, config: ModelConfig) -> tuple[str, ...]:
    """Return the domains to write: those asked for, or (None) all that the model has. Raises UsageError for others."""
    domains = config.domains if asked is None else asked
    unknown = [d for d in domains if d not in config.domains]
    if unknown or not domains:
        raise UsageError(
            "--domains",
            f"{unknown[0] if unknown else 'nothing'} is not a domain of this model",
            f"choose from {','.join(config.domains)}",
        )
    return domains


def sampling_options(chosen: Any, domains: tuple[str, ...]) -> SamplingOptions:
    """Convert the options of `gdtool sample-views` to those of a sampling of some domains."""
    return SamplingOptions(
        domains=domains,
        steps=chosen.steps,
        guidance=chosen.guidance,
        guided_from=chosen.guided_from,
        guided_to=chosen.guided_to,
        seed=chosen.seed,
        scheduler=chosen.scheduler,
        eta=chosen.eta,
        spacing=None if chosen.spacing == "auto" else chosen.spacing,
        precision=chosen.precision,
        mirror=None if chosen.mirror else False,
    )


@dataclass(frozen=True)
class Subject:
    """Hold what is known of an object: its framed picture (size, size, 4), and images that are given; None: none.

    name: the picture's, in warnings.
    """

    name: str
    condition: np.ndarray
    known: KnownImages | None = None


class Sampled(NamedTuple):
    """Hold sampled views: images (1, k, 3, h, w) by domain, and the coverage (k, h, w) of the shape that they were
    painted on; None for a model without a shape network.
    """

    images: dict[str, torch.Tensor]
    coverage: torch.Tensor | None


def sample_subject(
    model: Model, ranges_folder: Path, subject: Subject, options: SamplingOptions, compiled: bool, out: Output
) -> Sampled:
    """Sample all views of an object.

    ranges_folder: model folder with the ranges of the training pictures; a picture outside them causes a warning.
    compiled: whether to compile the network first. Of a model with a shape network, seed 0 takes the best guess of the
    shape, and other seeds choose among the possible ones.
    """
    rgba, name = condition_batch(subject.condition), subject.name
    strange = describe_unfamiliar(rgba[0].numpy(), read_ranges(ranges_folder))
    if strange:
        figures = "; ".join(strange)
        out.warn(f"{name}: unlike the pictures that this model was trained on, so its views may be poor: {figures}")
    # The memory layout that convolutions work in: 5 % faster, the same up to rounding.
    model.unet.to(memory_format=torch.channels_last)
    sample = sample_compiled if compiled else sample_images
    rgba, guides = rgba.to(out.device), None
    if model.shape is not None:
        mirror = averages_mirror_image(model.config, options)
        guides = make_guides(model, rgba, subject.known, seed=options.seed or None, mirror=mirror)
    images = sample(model, rgba, options, guides=guides, known=subject.known, progress=out.progress)
    if options.used_with(model.config).guidance != 1 and (options.guided_from > 0 or options.guided_to < 1):
        out.skip("guidance of some steps", "they are outside --guided-from and --guided-to")
    return Sampled(images, None if guides is None else guides.mask[0].cpu())


def sample_conditions(
    model: Model,
    folder: Path,
    conditions: Conditions,
    settings: SamplingOptions,
    compiled: bool,
    name: str,
    out: Output,
) -> tuple[Views, dict[str, Any]]:
    """Sample all views of an object, and convert them to Views with the given images in their places.

    folder: the model's. compiled: whether to compile the network first. name: the source's, in warnings. Returns the
    views and a report (see result.views_from_images()), and warns where the model is unsure of them.
    """
    config, of_wonder3d = model.config, model.config.convention == "wonder3d"
    subject = Subject(name, conditions.condition, conditions.given.known(config))
    images, coverage = sample_subject(model, folder, subject, settings, compiled, out)
    if of_wonder3d and "normal" in images:
        images["normal"] = wonder3d.premultiplied_normals(images["normal"])
    cameras = {camera.name: camera for camera in rig("wonder3d" if of_wonder3d else "six", config.image_size)}
    views, report = views_from_images(
        {d: x[0].cpu() for d, x in images.items()},
        [cameras[name] for name in config.views],
        BACKGROUND[config.backgrounds[0]],
        settings.domains,
        conditions.front_silhouette(),
        coverage,
    )
    conditions.given.put_into(views)
    warn_of_doubts(folder, report, config, settings, name, out)
    return views, report


def warn_of_doubts(
    ranges_folder: Path,
    report: dict[str, float],
    config: ModelConfig,
    options: SamplingOptions,
    name: str,
    out: Output,
) -> None:
    """Warn where the figures of a result exceed their usual range: the model is unsure of its views.

    report: the figures, as result.views_from_images() returns them. The usual ranges were measured with the model's
    default options. With other options no warning is given, and the manifest lists the check as skipped.
    """
    default = (
        options.used_with(config) == SamplingOptions().used_with(config)
        and options.mirror is None
        and options.domains == config.domains
    )
    if not default:
        out.skip(
            "the model's doubt of its result",
            "its usual figures were measured with the model's default options, in all domains",
        )
        return
    unsure = describe_doubts(report, read_ranges(ranges_folder))
    if unsure:
        out.warn(
            f"{name}: the model is unsure of the views that the picture does not show ({'; '.join(unsure)}): "
            "look at contact_sheet.png before going on, and try a picture straight from the front, or another --model"
        )


def tell_unused_picture(report: dict[str, float], domains: tuple[str, ...], has_front: bool, out: Output) -> None:
    """Record what of the picture itself the views did not take over, and why.

    has_front: a view is the one that the picture was taken from.
    """
    if not report["drawn_share"]:
        reason = "each has room for all of them" if has_front else "no view is the picture's own"
        out.skip("parts of the picture in the other views", reason)
    if not report["painted_share"] and "albedo" in domains:
        reason = "its detail is light, or metal, by the model's albedo" if has_front else "no view is the picture's own"
        out.skip("paint of the picture", reason)
