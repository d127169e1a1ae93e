"""Unwrap a mesh: few charts, cut along quad edges and creases, flattened without mirroring, packed for mip-mapping.

Use it after remesh, or on a mesh file of your own. Valid texture coordinates of the mesh are kept, unless --redo. With
--symmetry the halves of a symmetric mesh share their texels. layout.png shows the charts, checkerboard.png the mesh
with a checkerboard in them.

Example:
  gdtool unwrap cat.asset/mesh --size 2048
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.child import prepare
from gdtool.core.kinds import AtlasContent
from gdtool.core.stage import MOST_SECONDS, Inputs, Output, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool unwrap`."""

    size: Annotated[int, Meta(ge=16, le=65536, description="Side of the texture that the padding is for, texels.")] = (
        2048
    )
    mip_safe: Annotated[
        int,
        Meta(
            ge=1,
            le=65536,
            description="Side of the smallest mip level at which charts are still a texel apart, texels.",
        ),
    ] = 256
    padding: Annotated[
        int, Meta(ge=0, le=1024, description="Texels between charts at --size; 0: as many as --mip-safe needs.")
    ] = 0
    max_stretch: Annotated[
        float, Meta(gt=1, le=100, description="Most L2 stretch of a chart; one with more is cut.")
    ] = 1.1
    symmetry: Annotated[
        Literal["none", "x", "y", "z"],
        Meta(description="Let faces that mirror others along this axis share their texels."),
    ] = "none"
    redo: Annotated[bool, Meta(description="Make new texture coordinates even where the mesh has valid ones.")] = False
    seconds: Annotated[
        float,
        Meta(
            gt=0,
            le=MOST_SECONDS,
            description="Time limit. Charts are shaped in the first 60 % of it, and simpler methods do the rest. After "
            "twice the limit and 5 s the run fails.",
        ),
    ] = 120.0


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Unwrap one mesh; raise ResourceError where it takes much longer than --seconds."""
    from gdtool.stages.limits import limited_to

    cure = f"raise --seconds to {max(round(2 * options.seconds), 1)}, or run gdtool remesh with fewer --faces before"
    with limited_to(options.seconds, "--seconds", inputs.name, cure):
        _unwrap(inputs, options, out)


def _unwrap(inputs: Inputs, options: Options, out: Output) -> None:
    """Unwrap one mesh and write the atlas."""
    from gdtool.geometry.simplify import CHILD_MODULES, collapse_in_child

    prepare(collapse_in_child, CHILD_MODULES)  # for the first child of unwrap(), while the mesh is read

    import numpy as np

    from gdtool.folders.mesh import write_mesh
    from gdtool.geometry import topology
    from gdtool.images.io import write_png
    from gdtool.stages.mesh_source import read_quad_mesh
    from gdtool.unwrap import pipeline, preview

    with out.step("read"):
        mesh, matrix = read_quad_mesh(inputs, out)
    padding = options.padding or pipeline.padding_for_mips(options.size, options.mip_safe)
    kept, tried, twin = _keeps_uv(mesh, options, inputs, out), [], np.full(len(mesh.faces), -1)
    if not kept:
        mesh, tried, twin = _unwrapped(mesh, padding, options, inputs, out)
    with out.step("measure"):
        report = _report(mesh, twin, kept, options, inputs, out)
    wide = _with_wide_indices(mesh)
    with out.step("preview"):
        chart = pipeline.uv_islands(wide)[0]
        write_png(out.path("layout.png"), preview.layout(wide.faces, mesh.uv, wide.face_uvs, chart))
        write_png(out.path("checkerboard.png"), preview.checkerboard(wide, chart))
    with out.step("write"):
        write_mesh(out, mesh)
    quads = int(mesh.is_quad.sum())
    out.content = AtlasContent(
        vertices=len(mesh.vertices),
        quads=quads,
        triangles=len(mesh.faces) - quads,
        charts=report["charts"],
        size=options.size,
        padding=padding,
        coverage=report["coverage"],
        watertight=topology.is_watertight(mesh.faces),
        report=report | {"kept": kept},
        tried=tuple(tried),
        source_from_world=tuple(float(x) for x in matrix.ravel()),
    )


def _keeps_uv(mesh, options: Options, inputs: Inputs, out: Output) -> bool:
    """Tell whether the input's texture coordinates are kept; record that they are, or warn why they are not."""
    from gdtool.unwrap.pipeline import invalid_reason

    if mesh.uv is None or options.redo:
        return False
    reason = invalid_reason(_with_wide_indices(mesh))
    if reason is None:
        out.skip("unwrapping", "the mesh has valid texture coordinates; --redo makes new ones")
    else:
        out.warn(f"{inputs.name}: its texture coordinates are not kept: {reason}")
    return reason is None


