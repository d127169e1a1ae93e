"""Turn a surface into clean quads along creases and flat parts, watertight where the surface is.

Use it after reconstruct, or on any mesh file (.obj, .ply, .stl, .glb) whose triangles you want to edit, subdivide or
animate. Bevels that marching cubes left are restored to sharp creases. A mesh that already meets the request is passed
through. --triangles N decimates instead; --symmetry auto mirrors one half where the surface is symmetric.

Example:
  gdtool remesh cat.asset/surface --faces 20000
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.child import prepare
from gdtool.core.errors import UsageError
from gdtool.core.kinds import MeshContent
from gdtool.core.stage import MOST_SECONDS, Inputs, Output, Stage

if TYPE_CHECKING:
    from gdtool.geometry.meshes import TriMesh


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool remesh`."""

    faces: Annotated[int, Meta(ge=16, le=2_000_000, description="Number of quads, met within 3 %.")] = 20000
    quad_size: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="Mean edge length of the quads as a share of the longest side, instead of --faces; 0: --faces.",
        ),
    ] = 0.0
    max_deviation: Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="Make the fewest quads, up to --faces, that stay within this distance of the surface, a share "
            "of its longest side; 0: --faces.",
        ),
    ] = 0.0
    triangles: Annotated[
        int, Meta(ge=0, le=10_000_000, description="Decimate to so many triangles instead of making quads; 0: quads.")
    ] = 0
    crease_angle: Annotated[
        float, Meta(ge=0, le=180, description="Keep edges sharp whose faces turn by more degrees than this; 0: none.")
    ] = 30.0
    restore_creases: Annotated[bool, Meta(description="Sharpen bevels that marching cubes leave at creases.")] = True
    symmetry: Annotated[
        Literal["none", "auto", "x", "y", "z"],
        Meta(
            description="Remesh one half and mirror it, where the surface mirrors itself across the middle of this "
            "axis. auto: the axis that fits best."
        ),
    ] = "none"
    engine: Annotated[
        Literal["auto", "instant-meshes", "quadriflow", "split"],
        Meta(description="auto: instant-meshes with fallbacks. quadriflow needs gdtool[quadriflow], split nothing."),
    ] = "auto"
    smooth_iterations: Annotated[
        int, Meta(ge=0, le=100, description="Rounds of smoothing the quads on the surface.")
    ] = 5
    seconds: Annotated[
        float,
        Meta(
            gt=0,
            le=MOST_SECONDS,
            description="Time limit. Engines are tried in the first 70 % of it; parts that are not done by then are "
            "made of paired triangles. After twice the limit and 5 s the run fails.",
        ),
    ] = 120.0
    keep: Annotated[bool, Meta(description="Pass a mesh through that already meets the request.")] = True


