"""Measure a result against a reference, and print the figures.

Use it at the end of a pipe, or on any two of: folders of views, surface, mesh, atlas, asset or renders, and model
files. Shapes are compared by two protocols, pictures by image metrics. Without --reference the model that the result
was made from is found along its provenance. The views that it was made from tell which part of the model was seen, and
an asset is also rendered through their cameras. docs/metrics.md defines each figure.

Example:
  gdtool render-dataset procedural:7 | gdtool reconstruct | gdtool evaluate
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError, UsageError
from gdtool.core.folder import Folder, open_folder
from gdtool.core.provenance import ancestors, find_ancestor
from gdtool.core.sources import Source, name_of
from gdtool.core.stage import MOST_SEED

READS = ("views", "surface", "mesh", "atlas", "asset", "renders", "model-file", "mesh-file")

Report = dict[str, bool | int | float | str]


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool evaluate`."""

    frame: Annotated[
        Literal["auto", "source", "box", "same"],
        Meta(
            description="How to bring a model file into the result's frame. source: by the result's source_from_world. "
            "box: centred, longest side 1. same: it is in that frame. auto: same for two files, source where the "
            "result has a matrix, else box."
        ),
    ] = "auto"
    samples: Annotated[int, Meta(ge=100, le=10_000_000, description="Number of points sampled on each surface.")] = (
        100_000
    )
    threshold: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="Distance that counts as a match in the F-score, as a share of the reference's longest side.",
        ),
    ] = 0.01
    syncdreamer: Annotated[
        bool, Meta(description="Also measure by the protocol of SyncDreamer's published tables.")
    ] = True
    render: Annotated[
        bool, Meta(description="Render an asset or a model through the cameras of the views and compare the pictures.")
    ] = True
    perceptual: Annotated[
        bool,
        Meta(
            description="Also measure color by LPIPS and FLIP, where their packages are installed: a second a view and "
            "network."
        ),
    ] = True
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="Seed of the sampled points.")] = 0


def evaluate(result: Source, reference: Source | None, options: Options, views: Folder | None = None) -> Report:
    """Measure a result, and return the figures by name.

    Without a reference it is found along the result's provenance, and so are the views. Raises UsageError where there
    is no reference, InputError where the two cannot be compared.
    """
    from gdtool.evaluation import pictures, references, shapes
    from gdtool.folders.records import read_cameras

    report: Report = {"result": name_of(result), "kind": references.kind_of(result)}
    if isinstance(result, Folder) and result.kind in ("views", "renders"):
        other = _reference_pictures(result, reference)
        return report | {"reference": other.name} | pictures.compare_folders(result, other, options.perceptual)
    if views is None and isinstance(result, Folder):
        folder = find_ancestor(result, "views", "name the views with --views")
        views = open_folder(folder.path) if folder else None
    given_views = reference if isinstance(reference, Folder) and reference.kind == "views" else None
    views = views or given_views
    truth = reference if reference is not None else references.find_truth(result)
    if truth is None and views is None:
        raise UsageError(
            name_of(result), "has neither model nor views along its provenance chain", "name one with --reference"
        )

    shape = shapes.read_shape(result)
    report |= shapes.counts(shape)
    source = references.source_of_shape(truth) if truth is not None else None
    render = options.render and references.has_material(result)
    if truth is not None and source is not None:
        report["reference"] = name_of(truth)
        how = shapes.ShapeOptions(options.frame, options.samples, options.threshold, options.syncdreamer, options.seed)
        cameras = read_cameras(views.file("cameras.json")) if views is not None else None
        report |= shapes.compare_shapes(shape, source, how, cameras)
    elif reference is not None and not render:
        raise InputError(
            references.path_of(reference),
            "holds no model to measure the geometry against",
            "name the model itself with --reference",
        )
    # Views named as the reference are the truth of the pictures; those along the provenance may have been generated.
    true_views = given_views or views
    if render and true_views is not None:
        report["reference_views"] = true_views.name
        report |= pictures.compare_rendered(result, true_views)
    elif source is None:
        raise UsageError(name_of(result), "was not made from a known model", "name one with --reference")
    return report


def _reference_pictures(result: Folder, reference: Source | None) -> Folder:
    """Return the folder that the pictures of a result are measured against.

    This is the reference, where one is named, else a folder of the result's kind along the provenance chain. Raises
    UsageError where there is none, InputError for a reference of another kind.
    """
    from gdtool.evaluation.references import kind_of, path_of

    if reference is None:
        same_kind = (f for f in ancestors(result, "name one with --reference") if f.kind == result.kind)
        nearest = next(same_kind, None)
        if nearest is None:
            raise UsageError(
                result.path, f"has no other {result.kind} along its provenance chain", "name one with --reference"
            )
        return open_folder(nearest.path)
    if not isinstance(reference, Folder) or reference.kind != result.kind:
        cure = (
            f"run gdtool render-dataset {path_of(reference)} --cameras {result.path} first"
            if result.kind == "views"
            else "name a renders folder with --reference"
        )
        raise InputError(path_of(reference), f"holds {kind_of(reference)}, but the result holds {result.kind}", cure)
    return reference
