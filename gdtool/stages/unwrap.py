"""Mesh to atlas: few charts, cut along quad edges and creases, laid flat without mirroring and packed for mip-mapping.

Use it after remesh, or on a mesh file of your own. Texture coordinates that a mesh already has are kept when they are
valid, unless --redo. With --symmetry the halves of a symmetric mesh share their texels. layout.png shows the charts,
checkerboard.png the mesh under them.

Example:
  gdtool unwrap cat.asset/mesh --size 2048
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.child import prepare
from gdtool.core.errors import InputError
from gdtool.core.kinds import AtlasContent
from gdtool.core.stage import MOST_SECONDS, Inputs, Output, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of unwrap."""

    size: Annotated[int, Meta(ge=16, le=65536, description="texture size in texels that the padding is for")] = 2048
    mip_safe: Annotated[
        int, Meta(ge=1, le=65536, description="charts stay a texel apart down to the mip level of this size")
    ] = 256
    padding: Annotated[
        int, Meta(ge=0, le=1024, description="texels between charts at --size; 0: what --mip-safe needs")
    ] = 0
    max_stretch: Annotated[float, Meta(gt=1, le=100, description="a chart with more L2 stretch is cut")] = 1.1
    symmetry: Annotated[
        Literal["none", "x", "y", "z"], Meta(description="faces that mirror others along this axis share their texels")
    ] = "none"
    redo: Annotated[bool, Meta(description="make new texture coordinates even where the mesh has valid ones")] = False
    seconds: Annotated[
        float,
        Meta(
            gt=0,
            le=MOST_SECONDS,
            description="time limit; charts are shaped in the first 60 % of it, what is left then goes in simpler ways; after twice the limit and 5 s the run fails",
        ),
    ] = 120.0


