"""Mesh with texture coordinates to an engine-ready asset: maps from the surface it came from, .glb, quad .obj, OpenUSD.

Use it after unwrap. Base color, occlusion-roughness-metallic and tangent-space normals are read texel by texel from the
surface: from its confident views where there are any (found along the provenance chain), else from its vertices, or
from the textures of the model that was remeshed. The picture that sample-views made the views of adds what it shows
finer than they. Maps that would be constant become factors, a flat normal map is left out. Without --size a texel is as
fine as the source's detail: a texel of its textures, half a pixel of its views, a pixel of the picture.

Example:
  gdtool bake cat.asset/atlas --size 2048 --lods 4
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError
from gdtool.core.kinds import AssetContent
from gdtool.core.stage import MOST_SEED, Inputs, Output, SecondInput, Stage, file_option


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of bake."""

    size: (
        Annotated[
            int,
            Meta(
                ge=16,
                le=16384,
                description="width and height of the maps in texels; "
                "without it what the source's detail needs, 256 to 4096",
            ),
        ]
        | None
    ) = None
    samples: (
        Annotated[
            int,
            Meta(
                ge=1,
                le=64,
                description="samples per texel where neighbouring texels differ: 1, 4, 9, …; "
                "without it 4 where a texel is much wider than the source's detail, else 1",
            ),
        ]
        | None
    ) = None
    ao: Annotated[bool, Meta(description="trace ambient occlusion")] = True
    ao_rays: Annotated[int, Meta(ge=1, le=65536, description="rays per traced point of ambient occlusion")] = 64
    padding: Annotated[int, Meta(ge=0, le=16384, description="texels of gutter around charts; 0: all that is free")] = 0
    bits: Annotated[int, Meta(ge=8, le=16, multiple_of=8, description="bits per channel of the maps, 8 or 16")] = 8
    normal_map: Annotated[
        Literal["auto", "on", "off"], Meta(description="auto leaves it out where it would be flat")
    ] = "auto"
    normal_convention: Annotated[
        Literal["opengl", "directx"], Meta(description="green channel of normal.png; .glb is always opengl")
    ] = "opengl"
    project_views: Annotated[
        bool, Meta(description="read materials from the views where they see the surface well")
    ] = True
    height: Annotated[
        bool, Meta(description="write height.png as well: where the source lies above the mesh, 16 bits")
    ] = False
    confidence: Annotated[bool, Meta(description="write confidence.png as well: how sure each texel is")] = False
    lods: Annotated[
        int,
        Meta(
            ge=1,
            le=8,
            description="levels of detail, the full one counted; "
            "each has half the triangles of the one before, all share the maps",
        ),
    ] = 1
    usd: Annotated[
        Literal["none", "usda", "usdz"],
        Meta(description="write OpenUSD with UsdPreviewSurface as well (needs usd-core)"),
    ] = "none"
    source_frame: Annotated[
        bool, Meta(description="write vertices in the source's own frame instead of the normalised one")
    ] = False
    model: file_option("model or mesh file, with its textures, to bake from instead of the surface") = None
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="seed of the occlusion rays")] = 0


