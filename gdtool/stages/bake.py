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

from gdtool.core.errors import InputError, ResourceError
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
                description="width and height of the maps in texels; without it what the source's detail needs, 256 to 4096",
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
                description="samples per texel where neighbouring texels differ: 1, 4, 9, …; without it 4 where a texel is much wider than the source's detail, else 1",
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
            description="levels of detail, the full one counted; each has half the triangles of the one before, all share the maps",
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
        _named_model(inputs, options)


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Bake one atlas."""
    from gdtool.bake.maps import MapOptions, make_maps
    from gdtool.bake.occlusion import bake_occlusion
    from gdtool.bake.pipeline import BakeOptions, bake, occlusion_tracer
    from gdtool.bake.reproject import vertex_reach
    from gdtool.bake.target import texel_width, texels_of

    with out.step("read"):
        mesh, matrix = _read_mesh(inputs, options)
    with out.step("frames"):
        target, face_idx = target_of(mesh)
        _check_overlap(target, inputs, out)
    with out.step("source"):
        origin = _read_origin(inputs, options, matrix, target, out)
        few = slice(None, None, max(1, len(target.faces) // 5000))
        if origin.source.turn_to(target.vertices[target.faces[few]].mean(1), target.normals[few].mean(1)):
            out.warn(
                f"{inputs.name}: what it is baked from is inside out beside it; the faces are taken the other way round"
            )
    size, samples = _fineness(options, target, origin.detail)
    if options.samples is None and samples == 1:
        out.skip(
            "more samples",
            f"a texel is {texel_width(target, size) / max(origin.detail, 1e-12):.2g} times as wide as the source's detail: one stands for it",
        )
    _check_memory(inputs, size)
    with out.step("rasterise"):
        texels = texels_of(target, size, threads=out.threads)
        if not texels.inside:
            raise InputError(_path(inputs), "its texture coordinates cover no texel", "run gdtool unwrap")
    with out.step("bake"):
        reach = vertex_reach(target.vertices, target.faces, origin.source)
        baked = bake(
            target,
            texels,
            origin.source,
            origin.lookup,
            reach,
            BakeOptions(samples, out.threads, options.height, options.confidence),
            progress=out.progress,
        )
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
        maps = make_maps(
            texels,
            baked.values,
            occlusion,
            MapOptions(
                bits=options.bits,
                padding=options.padding or None,
                normal_map=options.normal_map,
                threads=out.threads,
                **({"least_alpha": origin.alpha_cutoff} if origin.alpha_mode == "MASK" else {}),
            ),
        )
    for what, reason, seconds in maps.skipped:
        out.skip(what, reason, seconds)
    if options.normal_map == "off":
        out.skip("normal map", "left out by --normal-map off")
    report = {
        **baked.report,
        "seen_share": 0.0 if baked.seen is None else float((baked.seen[: texels.inside] > 0.5).mean()),
        "materials_from": origin.label,
        "detail": origin.detail,
        "samples": samples,
    }
    levels = []
    if options.lods > 1:
        with out.step("levels of detail"):
            levels = _levels(target, options.lods, out, report)
    with out.step("write"):
        _write(out, options, inputs, mesh, target, face_idx, maps, origin, matrix, report, levels)


_MOST_DRIFT = 0.02  # share of the extent, mean: farther off a level shows the maps of other parts
_FEWER = 0.9  # of the level before: what cannot come down to what is asked is worth having with fewer than that


def _levels(target, count: int, out: Output, report: dict) -> list:
    """The coarser targets, finest first; what they cost in place goes to report."""
    from gdtool.bake.lods import coarser, drift
    from gdtool.core.threads import mapped

    counts = [max(len(target.faces) >> k, 4) for k in range(1, count)]
    levels, most = [], len(target.faces)
    # Each is a child process of its own: threads only wait for them.
    for wanted, (level, why) in zip(counts, mapped(lambda n: coarser(target, n), counts, out.threads), strict=True):
        if level is not None and len(level.faces) > max(_FEWER * most, 1.5 * wanted):
            level, why = None, f"it cannot have fewer than {len(level.faces)} triangles without tearing a seam"
        if level is None:
            out.skip(f"level of {wanted} triangles", why)
            continue
        slid = drift(level, target)
        if slid["drift_mean"] > _MOST_DRIFT:
            out.skip(
                f"level of {wanted} triangles",
                f"it would slide {100 * slid['drift_mean']:.1f} % of the extent on the maps",
            )
            continue
        most = len(level.faces)
        if most > 1.5 * wanted:
            out.warn(f"the level of {wanted} triangles has {most}: fewer would tear a seam")
        levels.append(level)
        report[f"lod{len(levels)}_triangles"] = len(level.faces)
        report |= {f"lod{len(levels)}_{name}": value for name, value in slid.items()}
    return levels


def _path(inputs: Inputs):
    return getattr(inputs.main, "path", inputs.main)


def _check_memory(inputs: Inputs, size: int) -> None:
    """Raise ResourceError when the maps will not fit into memory, rather than be killed half-way."""
    from pathlib import Path

    # Bytes per texel, measured by benchmarks/bake.py at 2048 and 4096 on an atlas that is 72 % covered.
    needed = 130 * size * size
    try:
        free = next(
            int(line.split()[1]) * 1024
            for line in Path("/proc/meminfo").read_text().splitlines()
            if line.startswith("MemAvailable")
        )
    except (OSError, StopIteration):
        return
    if needed > free:
        raise ResourceError(
            inputs.name,
            f"maps of {size} texels need about {needed / 2**30:.0f} GB of memory, {free / 2**30:.0f} GB are free",
            "lower --size",
        )


def _read_mesh(inputs: Inputs, options: Options):
    """The mesh to bake for, in the normalised frame and with texture coordinates, and the (4, 4) matrix to its source's
    frame.

    A file may be in either frame: one that fills the unit box is taken to be normalised, like the surface it is baked
    from; another one to be in the source's frame.
    """
    import dataclasses

    import numpy as np

    from gdtool.folders.mesh import QuadMesh, read_mesh, read_obj
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

    main = inputs.main
    if hasattr(main, "content"):
        mesh, matrix = read_mesh(main), np.array(main.content.source_from_world).reshape(4, 4)
    elif isinstance(main, str):
        raise InputError(
            main, "has no texture coordinates of its own to bake into", "run gdtool remesh and gdtool unwrap first"
        )
    else:
        if main.suffix.lower() == ".obj":
            mesh = read_obj(main)
        else:
            from gdtool.assets.load import load_scene

            scene = load_scene(main)
            uv = scene.uvs[0] if scene.uvs else None
            faces = np.concatenate([scene.faces, np.full((len(scene.faces), 1), -1, np.int32)], 1)
            mesh = QuadMesh(scene.vertices, faces, uv, None if uv is None else faces)
    if mesh.uv is None:
        raise InputError(_path(inputs), "has no texture coordinates", "run gdtool unwrap")
    if not hasattr(main, "content"):
        own = unit_box(mesh.vertices)
        surface = inputs.second["surface"] if options.model is None else None
        matrix = np.array(surface.content.source_from_world).reshape(4, 4) if surface is not None else own
        normalised = np.abs(own[:3, 3]).max() < 0.02 and abs(own[0, 0] - 1) < 0.05
        if surface is None or not normalised:
            mesh = dataclasses.replace(mesh, vertices=transform_points(invert_similarity(matrix), mesh.vertices))
    if np.abs(mesh.uv).max() > 64:
        raise InputError(
            _path(inputs), f"has texture coordinates as large as {np.abs(mesh.uv).max():g}", "run gdtool unwrap"
        )
    return mesh, matrix


def _read_origin(inputs: Inputs, options: Options, matrix, target, out: Output):
    """What to bake from: the surface (with its views), a model named by --model, or the model that was remeshed."""
    from gdtool.bake.origin import from_scene, from_surface

    surface, views = inputs.second["surface"], inputs.second["views"]
    if options.model is None and surface is not None:
        from gdtool.bake.origin import material_field
        from gdtool.folders.surface import read_surface
        from gdtool.folders.views import read_views

        read = None
        if not options.project_views:
            out.skip("views", "left out by --no-project-views")
        elif views is None:
            out.skip("views", "none along the provenance chain: materials come from the surface's vertices")
        else:
            read = read_views(views, ("albedo", "roughness", "metallic", "normal"))
            for domain in ("albedo", "roughness", "metallic", "normal"):
                if domain not in read.images:
                    out.skip(f"{domain} views", "the views do not hold it: the surface's vertices serve")
        known = surface.content.field and not (read and {"albedo", "roughness", "metallic"} <= set(read.images))
        field = material_field(surface.file("field.safetensors"), out.device) if known else None
        read = read if read is not None and read.images else None
        return from_surface(
            read_surface(surface), read, field, None if read is None else _read_picture(views, read, out)
        )
    named = _named_model(inputs, options)
    from gdtool.assets.load import load_scene
    from gdtool.bake.target import texel_width

    def footprint(detail: float) -> float:
        size, samples = _fineness(options, target, detail)
        # Between texels a lookup is a mean of its own: of a level as coarse as the sample is wide it blurs twice.
        return 0.5 * texel_width(target, size) / samples**0.5

    return from_scene(load_scene(named), matrix, footprint)


def _named_model(inputs: Inputs, options: Options) -> str:
    """The model to bake from: of --model, else the one that was remeshed. Raises InputError where there is none."""
    from pathlib import Path

    from gdtool.assets.load import SUFFIXES
    from gdtool.core.provenance import find_source

    named = options.model
    if named is None and hasattr(inputs.main, "content"):
        named = find_source(inputs.main, "name the model to bake from with --model")
        if named is not None and not named.startswith("procedural:") and Path(named).suffix.lower() not in SUFFIXES:
            named = None
    if named is None:
        raise InputError(
            _path(inputs),
            "has no surface to bake from along its provenance chain",
            "name one with --surface or --model",
        )
    return named


def _fineness(options: Options, target, detail: float) -> tuple[int, int]:
    """Size of the maps, and samples of a texel where the source varies, for a source whose detail is so wide."""
    from gdtool.bake.target import samples_for, size_for, texel_width

    size = options.size or size_for(target, detail)
    return size, samples_for(texel_width(target, size), detail) if options.samples is None else round(
        options.samples**0.5
    ) ** 2


def _read_picture(folder, views, out: Output):
    """The picture that the views were made of, where the folder holds it and they hold an albedo to put its detail
    on."""
    from gdtool.bake.picture import picture_of
    from gdtool.folders.views import read_picture

    found = read_picture(folder, views.cameras)
    if found is None or "albedo" not in views.images:
        out.skip(
            "picture", "the views' folder holds none" if found is None else "the views hold no albedo for its detail"
        )
        return None
    image, camera = found
    return picture_of(image, camera, views.images["albedo"][views.names.index(camera.name)])


def target_of(mesh):
    """The triangles to bake into, and the quad (t,) each comes from."""
    import numpy as np

    from gdtool.bake.target import Target
    from gdtool.geometry.topology import triangulated

    faces, face_idx = triangulated(mesh.faces)
    # The same cut for the texture corners: cut a mesh whose faces are the corners' numbers.
    second = np.zeros(len(faces), bool)
    second[1:] = face_idx[1:] == face_idx[:-1]
    corners = np.where(second[:, None], [0, 2, 3], [0, 1, 2])
    face_uvs = np.take_along_axis(mesh.face_uvs[face_idx], corners, 1)
    return Target.of(mesh.vertices, faces, mesh.uv, face_uvs), face_idx


def _check_overlap(target, inputs: Inputs, out: Output) -> None:
    from gdtool.geometry.uv_raster import owner_count

    count = owner_count(target.uv, target.face_uvs, 512)
    share = float((count > 1).sum() / max((count > 0).sum(), 1))
    if share > 0.001:
        out.warn(
            f"{inputs.name}: texture coordinates overlap on {100 * share:.1f} % of what they cover; the first face there is baked"
        )
    if target.uv.min() < -1e-6 or target.uv.max() > 1 + 1e-6:
        out.warn(f"{inputs.name}: texture coordinates leave the unit square; what lies outside is not baked")


def _write(
    out: Output, options: Options, inputs: Inputs, mesh, target, face_idx, maps, origin, matrix, report, levels
) -> None:
    """Write the folder's files and set out.content."""
    import dataclasses

    from gdtool.bake.asset import AssetMeshes, AssetOptions, write_models
    from gdtool.geometry.frames import transform_points

    if options.source_frame:
        turn = matrix[:3, :3] / (matrix[:3, 0] ** 2).sum() ** 0.5

        def moved(one):
            tangents = one.tangents.copy()
            tangents[..., :3] = tangents[..., :3] @ turn.T
            return dataclasses.replace(
                one, vertices=transform_points(matrix, one.vertices), normals=one.normals @ turn.T, tangents=tangents
            )

        target, levels = moved(target), [moved(level) for level in levels]
        mesh = dataclasses.replace(mesh, vertices=target.vertices)
    usd = f"asset.{options.usd}" if options.usd != "none" else ""
    files = write_models(
        out.path,
        AssetMeshes(target, mesh, face_idx, tuple(levels)),
        maps,
        origin,
        AssetOptions(inputs.name, options.normal_convention, usd, out.threads),
    )
    out.content = AssetContent(
        size=maps.size,
        maps=files,
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
    version=13,
    reads=("atlas", "mesh-file"),
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
