"""Convert pictures of another program to a views folder that reconstruct reads.

Use it on a Wonder3D output folder (colors and normals of six views), on a folder with NeRF's transforms.json, or on a
plain folder with a cameras.json (see docs/format.md) and pictures as DOMAIN/VIEW.png or VIEW.png. The mask is
mask/VIEW.png or the picture's alpha; without them the subject is cut out of a plain background. The object is moved
into the normalised frame.

Example:
  gdtool import-views outputs/cropsize-192-cfg1.0/owl | gdtool reconstruct
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError
from gdtool.core.stage import Inputs, Output, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool import-views`."""

    format: Annotated[
        Literal["auto", "wonder3d", "nerf", "plain"],
        Meta(description="Format of the folder; auto: by the files in it."),
    ] = "auto"
    up: Annotated[
        Literal["auto", "y", "z"],
        Meta(description="Axis of the folder's world that points up; auto: z for nerf, y for the others."),
    ] = "auto"
    normalize: Annotated[
        bool, Meta(description="Centre the volume that the silhouettes have in common and scale its longest side to 1.")
    ] = True


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Import one folder."""
    import numpy as np

    from gdtool.cameras import fit_depth_range, transform_camera
    from gdtool.fields.grid.silhouette_box import unit_box_of_silhouettes
    from gdtool.folders import adapters
    from gdtool.folders.views import Views, write_views

    with out.step("read"):
        module = adapters.adapter(inputs.path, options.format)
        pictures = module.read(inputs.path)
    mask = adapters.zero_faint_coverage(pictures.mask)
    if not (mask > 0.5).any():
        raise InputError(
            inputs.path, "every mask is empty", "give pictures with an alpha, or white masks as mask/VIEW.png"
        )
    # From the world of the pictures to the normalised frame.
    matrix = adapters.upright(pictures.up if options.up == "auto" else options.up)
    cameras = [transform_camera(camera, matrix) for camera in pictures.cameras]
    if options.normalize:
        with out.step("normalise"):
            box = unit_box_of_silhouettes(cameras, mask)
            if box is None:
                out.warn("the silhouettes have no common volume: the frame is left as it is")
            else:
                cameras, matrix = [transform_camera(camera, box) for camera in cameras], box @ matrix
    images = adapters.clear_background(adapters.transform_images(pictures.images, matrix), mask)
    with out.step("write"):
        write_views(
            out,
            Views([fit_depth_range(camera) for camera in cameras], images, mask),
            source_from_world=np.linalg.inv(matrix),
            report={"format": module.__name__.rpartition(".")[2]},
        )


STAGE = Stage(name="import-views", version=1, reads=("pictures",), writes="views", Options=Options, run=run)