def _unwrapped(mesh, padding: int, options: Options, inputs: Inputs, out: Output):
    """Make new texture coordinates; returns the mesh, the failed attempts, and the twin (f,) of each face or -1."""
    import numpy as np

    from gdtool.geometry.meshes import QuadMesh
    from gdtool.stages.limits import require_time
    from gdtool.unwrap import pipeline
    from gdtool.unwrap.limits import SECONDS_PER_FACE
    from gdtool.unwrap.symmetry import copy_twin_corners

    needed, cure = SECONDS_PER_FACE * len(mesh.faces), "run gdtool remesh with fewer --faces before"
    require_time(needed, options.seconds, "--seconds", inputs.name, cure)
    request = pipeline.Request(
        size=options.size, padding=padding, max_stretch=options.max_stretch, seconds=options.seconds
    )
    with out.step("unwrap"):
        twin, corner = _twins(mesh, options, inputs, out)
        without_twin = np.flatnonzero(twin < 0)
        result = pipeline.unwrap(QuadMesh(mesh.vertices, mesh.faces[without_twin].astype(np.int64)), request)
    for what, why, seconds in result.skipped:
        out.skip(what, why, seconds)
    face_uvs = copy_twin_corners(result.face_uvs, without_twin, twin, corner)
    return QuadMesh(mesh.vertices, mesh.faces, result.uv, face_uvs), result.failed, twin


def _report(mesh, twin, kept: bool, options: Options, inputs: Inputs, out: Output) -> dict:
    """Measure the texture coordinates; warn of mirrored and overlapping charts."""
    from gdtool.geometry.meshes import QuadMesh
    from gdtool.unwrap.pipeline import figures, texels_per_unit

    wide, alone = _with_wide_indices(mesh), twin < 0
    # Faces that share a twin's texels on purpose are left out.
    report = figures(QuadMesh(mesh.vertices, wide.faces[alone], mesh.uv, wide.face_uvs[alone]))
    report["shared"] = float((twin >= 0).mean())
    report["texels_per_unit"] = texels_per_unit(mesh, options.size)
    if kept and report["mirrored"] > 0:
        out.warn(
            f"{inputs.name}: {report['mirrored']:.0%} of the surface is mirrored in its texture coordinates; "
            "tangent-space normal maps hold there in MikkTSpace alone, and --redo makes coordinates without "
            "mirrored charts"
        )
    if report["overlap"] > 0 and not kept:
        out.warn(f"{inputs.name}: charts overlap on {100 * report['overlap']:.2g} % of what they cover")
    return report


def _with_wide_indices(mesh):
    """Return the mesh with 64-bit indices, which the unwrapping computes with."""
    import numpy as np

    from gdtool.geometry.meshes import QuadMesh

    return QuadMesh(mesh.vertices, mesh.faces.astype(np.int64), mesh.uv, mesh.face_uvs.astype(np.int64))


def _twins(mesh, options: Options, inputs: Inputs, out: Output):
    """Return the mirror twin (f,) of each face and its corners (f, 4); -1 for none, and without --symmetry."""
    import numpy as np

    from gdtool.geometry.meshes import QuadMesh
    from gdtool.unwrap.symmetry import mirror_twins

    if options.symmetry == "none":
        return np.full(len(mesh.faces), -1), np.full(mesh.faces.shape, -1)
    twin, corner = mirror_twins(QuadMesh(mesh.vertices, mesh.faces.astype(np.int64)), "xyz".index(options.symmetry))
    if not (twin >= 0).any():
        out.warn(
            f"{inputs.name}: no face mirrors another along {options.symmetry}, so that none share texels; "
            f"gdtool remesh --symmetry {options.symmetry} makes faces that do"
        )
    return twin, corner


STAGE = Stage(name="unwrap", version=20, reads=("mesh", "mesh-file"), writes="atlas", Options=Options, run=run)
