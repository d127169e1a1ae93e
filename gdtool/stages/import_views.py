"""Pictures made by another program to a views folder that reconstruct reads.

Use it on a Wonder3D output folder (colors and normals of six views), on a folder with NeRF's transforms.json, or on a
plain folder with a cameras.json (docs/format.md's) and pictures as DOMAIN/VIEW.png or VIEW.png. The mask is the
picture's alpha or a mask/VIEW.png, else the subject is told from a plain background. The object is moved into the
normalised frame.

Example:
  gdtool import-views outputs/cropsize-192-cfg1.0/owl | gdtool reconstruct
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError
from gdtool.core.stage import Inputs, Output, Stage

if TYPE_CHECKING:
    import numpy as np

    from gdtool.cameras import Camera

SAMPLES = 64  # across the cube in which the silhouettes' common cone is looked for


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of import-views."""

    format: Annotated[
        Literal["auto", "wonder3d", "nerf", "plain"], Meta(description="what the folder is; auto: by what it holds")
    ] = "auto"
    up: Annotated[
        Literal["auto", "y", "z"], Meta(description="axis of its world that points up; auto: z for nerf, y for plain")
    ] = "auto"
    normalize: Annotated[
        bool, Meta(description="centre what the silhouettes have in common and scale its longest side to 1")
    ] = True


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Import one folder."""
    import numpy as np

    from gdtool.folders.adapters import adapter
    from gdtool.folders.views import Views, write_views

    with out.step("read"):
        module = adapter(inputs.main, options.format)
        pictures = module.read(inputs.main)
    cameras, images, mask = (
        pictures.cameras,
        dict(pictures.images),
        np.where(pictures.mask > 1 / 512, pictures.mask, 0).astype(np.float32),
    )
    if not (mask > 0.5).any():
        raise InputError(
            inputs.main, "every mask is empty", "give pictures with an alpha, or white masks as mask/VIEW.png"
        )
    matrix = np.eye(4)  # of this world into ours
    if (pictures.up if options.up == "auto" else options.up) == "z":
        matrix[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    cameras = [moved(camera, matrix) for camera in cameras]
    if options.normalize:
        with out.step("normalise"):
            box = normalisation(cameras, mask)
            if box is None:
                out.warn("the silhouettes have no common volume: the frame is left as it is")
            else:
                cameras, matrix = [moved(camera, box) for camera in cameras], box @ matrix
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if "normal" in images:
        images["normal"] = (images["normal"] @ (matrix[:3, :3] / scale).T).astype(np.float32)
    if "depth" in images:
        images["depth"] = (images["depth"] * scale).astype(np.float32)
    cameras = [bounded(camera) for camera in cameras]
    for name, stack in images.items():
        inside = mask > 0
        images[name] = np.where(inside[..., None] if stack.ndim == 4 else inside, stack, 0).astype(np.float32)
    with out.step("write"):
        write_views(
            out,
            Views(cameras, images, mask),
            source_from_world=np.linalg.inv(matrix),
            report={"format": module.__name__.rpartition(".")[2]},
        )


def moved(camera: Camera, matrix: np.ndarray) -> Camera:
    """The camera after a similarity (4, 4) of the world; what it sees is the same picture."""
    import numpy as np

    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    pose = np.eye(4)
    pose[:3, :3] = matrix[:3, :3] / scale @ camera.world_from_camera[:3, :3]
    pose[:3, 3] = matrix[:3, :3] @ camera.position + matrix[:3, 3]
    return replace(
        camera,
        world_from_camera=pose,
        half_width=camera.half_width * scale,
        near=camera.near * scale,
        far=camera.far * scale,
    )


def bounded(camera: Camera) -> Camera:
    """near and far around the unit sphere at the origin."""
    import numpy as np

    distance = float(camera.position @ camera.backward)
    near = max(distance - 1.0, 0.05 * abs(distance), 1e-3)
    return replace(camera, near=near, far=max(distance + 1.0, float(np.nextafter(near, np.inf)) + 1e-3))


def normalisation(cameras: list[Camera], mask: np.ndarray) -> np.ndarray | None:
    """Similarity (4, 4) that takes the box around the silhouettes' common cone to the centred box of longest side 1.

    Looked for around the point that the viewing axes pass nearest, twice: the second time inside the first box. None
    when the silhouettes have nothing in common there.
    """
    import numpy as np

    from gdtool.fields.grid.carve import hull_bounds
    from gdtool.fields.grid.fusion import prepare_all
    from gdtool.fields.views.prepared_view import hull_distance, pixel_footprint

    axes = np.stack([camera.backward for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    positions = np.stack([camera.position for camera in cameras])
    center = np.linalg.lstsq(across.sum(0), np.einsum("kij,kj->i", across, positions), rcond=None)[0]
    distance = np.abs(((positions - center) * axes).sum(1))
    reach = max(
        float(pixel_footprint(c, d)) * max(c.width, c.height) / 2 for c, d in zip(cameras, distance, strict=True)
    )
    total = np.eye(4)
    for _ in range(2):
        step = np.eye(4)
        step[:3] /= reach
        step[:3, 3] = -center / reach
        cameras, total = [moved(camera, step) for camera in cameras], step @ total
        prepared = prepare_all(cameras, mask, None, None)
        low, high = hull_bounds(prepared, reach=1.0, samples=SAMPLES)
        margin = 2.0 / (SAMPLES - 1)  # that hull_bounds leaves around what it found
        center = (low + high) / 2
        reach = float((high - low).max()) / 2
        if max(hull_distance(prepared_view, center[None])[0] for prepared_view in prepared) > reach:
            return None
    step = np.eye(4)
    step[:3] /= 2 * (reach - margin)
    step[:3, 3] = -center / (2 * (reach - margin))
    return step @ total


STAGE = Stage(name="import-views", version=1, reads=("pictures",), writes="views", Options=Options, run=run)