# Of the quickest way, charts by the side that faces look at, with what comes before and after (400,000 quads, two cores
# of 2.5 GHz).
SECONDS_PER_FACE = 1.2e-4


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Unwrap one mesh. Raises ResourceError where it takes longer than --seconds by far (stages/limits.py)."""
    from gdtool.stages.limits import held_to

    cure = f"raise --seconds to {max(round(2 * options.seconds), 1)}, or run gdtool remesh with fewer --faces before"
    with held_to(options.seconds, "--seconds", inputs.name, cure):
        _run(inputs, options, out)


def _run(inputs: Inputs, options: Options, out: Output) -> None:
    from gdtool.geometry.simplify import CHILD_MODULES, reduced

    prepare(reduced, CHILD_MODULES)  # for unwrap()'s first child, while the mesh is read

    import numpy as np

    from gdtool.folders.mesh import QuadMesh, write_mesh
    from gdtool.geometry import topology
    from gdtool.images.io import write_png
    from gdtool.stages.limits import require_time
    from gdtool.unwrap import preview as unwrap_preview
    from gdtool.unwrap.pipeline import Request, figures, islands, unwrap
    from gdtool.unwrap.symmetry import with_twins

    with out.step("read"):
        mesh, matrix = _read(inputs, out)
    padding = options.padding or max(-(-options.size // min(options.mip_safe, options.size)), 1)
    kept, tried = False, []
    if mesh.uv is not None and not options.redo:
        reason = _invalid(mesh)
        kept = reason is None
        if kept:
            out.skip("unwrapping", "the mesh has valid texture coordinates; --redo makes new ones")
        else:
            out.warn(f"{inputs.name}: its texture coordinates are not kept: {reason}")
    if not kept:
        require_time(
            SECONDS_PER_FACE * len(mesh.faces),
            options.seconds,
            "--seconds",
            inputs.name,
            "run gdtool remesh with fewer --faces before",
        )
        request = Request(size=options.size, padding=padding, max_stretch=options.max_stretch, seconds=options.seconds)
        with out.step("unwrap"):
            twin, corner = _twins(mesh, options, inputs, out)
            own = np.flatnonzero(twin < 0)
            result = unwrap(mesh.vertices, mesh.faces[own].astype(np.int64), request)
        tried = result.failed
        for what, why, seconds in result.skipped:
            out.skip(what, why, seconds)
        mesh = QuadMesh(mesh.vertices, mesh.faces, result.uv, with_twins(result.face_uvs, own, twin, corner))
    else:
        twin = np.full(len(mesh.faces), -1)
    with out.step("measure"):
        faces, face_uvs = mesh.faces.astype(np.int64), mesh.face_uvs.astype(np.int64)
        # Of those that share texels on purpose, the ones that were laid out.
        report = figures(mesh.vertices, faces[twin < 0], mesh.uv, face_uvs[twin < 0])
        report["shared"] = float((twin >= 0).mean())
        report["texels_per_unit"] = _density(mesh, options.size)
        if kept and report["mirrored"] > 0:
            out.warn(
                f"{inputs.name}: {report['mirrored']:.0%} of the surface is mirrored in its texture coordinates; tangent-space "
                "normal maps hold there in MikkTSpace alone, and --redo makes coordinates without mirrored charts"
            )
        if report["overlap"] > 0 and not kept:
            out.warn(f"{inputs.name}: charts overlap on {100 * report['overlap']:.2g} % of what they cover")
    with out.step("preview"):
        chart = islands(mesh.vertices, faces, face_uvs)[0]
        write_png(out.path("layout.png"), unwrap_preview.layout(faces, mesh.uv, face_uvs, chart))
        write_png(
            out.path("checkerboard.png"), unwrap_preview.checkerboard(mesh.vertices, faces, mesh.uv, face_uvs, chart)
        )
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


def _twins(mesh, options: Options, inputs: Inputs, out: Output):
    """What mirror_twins says; nothing has a twin without --symmetry."""
    import numpy as np

    from gdtool.unwrap.symmetry import mirror_twins

    if options.symmetry == "none":
        return np.full(len(mesh.faces), -1), np.full(mesh.faces.shape, -1)
    twin, corner = mirror_twins(mesh.vertices, mesh.faces.astype(np.int64), "xyz".index(options.symmetry))
    if not (twin >= 0).any():
        out.warn(
            f"{inputs.name}: no face mirrors another along {options.symmetry}, so that none share texels; "
            f"gdtool remesh --symmetry {options.symmetry} makes faces that do"
        )
    return twin, corner


def _path(inputs: Inputs):
    return getattr(inputs.main, "path", inputs.main)


def _read(inputs: Inputs, out: Output):
    """The mesh in the normalised frame, faces without an area or a repeated corner left out, and the (4, 4) matrix
    back."""
    import numpy as np

    from gdtool.folders.mesh import QuadMesh, read_mesh, read_obj
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

    main = inputs.main
    if hasattr(main, "content"):
        mesh, matrix = read_mesh(main), np.array(main.content.source_from_world).reshape(4, 4)
    else:
        if not isinstance(main, str) and main.suffix.lower() == ".obj":
            mesh = read_obj(main)
        else:
            mesh = _from_scene(main, inputs, out)
        matrix = None
    if not np.isfinite(mesh.vertices).all():
        raise InputError(
            _path(inputs),
            f"vertex {int(np.argmin(np.isfinite(mesh.vertices).all(1)))} is not finite",
            "run gdtool remesh on the model it was made from",
        )
    used = np.unique(mesh.faces[mesh.faces >= 0])
    extent = float(np.ptp(mesh.vertices[used], 0).max()) if len(used) else 0.0
    if not 1e-150 < extent < 1e150:
        raise InputError(
            _path(inputs), f"its longest side is {extent:g}, which cannot be computed with", "scale it to about 1"
        )
    if matrix is None:
        matrix = unit_box(mesh.vertices[used])
        mesh = QuadMesh(transform_points(invert_similarity(matrix), mesh.vertices), mesh.faces, mesh.uv, mesh.face_uvs)
    return _without_degenerate(mesh, inputs, out), matrix


def _from_scene(main, inputs: Inputs, out: Output):
    """Triangles of any mesh file, vertices that only texture coordinates tell apart joined again."""
    import numpy as np

    from gdtool.assets.load import load_scene
    from gdtool.folders.mesh import QuadMesh
    from gdtool.geometry.rows import unique_rows

    scene = load_scene(main)
    for text in scene.notes:
        out.warn(f"{inputs.name}: {text}")
    if not len(scene.faces):
        raise InputError(_path(inputs), "has no faces", "name a file with a mesh, not points or lines")
    vertices, _, joined = unique_rows(scene.vertices)
    filler = np.full((len(scene.faces), 1), -1, np.int32)
    corners = np.concatenate([scene.faces, filler], 1).astype(np.int32)
    uv = scene.uvs[0] if scene.uvs else None
    return QuadMesh(
        vertices, np.concatenate([joined[scene.faces], filler], 1).astype(np.int32), uv, None if uv is None else corners
    )


def _without_degenerate(mesh, inputs: Inputs, out: Output):
    import numpy as np

    from gdtool.folders.mesh import QuadMesh
    from gdtool.geometry.mesh_quality import polygon_normals

    corners = np.where(mesh.faces < 0, -1 - np.arange(4), mesh.faces)
    ordered = np.sort(corners, 1)
    good = (ordered[:, 1:] != ordered[:, :-1]).all(1) & (polygon_normals(mesh.vertices, mesh.faces)[1] > 0)
    if not good.any():
        raise InputError(_path(inputs), "no face has an area", "name a mesh whose faces span a surface")
    if good.all():
        return mesh
    out.warn(f"{inputs.name}: left out {int((~good).sum())} faces without area")
    return QuadMesh(mesh.vertices, mesh.faces[good], mesh.uv, None if mesh.face_uvs is None else mesh.face_uvs[good])


def _invalid(mesh) -> str | None:
    """Why texture coordinates cannot be kept; None when they can."""
    import numpy as np

    from gdtool.unwrap.pipeline import figures

    if not np.isfinite(mesh.uv).all():
        return "some are not finite"
    if mesh.uv.min() < -1e-6 or mesh.uv.max() > 1 + 1e-6:
        return "some lie outside the unit square"
    found = figures(mesh.vertices, mesh.faces.astype(np.int64), mesh.uv, mesh.face_uvs.astype(np.int64))
    if found["overlap"] > 0.001:
        return f"they overlap on {100 * found['overlap']:.1f} % of what they cover"
    if found["degenerate"] > 0.01:
        return f"{100 * found['degenerate']:.1f} % of the faces have no area there"
    return None


def _density(mesh, size: int) -> float:
    import numpy as np

    from gdtool.geometry.mesh_quality import polygon_normals

    flat = np.concatenate([mesh.uv, np.zeros((len(mesh.uv), 1))], 1)
    area = polygon_normals(mesh.vertices, mesh.faces)[1].sum()
    return float(size * (polygon_normals(flat, mesh.face_uvs)[1].sum() / area) ** 0.5)


STAGE = Stage(name="unwrap", version=20, reads=("mesh", "mesh-file"), writes="atlas", Options=Options, run=run)