def check(inputs: Inputs, options: Options) -> None:
    """Raise UsageError or ResourceError for a --quad-size too small, or an --engine that is not installed."""
    from gdtool.remesh.limits import ENGINE_PACKAGES, MIN_QUAD_SIZE
    from gdtool.stages import early

    if 0 < options.quad_size < MIN_QUAD_SIZE:
        fact = f"is smaller than {MIN_QUAD_SIZE:g} of the longest side"
        raise UsageError(f"--quad-size {options.quad_size:g}", fact, "use 0 to go by --faces")
    if options.engine in ENGINE_PACKAGES and not options.triangles:
        module, cure = ENGINE_PACKAGES[options.engine]
        early.require_installed(module, f"--engine {options.engine}", cure)


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Remesh one surface or mesh file; raise ResourceError where it takes much longer than --seconds."""
    from gdtool.remesh.limits import SECONDS_PER_QUAD
    from gdtool.stages.limits import limited_to

    enough = max(round(SECONDS_PER_QUAD * options.faces), round(2 * options.seconds), 1)
    with limited_to(options.seconds, "--seconds", inputs.name, f"raise --seconds to {enough}, or lower --faces"):
        _remesh(inputs, options, out)


def _remesh(inputs: Inputs, options: Options, out: Output) -> None:
    """Remesh one surface or mesh file and write the mesh."""
    from gdtool.geometry.simplify import CHILD_MODULES, collapse_in_child

    prepare(collapse_in_child, CHILD_MODULES)  # for the first child of remesh(), while the mesh is read

    import numpy as np

    from gdtool.folders.mesh import write_mesh
    from gdtool.geometry.meshes import QuadMesh, TriMesh
    from gdtool.remesh.face_budget import is_finished
    from gdtool.remesh.methods import count_warning, make_mesh, passed_through, report_figures
    from gdtool.stages.mesh_source import read_triangles

    with out.step("read"):
        vertices, faces, matrix, quads = read_triangles(inputs, out)
    mesh = TriMesh(vertices, faces)
    options = _with_count(mesh, options, out)
    is_plain = not options.triangles and not options.max_deviation and options.symmetry == "none"
    if quads is not None and options.keep and is_plain and is_finished(quads, options.faces):
        out.skip("remeshing", f"the mesh already is {len(quads)} quads, closed and manifold")
        made = passed_through(QuadMesh(vertices, quads))
    else:
        mesh = _clean(mesh, inputs, options, out)
        made = make_mesh(mesh, _goal(options), out.step)
        for what, why in made.skipped:
            out.skip(what, why)
        for text in made.warnings:
            out.warn(text)
        for name, seconds in made.record.seconds.items():
            out.seconds[name] = out.seconds.get(name, 0.0) + seconds
    with out.step("measure"):
        figures = report_figures(made, mesh)
    if warning := count_warning(made, mesh.faces, _goal(options)):
        out.warn(f"{inputs.name}: {warning}")
    with out.step("write"):
        write_mesh(out, QuadMesh(made.mesh.vertices, made.mesh.faces.astype(np.int32)))
    is_quad = made.mesh.is_quad
    out.content = MeshContent(
        vertices=len(made.mesh.vertices),
        quads=int(is_quad.sum()),
        triangles=int((~is_quad).sum()),
        watertight=bool(figures["watertight"]),
        engine=made.record.engine,
        tried=tuple(made.record.failed),
        report=figures,
        source_from_world=tuple(float(x) for x in matrix.ravel()),
    )


def _with_count(mesh: TriMesh, options: Options, out: Output) -> Options:
    """Return options with --quad-size converted to a number of faces."""
    from gdtool.remesh.face_budget import quads_of_size
    from gdtool.remesh.limits import MAX_QUADS, MIN_QUADS

    if not options.quad_size or options.triangles:
        return options
    count = quads_of_size(mesh, options.quad_size)
    possible = min(max(count, MIN_QUADS), MAX_QUADS)
    if count != possible:
        out.warn(f"--quad-size {options.quad_size:g} asks for {count} faces; {MIN_QUADS} to {MAX_QUADS} can be made")
    return msgspec.structs.replace(options, faces=possible)


def _clean(mesh: TriMesh, inputs: Inputs, options: Options, out: Output) -> TriMesh:
    """Repair a mesh; warn of each repair, of open surfaces and of enclosed bodies."""
    from gdtool.geometry import repair
    from gdtool.geometry.enclosed_bodies import enclosed_bodies_warning
    from gdtool.remesh.limits import SECONDS_PER_QUAD
    from gdtool.remesh.methods import repair_warnings
    from gdtool.stages.limits import require_time
    from gdtool.stages.mesh_source import source_path

    with out.step("clean"):
        cleaned = repair.clean(mesh, source_path(inputs))
    for text in repair_warnings(cleaned.repairs, cleaned.is_closed):
        out.warn(f"{inputs.name}: {text}")
    if not options.triangles:
        require_time(SECONDS_PER_QUAD * options.faces, options.seconds, "--seconds", inputs.name, "lower --faces")
    if inner := enclosed_bodies_warning(cleaned.mesh):
        out.warn(f"{inputs.name}: {inner}")
    return cleaned.mesh


def _goal(options: Options):
    """Convert the options to the Goal that remesh.methods reads."""
    from gdtool.remesh.methods import Goal
    from gdtool.remesh.task import Request

    same = {name: getattr(options, name) for name in ("engine", "seconds", "smooth_iterations", "restore_creases")}
    request = Request(quads=options.faces, crease_degrees=options.crease_angle, **same)
    return Goal(request, options.triangles, options.max_deviation, options.symmetry)


STAGE = Stage(
    name="remesh", version=37, reads=("surface", "mesh-file"), writes="mesh", Options=Options, run=run, check=check
)
