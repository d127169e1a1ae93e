"""Surface to clean quads: about as many as asked, along creases and flat parts, watertight where the surface is.

Use it after reconstruct, or on any mesh file (.obj, .ply, .stl, .glb) whose triangles you want to edit, subdivide or
animate. Bevels that marching cubes left are drawn out to the creases they cut off. A mesh that already meets the
request is passed through. --triangles N decimates instead; --symmetry auto mirrors one half where the surface allows
it.

Example:
  gdtool remesh cat.asset/surface --faces 20000
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.child import prepare
from gdtool.core.errors import InputError, UsageError
from gdtool.core.kinds import MeshContent
from gdtool.core.stage import MOST_SECONDS, Inputs, Output, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of remesh."""

    faces: Annotated[int, Meta(ge=16, le=2_000_000, description="quads to make, met within 3 %")] = 20000
    quad_size: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="mean side of the quads, as a share of the longest side, instead of --faces; 0: --faces",
        ),
    ] = 0.0
    max_deviation: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="the fewest quads, up to --faces, that stay within this share of the longest "
            "side of the surface; 0: --faces",
        ),
    ] = 0.0
    triangles: Annotated[
        int, Meta(ge=0, le=10_000_000, description="decimate to this many triangles instead of making quads; 0: quads")
    ] = 0
    crease_angle: Annotated[
        float, Meta(ge=0, le=180, description="edges that turn by more degrees are kept sharp; 0: none")
    ] = 30.0
    restore_creases: Annotated[bool, Meta(description="draw out the bevels of marching cubes to sharp creases")] = True
    symmetry: Annotated[
        Literal["none", "auto", "x", "y", "z"],
        Meta(
            description="make one half and mirror it where the surface is its own mirror image across the middle of this axis; auto: of the best of the three"
        ),
    ] = "none"
    engine: Annotated[
        Literal["auto", "instant-meshes", "quadriflow", "split"],
        Meta(description="auto is instant-meshes with fallbacks; quadriflow needs pyQuadriFlow; split needs no engine"),
    ] = "auto"
    smooth_iterations: Annotated[
        int, Meta(ge=0, le=100, description="rounds of evening out the quads on the surface")
    ] = 5
    seconds: Annotated[
        float,
        Meta(
            gt=0,
            le=MOST_SECONDS,
            description="time limit; engines are tried in the first 70 % of it, what is not done by then is paired triangles; after twice the limit and 5 s the run fails",
        ),
    ] = 120.0
    keep: Annotated[bool, Meta(description="pass a mesh through that already meets the request")] = True


# Of the quickest way, paired triangles, with what comes before and after (400,000 quads of procedural:7, two cores of
# 2.5 GHz).
SECONDS_PER_QUAD = 1.1e-4

# Share of the longest side: a closed surface would need billions of smaller quads.
LEAST_QUAD_SIZE = 1e-5

# The package that each engine needs, by its module, and how to get it.
_ENGINE_PACKAGES = {
    "instant-meshes": ("pynanoinstantmeshes", "pip install pynanoinstantmeshes, or use --engine split"),
    "quadriflow": ("pyQuadriFlow", "pip install 'gdtool[quadriflow]', or use --engine auto"),
}


