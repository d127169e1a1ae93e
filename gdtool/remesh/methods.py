"""Choose how the faces of a mesh are made: by decimation, or as quads of a count, within a distance, or mirrored."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from gdtool.geometry import mesh_quality
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.simplify import SimplifyOptions, simplify
from gdtool.remesh.face_budget import MakeQuads, coarsest_within
from gdtool.remesh.limits import COUNT_TOLERANCE, QUADS_OF_A_PIECE, TRIANGLES_OF_A_PIECE
from gdtool.remesh.pipeline import remesh
from gdtool.remesh.symmetry import AXES, mirror_plane, remesh_mirrored
from gdtool.remesh.task import Record, Request, count_reason

PASSED_THROUGH = "passed through"  # the engine that the manifest names where nothing was remeshed
_DISTANCE_SAMPLES = 20000  # points of each surface for the distances in the report

Step = Callable[[str], AbstractContextManager]


@dataclass(frozen=True)
class Goal:
    """The faces that a mesh is to get.

    triangles: how many to decimate to, 0 for quads. max_deviation: largest distance from the surface; the fewest quads
    within it are sought; 0 makes request.quads. symmetry: "none", "auto", or the axis across which halves are mirrored.
    """

    request: Request
    triangles: int = 0
    max_deviation: float = 0.0
    symmetry: str = "none"


@dataclass
class MadeMesh:
    """A mesh, the record of how it was made, warnings, and (what, why) of skipped work."""

    mesh: QuadMesh
    record: Record
    warnings: list[str] = field(default_factory=list)
    skipped: list[tuple[str, str]] = field(default_factory=list)


def make_mesh(mesh: TriMesh, goal: Goal, step: Step) -> MadeMesh:
    """Make the faces of a clean triangle mesh in a unit box: decimated triangles, or quads.

    step: a context manager that times a named step.
    """
    return (_decimated if goal.triangles else _quads)(mesh, goal, step)


def passed_through(mesh: QuadMesh) -> MadeMesh:
    """Return the input's quads unchanged."""
    return MadeMesh(mesh, Record(engine=PASSED_THROUGH))


def repair_warnings(repairs: dict[str, int | bool], closed: bool) -> list[str]:
    """Describe what repair.clean() repaired, and an open surface, as sentences for warnings."""
    warnings = []
    if repairs:
        names = {name: name.replace("_", " ") for name in repairs}
        counts = (
            names[name] if isinstance(value, bool) else f"{value} {names[name]}" for name, value in repairs.items()
        )
        warnings.append("repaired " + ", ".join(counts))
    if not closed:
        warnings.append("the surface is open; its boundaries are kept")
    return warnings


def report_figures(made: MadeMesh, mesh: TriMesh) -> dict:
    """Compute the report: the record's figures, topology, shape, and distances to the triangles that were remeshed."""
    figures = made.record.figures | mesh_quality.topology_figures(made.mesh) | mesh_quality.shape_figures(made.mesh)
    if made.record.engine != PASSED_THROUGH:
        source = made.record.source
        figures |= mesh_quality.distance_figures(
            made.mesh.triangles,
            mesh,
            _DISTANCE_SAMPLES,
            closest_on_source=None if source is None else source.closest,
        )
    return figures


def count_warning(made: MadeMesh, faces: np.ndarray, goal: Goal) -> str | None:
    """Explain in a sentence why there are more or fewer faces than requested; None where the count is met.

    faces (f, 3): the triangles that were remeshed. Fewer triangles than goal.triangles are fine.
    """
    count = len(made.mesh.faces)
    asked = goal.triangles or (count if goal.max_deviation else goal.request.quads)
    if made.record.engine == PASSED_THROUGH or abs(count / asked - 1) <= COUNT_TOLERANCE:
        return None
    if goal.triangles and count <= asked:
        return None
    of_a_piece = TRIANGLES_OF_A_PIECE if goal.triangles else QUADS_OF_A_PIECE
    why = count_reason(faces, count, asked, made.record.failed, of_a_piece)
    return f"{count} faces, not the {asked} asked for: {why}"


def _decimated(mesh: TriMesh, goal: Goal, step: Step) -> MadeMesh:
    """Decimate to goal.triangles triangles."""
    options = SimplifyOptions(seconds=goal.request.seconds, low_deviation=True)
    with step("simplify"):
        simplified, _, report = simplify(mesh, goal.triangles, options=options)
    record = Record(engine=report.method, figures={"simplify_error": report.error})
    corners = np.concatenate([simplified.faces, np.full((len(simplified.faces), 1), -1)], 1)
    return MadeMesh(
        QuadMesh(simplified.vertices, corners),
        record,
        [f"simplify: {report.failed}"] if report.failed is not None else [],
        [("symmetry", "--triangles decimates the whole")] if goal.symmetry != "none" else [],
    )


def _quads(mesh: TriMesh, goal: Goal, step: Step) -> MadeMesh:
    """Make quads of the requested count, or the fewest within goal.max_deviation."""
    make_quads, figures, skipped = _with_symmetry(mesh, goal, step)
    warnings = []
    if goal.max_deviation:
        quads, record, reached = coarsest_within(mesh, goal.request, goal.max_deviation, make_quads)
        if reached > goal.max_deviation:
            warnings.append(
                f"{reached:.2g} from the surface with {len(quads.faces)} quads, farther than --max-deviation; "
                "allow more --faces"
            )
    else:
        quads, record = make_quads(mesh, goal.request)
    record.figures |= figures
    return MadeMesh(quads, record, warnings, skipped)


def _with_symmetry(
    mesh: TriMesh, goal: Goal, step: Step
) -> tuple[MakeQuads, dict[str, float | str], list[tuple[str, str]]]:
    """Find the mirror plane, and return the function that makes the quads, figures of the plane, and skipped work."""
    if goal.symmetry == "none":
        return remesh, {}, []
    with step("find the mirror plane"):
        axis, distances = mirror_plane(mesh, goal.request.quads, AXES if goal.symmetry == "auto" else goal.symmetry)
    figures: dict[str, float | str] = {f"mirror_{name}_deviation": value for name, value in distances.items()}
    if axis is not None:
        return partial(remesh_mirrored, axis=axis), figures, []
    why = "no half is the other's mirror image: " + ", ".join(
        f"{value:.2g} apart across {name}" for name, value in distances.items()
    )
    return remesh, figures | {"symmetry": "none"}, [("symmetry", why)]
