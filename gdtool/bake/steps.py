"""Run the steps from a target and its source to maps, and record what each step left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gdtool.bake.inputs import SourceChoice, path_of, read_origin
from gdtool.bake.lods import make_levels
from gdtool.bake.maps import MapOptions, Maps, make_maps, require_map_memory
from gdtool.bake.occlusion import bake_occlusion
from gdtool.bake.origin import Origin
from gdtool.bake.pipeline import BakeOptions, bake, occlusion_tracer
from gdtool.bake.reproject import cage_offsets
from gdtool.bake.target import Target, Texels, size_and_samples, texel_width, texels_of
from gdtool.core.errors import InputError
from gdtool.core.sources import Source
from gdtool.core.stage import Output

# World units; a source whose detail is finer counts as this fine.
FINEST_DETAIL = 1e-12

Report = dict[str, bool | int | float | str]


@dataclass(frozen=True)
class StepOptions:
    """Options of a bake and of storing its maps.

    size: side of the maps in texels; samples: per texel; None chooses either by the source's detail
    (target.size_and_samples). occlusion_rays: per traced point, with directions drawn from `seed`; 0 bakes no ambient
    occlusion. height, confidence: whether to make these maps too. bits: 8 or 16 per channel. padding: width of gutters
    in texels; 0 fills all free texels. normal_map: "auto" leaves a flat one out.
    """

    size: int | None
    samples: int | None
    occlusion_rays: int
    seed: int
    height: bool
    confidence: bool
    bits: int
    padding: int
    normal_map: Literal["auto", "on", "off"]


def read_source(
    source: Source, choice: SourceChoice, target: Target, matrix: np.ndarray, name: str, out: Output
) -> Origin:
    """Read the surface or model to bake from, and warn where it is inside out compared with the target.

    source: what the mesh was read from; matrix (4, 4): from the normalised frame to the model's.
    """
    origin, turned = read_origin(source, choice, target, matrix)
    for what, why in choice.skipped:
        out.skip(what, why)
    if turned:
        out.warn(f"{name}: the source of the bake is inside out compared with it; the source's faces are flipped")
    return origin


def rasterise(
    source: Source, target: Target, origin: Origin, options: StepOptions, name: str, out: Output
) -> tuple[Texels, int]:
    """Choose the size of the maps and the samples per texel, and find the texels that the target's charts cover.

    Returns texels and samples. Raises ResourceError for maps beyond the free memory, InputError without any texel.
    """
    size, samples = size_and_samples(target, origin.detail, options.size, options.samples)
    if options.samples is None and samples == 1:
        times = texel_width(target, size) / max(origin.detail, FINEST_DETAIL)
        out.skip("more samples", f"a texel is {times:.2g} times as wide as the source's detail: one sample is enough")
    require_map_memory(name, size)
    with out.step("rasterise"):
        texels = texels_of(target, size, threads=out.threads)
    if not texels.inside:
        raise InputError(path_of(source), "its texture coordinates cover no texel", "run gdtool unwrap")
    return texels, samples


def bake_maps(
    target: Target, texels: Texels, origin: Origin, samples: int, options: StepOptions, out: Output
) -> tuple[Maps, Report]:
    """Bake the texels' values and ambient occlusion, and make maps of them.

    Returns the maps and the report's figures.
    """
    with out.step("bake"):
        reach = cage_offsets(target.mesh, origin.source)
        bake_options = BakeOptions(samples, out.threads, options.height, options.confidence)
        baked = bake(target, texels, origin.source, origin.lookup, reach, bake_options, out.progress)
    occlusion = None
    if options.occlusion_rays:
        with out.step("occlusion"):
            trace = occlusion_tracer(
                target, origin.source, reach, origin.normals, options.occlusion_rays, options.seed, out.threads
            )
            occlusion = bake_occlusion(target, texels, trace, threads=out.threads)
    else:
        out.skip("occlusion", "left out by --no-ao")
    with out.step("maps"):
        cutoff = {"least_alpha": origin.alpha_cutoff} if origin.alpha_mode == "MASK" else {}
        storage = MapOptions(options.bits, options.padding or None, options.normal_map, threads=out.threads, **cutoff)
        maps = make_maps(texels, baked.values, occlusion, storage)
    for what, reason, seconds in maps.skipped:
        out.skip(what, reason, seconds)
    if options.normal_map == "off":
        out.skip("normal map", "left out by --normal-map off")
    return maps, {
        **baked.report,
        "seen_share": baked.seen_share(texels.inside),
        "materials_from": origin.label,
        "detail": origin.detail,
        "samples": samples,
    }


def add_levels(target: Target, count: int, report: Report, out: Output) -> tuple[Target, ...]:
    """Make coarser levels of detail, `count` with the full mesh, and add their figures to the report."""
    if count < 2:
        return ()
    with out.step("levels of detail"):
        levels = make_levels(target, count, out.threads)
    for what, why in levels.skipped:
        out.skip(what, why)
    for warning in levels.warnings:
        out.warn(warning)
    report |= levels.report
    return tuple(levels.targets)