def check(inputs: Inputs, options: Options) -> None:
    """Raise what --model, --usd and a missing surface would stop the run with."""
    from gdtool.stages import early

    if options.usd != "none":
        early.require_package("pxr.Usd", "--usd", "pip install 'gdtool[usd]', or leave out --usd")
    if options.model is not None:
        early.require_model("--model", options.model)
    elif inputs.second["surface"] is None:
        from gdtool.bake.inputs import named_model

        named_model(inputs.main, options.model)


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Bake one atlas."""
    from gdtool.bake import inputs as sources
    from gdtool.bake.asset import AssetMeshes, AssetOptions, in_source_frame, write_models
    from gdtool.bake.maps import require_map_memory
    from gdtool.bake.target import fineness, texel_width, texels_of

    surface, views = inputs.second["surface"], inputs.second["views"]
    with out.step("read"):
        mesh, matrix = sources.read_target_mesh(inputs.main, surface if options.model is None else None)
    with out.step("frames"):
        target, face_idx = sources.target_of(mesh)
        for warning in sources.uv_warnings(target):
            out.warn(f"{inputs.name}: {warning}")
    with out.step("source"):
        choice = sources.SourceChoice(
            surface, views, options.model, options.project_views, options.size, options.samples, out.device
        )
        origin, turned = sources.read_origin(inputs.main, choice, target, matrix)
        for what, why in choice.skipped:
            out.skip(what, why)
        if turned:
            told = "what it is baked from is inside out beside it; the faces are taken the other way round"
            out.warn(f"{inputs.name}: {told}")
    size, samples = fineness(target, origin.detail, options.size, options.samples)
    if options.samples is None and samples == 1:
        times = texel_width(target, size) / max(origin.detail, 1e-12)
        why = f"a texel is {times:.2g} times as wide as the source's detail: one stands for it"
        out.skip("more samples", why)
    require_map_memory(inputs.name, size)
    with out.step("rasterise"):
        texels = texels_of(target, size, threads=out.threads)
        if not texels.inside:
            where = sources.path_of(inputs.main)
            raise InputError(where, "its texture coordinates cover no texel", "run gdtool unwrap")
    maps, report = _bake_maps(options, out, target, texels, origin, samples)
    levels = _make_levels(target, options.lods, out, report) if options.lods > 1 else ()
    with out.step("write"):
        meshes = AssetMeshes(target, mesh, face_idx, levels)
        if options.source_frame:
            meshes = in_source_frame(meshes, matrix)
        usd = f"asset.{options.usd}" if options.usd != "none" else ""
        how = AssetOptions(inputs.name, options.normal_convention, usd, out.threads)
        out.content = AssetContent(
            size=maps.size,
            maps=write_models(out.path, meshes, maps, origin, how),
            usd=usd,
            factors=maps.factors,
            normal_convention=options.normal_convention,
            lods=tuple(f"asset_lod{k}.glb" for k in range(1, len(levels) + 1)),
            frame="source" if options.source_frame else "normalised",
            source_from_world=tuple(float(x) for x in matrix.ravel()),
            report=report,
        )


def _bake_maps(options: Options, out: Output, target, texels, origin, samples: int):
    """Bake the texels' values and occlusion, and make maps of them; also returns the report."""
    from gdtool.bake.maps import MapOptions, make_maps
    from gdtool.bake.occlusion import bake_occlusion
    from gdtool.bake.pipeline import BakeOptions, bake, occlusion_tracer
    from gdtool.bake.reproject import vertex_reach
    from gdtool.geometry.meshes import TriMesh

    with out.step("bake"):
        reach = vertex_reach(TriMesh(target.vertices, target.faces), origin.source)
        how = BakeOptions(samples, out.threads, options.height, options.confidence)
        baked = bake(target, texels, origin.source, origin.lookup, reach, how, out.progress)
    occlusion = None
    if options.ao:
        with out.step("occlusion"):
            trace = occlusion_tracer(
                target, origin.source, reach, origin.normals, options.ao_rays, options.seed, out.threads
            )
            occlusion = bake_occlusion(target, texels, trace, threads=out.threads)
    else:
        out.skip("occlusion", "left out by --no-ao")
    with out.step("maps"):
        cutoff = {"least_alpha": origin.alpha_cutoff} if origin.alpha_mode == "MASK" else {}
        how = MapOptions(options.bits, options.padding or None, options.normal_map, threads=out.threads, **cutoff)
        maps = make_maps(texels, baked.values, occlusion, how)
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


def _make_levels(target, count: int, out: Output, report: dict) -> tuple:
    """Make the coarser levels, and tell what they report."""
    from gdtool.bake.lods import make_levels

    with out.step("levels of detail"):
        levels = make_levels(target, count, out.threads)
    for what, why in levels.skipped:
        out.skip(what, why)
    for warning in levels.warnings:
        out.warn(warning)
    report |= levels.report
    return tuple(levels.targets)


STAGE = Stage(
    name="bake",
    version=13,
    reads=("atlas", "mesh-file"),
    networks=True,
    writes="asset",
    Options=Options,
    run=run,
    check=check,
    second_inputs={
        "surface": SecondInput(
            "surface", help="The surface to bake from; found along the provenance chain without it."
        ),
        "views": SecondInput("views", help="Views of it; found along the provenance chain without it."),
    },
)