def check(inputs: Inputs, options: Options) -> None:
    """Raise what --quad-size and the package of --engine would stop the run with."""
    from gdtool.stages import early

    if 0 < options.quad_size < LEAST_QUAD_SIZE:
        raise UsageError(
            f"--quad-size {options.quad_size:g}",
            f"is smaller than {LEAST_QUAD_SIZE:g} of the longest side",
            "use 0 to go by --faces",
        )

    if options.engine in _ENGINE_PACKAGES and not options.triangles:
        module, cure = _ENGINE_PACKAGES[options.engine]
        early.require_installed(module, f"--engine {options.engine}", cure)


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Remesh one surface or mesh file. Raises ResourceError where it takes longer than --seconds by far
    (stages/limits.py)."""
    from gdtool.stages.limits import held_to

    cure = f"raise --seconds to {max(round(SECONDS_PER_QUAD * options.faces), round(2 * options.seconds), 1)}, or lower --faces"
    with held_to(options.seconds, "--seconds", inputs.name, cure):
        _run(inputs, options, out)


def _run(inputs: Inputs, options: Options, out: Output) -> None:
    from gdtool.geometry.simplify import CHILD_MODULES, reduced

    prepare(reduced, CHILD_MODULES)  # for remesh()'s first child, while the mesh is read

    import numpy as np

    from gdtool.folders.mesh import QuadMesh, write_mesh
    from gdtool.geometry import mesh_quality, repair, shells
    from gdtool.geometry.topology import triangulated
    from gdtool.remesh.task import QUADS_OF_A_PIECE, Record, count_reason
    from gdtool.stages.limits import require_time

    with out.step("read"):
        vertices, faces, matrix, quads = _read(inputs, out)
    options = _counted(vertices, faces, options, out)
    if (
        quads is not None
        and options.keep
        and not options.triangles
        and not options.max_deviation
        and options.symmetry == "none"
        and _meets(quads, options)
    ):
        out.skip("remeshing", f"the mesh already is {len(quads)} quads, closed and manifold")
        found_vertices, found, record = vertices, quads, Record(engine="passed through")
    else:
        with out.step("clean"):
            vertices, faces, repairs, closed = repair.clean(vertices, faces, _path(inputs))
        if repairs:
            out.warn(
                f"{inputs.name}: repaired "
                + ", ".join(
                    f"{value} {name.replace('_', ' ')}" if not isinstance(value, bool) else name.replace("_", " ")
                    for name, value in repairs.items()
                )
            )
        if not closed:
            out.warn(f"{inputs.name}: the surface is open; its boundaries are kept")
        if not options.triangles:
            require_time(SECONDS_PER_QUAD * options.faces, options.seconds, "--seconds", inputs.name, "lower --faces")
        if inner := shells.told(vertices, faces):
            out.warn(f"{inputs.name}: {inner}")
        found_vertices, found, record = (_decimated if options.triangles else _quads)(vertices, faces, options, out)
    with out.step("measure"):
        figures = (
            record.figures
            | mesh_quality.topology_figures(found_vertices, found)
            | mesh_quality.shape_figures(found_vertices, found)
        )
        if record.engine != "passed through":
            figures |= mesh_quality.distance_figures(
                found_vertices, triangulated(found)[0], vertices, faces, 20000, source=record.source
            )
    asked = options.triangles or (len(found) if options.max_deviation else options.faces)
    if (
        record.engine != "passed through"
        and abs(len(found) / asked - 1) > 0.03
        and (not options.triangles or len(found) > asked)
    ):
        why = count_reason(faces, len(found), asked, record.failed, 4 if options.triangles else QUADS_OF_A_PIECE)
        out.warn(f"{inputs.name}: {len(found)} faces, not the {asked} asked for: {why}")
    with out.step("write"):
        write_mesh(out, QuadMesh(found_vertices, found.astype(np.int32)))
    is_quad = found[:, 3] >= 0
    out.content = MeshContent(
        vertices=len(found_vertices),
        quads=int(is_quad.sum()),
        triangles=int((~is_quad).sum()),
        watertight=bool(figures["watertight"]),
        engine=record.engine,
        tried=tuple(record.failed),
        report=figures,
        source_from_world=tuple(float(x) for x in matrix.ravel()),
    )


def _counted(vertices, faces, options: Options, out: Output) -> Options:
    """Options with --quad-size turned into a number of faces."""
    from gdtool.geometry.normals import face_normals

    if not options.quad_size or options.triangles:
        return options
    lowest, highest = 16, 2_000_000
    asked = round(face_normals(vertices, faces)[1].sum() / options.quad_size**2)
    if not lowest <= asked <= highest:
        out.warn(f"--quad-size {options.quad_size:g} asks for {asked} faces; {lowest} to {highest} can be made")
    return msgspec.structs.replace(options, faces=min(max(asked, lowest), highest))


def _path(inputs: Inputs):
    return getattr(inputs.main, "path", inputs.main)


def _read(inputs: Inputs, out: Output):
    """Vertices and triangles in the normalised frame, the (4, 4) matrix back to the source's, and quads if it is all
    quads."""
    import numpy as np

    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
    from gdtool.geometry.repair import check
    from gdtool.geometry.topology import compact

    main, quads = inputs.main, None
    if hasattr(main, "content"):
        from gdtool.folders.surface import read_surface

        surface = read_surface(main)
        return (
            surface.vertices,
            surface.faces.astype(np.int64),
            np.array(main.content.source_from_world).reshape(4, 4),
            None,
        )
    mesh = None
    if not isinstance(main, str) and main.suffix.lower() == ".obj":
        from gdtool.folders.mesh import read_obj
        from gdtool.geometry.topology import triangulated

        mesh = read_obj(main)
        vertices, faces = mesh.vertices, triangulated(mesh.faces)[0].astype(np.int64)
        if (mesh.faces >= 0).all():
            quads = mesh.faces.astype(np.int64)
    else:
        from gdtool.assets.load import load_scene

        scene = load_scene(main)
        for text in scene.notes:
            out.warn(f"{inputs.name}: {text}")
        vertices, faces = scene.vertices, scene.faces.astype(np.int64)
    check(vertices, faces, _path(inputs))
    kept, faces = compact(vertices, faces)
    extent = float(np.ptp(kept, 0).max())
    if not 1e-150 < extent < 1e150:
        raise InputError(
            _path(inputs), f"its longest side is {extent:g}, which cannot be computed with", "scale it to about 1"
        )
    matrix = unit_box(kept)
    if quads is not None:
        _, quads = compact(vertices, quads)
    return transform_points(invert_similarity(matrix), kept), faces, matrix, quads


def _meets(quads, options: Options) -> bool:
    from gdtool.geometry import topology

    return abs(len(quads) / options.faces - 1) <= 0.03 and topology.is_watertight(quads) and topology.is_manifold(quads)


def _decimated(vertices, faces, options: Options, out: Output):
    import numpy as np

    from gdtool.geometry.simplify import simplify
    from gdtool.remesh.task import Record

    if options.symmetry != "none":
        out.skip("symmetry", "--triangles decimates the whole")
    with out.step("simplify"):
        vertices, faces, _, report = simplify(vertices, faces, options.triangles, seconds=options.seconds, near=True)
    if "failed" in report:
        out.warn(f"simplify: {report['failed']}")
    record = Record(engine=report["method"], figures={"simplify_error": report["error"]})
    return vertices, np.concatenate([faces, np.full((len(faces), 1), -1)], 1), record


def _quads(vertices, faces, options: Options, out: Output):
    from gdtool.remesh.face_budget import coarsest_within
    from gdtool.remesh.task import Request

    request = Request(
        quads=options.faces,
        crease_degrees=options.crease_angle,
        engine=options.engine,
        seconds=options.seconds,
        smooth_iterations=options.smooth_iterations,
        restore_creases=options.restore_creases,
    )
    way, apart = _way(vertices, faces, options, out)
    if options.max_deviation:
        vertices, quads, record, reached = coarsest_within(vertices, faces, request, options.max_deviation, way)
        if reached > options.max_deviation:
            out.warn(
                f"{reached:.2g} from the surface with {len(quads)} quads, farther than --max-deviation; allow more --faces"
            )
    else:
        vertices, quads, record = way(vertices, faces, request)
    for name, seconds in record.seconds.items():
        out.seconds[name] = out.seconds.get(name, 0.0) + seconds
    record.figures |= apart
    return vertices, quads, record


def _way(vertices, faces, options: Options, out: Output):
    """What makes the quads, and figures of the mirror plane that was looked for."""
    from functools import partial

    from gdtool.remesh.pipeline import remesh
    from gdtool.remesh.symmetry import AXES, mirror_plane, remesh_mirrored

    if options.symmetry == "none":
        return remesh, {}
    with out.step("find the mirror plane"):
        axis, apart = mirror_plane(
            vertices, faces, options.faces, AXES if options.symmetry == "auto" else options.symmetry
        )
    figures = {f"mirror_{name}_deviation": value for name, value in apart.items()}
    if axis is None:
        out.skip(
            "symmetry",
            "no half is the other's mirror image: "
            + ", ".join(f"{value:.2g} apart across {name}" for name, value in apart.items()),
        )
        return remesh, figures | {"symmetry": "none"}
    return partial(remesh_mirrored, axis=axis), figures


STAGE = Stage(
    name="remesh", version=37, reads=("surface", "mesh-file"), writes="mesh", Options=Options, run=run, check=check
)
