"""Read the triangles of a result and of its reference, bring both into one frame, and measure how far they differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.assets.load import load_scene
from gdtool.cameras import Camera
from gdtool.core.errors import UsageError
from gdtool.core.folder import Folder
from gdtool.core.kinds import AssetContent
from gdtool.core.sources import Source
from gdtool.evaluation.references import MODEL, kind_of
from gdtool.folders.mesh import read_mesh, read_obj
from gdtool.folders.surface import read_surface
from gdtool.geometry import metrics
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.topology import triangulated

Figures = dict[str, bool | int | float | str]

IDENTITY_TOLERANCE = 1e-12  # of the entries of a source_from_world that counts as the identity


@dataclass(frozen=True)
class Shape:
    """Hold triangles and the frame that they are in.

    vertices (v, 3), faces (t, 3). quads: how many quads were cut into triangles. source_from_world: (4, 4), from the
    normalised frame to the source's; None for a file, which does not say. in_source_frame: the vertices are in the
    source's frame, not in the normalised one.
    """

    vertices: np.ndarray
    faces: np.ndarray
    quads: int = 0
    source_from_world: np.ndarray | None = None
    in_source_frame: bool = False


@dataclass(frozen=True)
class ShapeOptions:
    """Choose how two shapes are compared.

    frame: how a model file is brought into the result's frame, "auto", "source", "box" or "same" (see aligned_truth).
    samples: number of points drawn on each surface. seed: of their random positions. threshold: the distance that
    counts as a match in the F-score, in shares of the reference's largest extent. syncdreamer: compute the figures of
    the published SyncDreamer protocol too.
    """

    frame: str
    samples: int
    threshold: float
    syncdreamer: bool
    seed: int


def read_shape(source: Source) -> Shape:
    """Read the triangles of a model file or of a folder that has some. Raises InputError."""
    if not isinstance(source, Folder):
        scene = load_scene(source)
        return Shape(scene.vertices, scene.faces)
    matrix = np.array(source.content.source_from_world).reshape(4, 4)
    if source.kind == "surface":
        surface = read_surface(source)
        return Shape(surface.vertices, surface.faces, 0, matrix)
    if source.kind in ("mesh", "atlas"):
        mesh = read_mesh(source)
        return Shape(mesh.vertices, triangulated(mesh.faces)[0], int(mesh.is_quad.sum()), matrix)
    if source.kind == "asset":
        # An engine shows the .glb, but only the .obj has the quads.
        scene = load_scene(source.file("asset.glb"))
        quads = int(read_obj(source.file("asset.obj")).is_quad.sum())
        in_source_frame = source.content_as(AssetContent).frame == "source"
        return Shape(scene.vertices, scene.faces, quads, matrix, in_source_frame)
    scene = load_scene(source.file("source.glb"))  # in the frame of the views that it lies beside
    return Shape(scene.vertices, scene.faces, 0, matrix)


def counts(shape: Shape) -> Figures:
    """Count distinct vertices, triangles and quads, and tell whether the surface is closed."""
    mesh = TriMesh(shape.vertices, shape.faces)
    return {
        "vertices": len(np.unique(metrics.weld_faces(mesh))),
        "faces": len(shape.faces) - shape.quads,
        "quads": shape.quads,
        "watertight": metrics.is_closed(mesh),
    }


def normalised_vertices(shape: Shape) -> np.ndarray:
    """Return the vertices in the normalised frame of the shape's folder; those of a file as they are."""
    if not shape.in_source_frame or shape.source_from_world is None:
        return shape.vertices
    return transform_points(invert_similarity(shape.source_from_world), shape.vertices)


def aligned_truth(truth: Shape, result: Shape, frame: str) -> np.ndarray:
    """Return the vertices of a model file in the frame that the result is measured in.

    "source" applies the inverse of the result's source_from_world, "box" centres the bounding box and scales its
    longest side to 1, "same" changes nothing. "auto" is "same" for two files, "source" where the result has a
    similarity of its own, else "box". Raises UsageError for "source" and a result that is a file.
    """
    matrix = result.source_from_world
    if frame == "auto":
        # A result whose similarity is the identity came from a picture: its frame is the unit box.
        if matrix is None:
            frame = "same"
        else:
            frame = "box" if np.allclose(matrix, np.eye(4), atol=IDENTITY_TOLERANCE) else "source"
    if frame == "source":
        if matrix is None:
            raise UsageError("--frame source", "needs a result that is a folder", "use --frame box or same")
        return transform_points(invert_similarity(matrix), truth.vertices)
    if frame == "box":
        return transform_points(invert_similarity(unit_box(truth.vertices[np.unique(truth.faces)])), truth.vertices)
    return truth.vertices


def compare_shapes(shape: Shape, reference: Source, options: ShapeOptions, cameras: list[Camera] | None) -> Figures:
    """Measure a shape against a reference in the normalised frame of the result.

    cameras: of the views that the result was made from; they say which part of the reference was seen. Figures of the
    surface protocol are called surface_* and seen_*, those of the other protocol syncdreamer_*.
    """
    truth = read_shape(reference)
    vertices, true_vertices = normalised_vertices(shape), normalised_vertices(truth)
    if kind_of(reference) == MODEL:
        true_vertices = aligned_truth(truth, shape, options.frame)
    # Cameras are in the normalised frame. Of two files nothing says where that is.
    in_frame_of_cameras = shape.source_from_world is not None or options.frame == "box"
    mesh, true_mesh = TriMesh(vertices, shape.faces), TriMesh(true_vertices, truth.faces)
    protocol = metrics.SurfaceOptions(
        cameras=cameras if cameras is not None and in_frame_of_cameras else (),
        samples=options.samples,
        seed=options.seed,
        threshold=options.threshold,
    )
    figures = metrics.surface_protocol(mesh, true_mesh, protocol)
    report: Figures = {
        name if name.startswith("seen_") else f"surface_{name}": value for name, value in figures.items()
    }
    report["reference_watertight"] = "iou" in figures
    if options.syncdreamer:
        figures = metrics.syncdreamer_protocol(mesh, true_mesh)
        report |= {f"syncdreamer_{name}": value for name, value in figures.items()}
    return report
