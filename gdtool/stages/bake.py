"""Bake a mesh with texture coordinates to an engine-ready asset: maps, .glb, quad .obj, OpenUSD.

Use it after unwrap. Base color, occlusion-roughness-metallic and tangent-space normals are read texel by texel from the
surface that the mesh was made from: from its confident views where there are any (found along the provenance chain),
else from its vertices, or from the textures of the model that was remeshed. Detail that is finer than the views comes
from the picture that sample-views made them from. A map that would be constant becomes a factor, a flat normal map is
left out. Without --size a texel is as fine as the source's detail: a texel of its textures, half a pixel of its views,
a pixel of the picture.

Example:
  gdtool bake cat.asset/atlas --size 2048 --lods 4
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.kinds import AssetContent
from gdtool.core.stage import FILE, MOST_SEED, Inputs, Output, SecondInput, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool bake`."""

    size: (
        Annotated[
            int,
            Meta(
                ge=16,
                le=16384,
                description="Width and height of the maps, texels; without it 256 to 4096, as the source's detail "
                "needs.",
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
                description="Samples per texel where neighbouring texels differ: 1, 4, 9, …; without it 4 where a "
                "texel is much wider than the source's detail, else 1.",
            ),
        ]
        | None
    ) = None
    ao: Annotated[bool, Meta(description="Trace ambient occlusion.")] = True
    ao_rays: Annotated[int, Meta(ge=1, le=65536, description="Rays per traced point of ambient occlusion.")] = 64
    padding: Annotated[
        int, Meta(ge=0, le=16384, description="Texels of padding around charts; 0: all that are free.")
    ] = 0
    bits: Annotated[int, Meta(ge=8, le=16, multiple_of=8, description="Bits per channel of the maps, 8 or 16.")] = 8
    normal_map: Annotated[
        Literal["auto", "on", "off"], Meta(description="Write a normal map; auto: where it would not be flat.")
    ] = "auto"
    normal_convention: Annotated[
        Literal["opengl", "directx"],
        Meta(description="Sign of the green channel of normal.png; .glb is always opengl."),
    ] = "opengl"
    project_views: Annotated[
        bool, Meta(description="Read materials from the views where they see the surface well.")
    ] = True
    height: Annotated[
        bool, Meta(description="Also write height.png: how far the source lies above the mesh, 16 bits.")
    ] = False
    confidence: Annotated[bool, Meta(description="Also write confidence.png: how certain each texel is.")] = False
    lods: Annotated[
        int,
        Meta(
            ge=1,
            le=8,
            description="Number of levels of detail with the full one. Each has half the triangles of the one before, "
            "and all share the maps.",
        ),
    ] = 1
    usd: Annotated[
        Literal["none", "usda", "usdz"],
        Meta(description="Also write OpenUSD with UsdPreviewSurface (needs gdtool[usd])."),
    ] = "none"
    source_frame: Annotated[
        bool, Meta(description="Write vertices in the source's own frame instead of the normalised one.")
    ] = False
    model: Annotated[
        str | None,
        Meta(description="Model or mesh file, with its textures, to bake from instead of the surface.", extra=FILE),
    ] = None
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="Seed of the occlusion rays.")] = 0


def check(inputs: Inputs, options: Options) -> None:
    """Refuse, before the run, a bad --model, --usd without its package, and a mesh with nothing to bake from."""
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
    from gdtool.bake import steps
    from gdtool.bake.asset import AssetMeshes, AssetOptions, in_source_frame, write_models

    surface, views = inputs.second_folder("surface"), inputs.second_folder("views")
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
        origin = steps.read_source(inputs.main, choice, target, matrix, inputs.name, out)
    how = steps.StepOptions(
        size=options.size,
        samples=options.samples,
        occlusion_rays=options.ao_rays if options.ao else 0,
        seed=options.seed,
        height=options.height,
        confidence=options.confidence,
        bits=options.bits,
        padding=options.padding,
        normal_map=options.normal_map,
    )
    texels, samples = steps.rasterise(inputs.main, target, origin, how, inputs.name, out)
    maps, report = steps.bake_maps(target, texels, origin, samples, how, out)
    levels = steps.add_levels(target, options.lods, report, out)
    with out.step("write"):
        meshes = AssetMeshes(target, mesh, face_idx, levels)
        if options.source_frame:
            meshes = in_source_frame(meshes, matrix)
        usd = f"asset.{options.usd}" if options.usd != "none" else ""
        files = AssetOptions(inputs.name, options.normal_convention, usd, out.threads)
        out.content = AssetContent(
            size=maps.size,
            maps=write_models(out.path, meshes, maps, origin, files),
            usd=usd,
            factors=maps.factors,
            normal_convention=options.normal_convention,
            lods=tuple(f"asset_lod{k}.glb" for k in range(1, len(levels) + 1)),
            frame="source" if options.source_frame else "normalised",
            source_from_world=tuple(float(x) for x in matrix.ravel()),
            report=report,
        )


STAGE = Stage(
    name="bake",
    version=14,
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
