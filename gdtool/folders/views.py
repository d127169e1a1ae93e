"""Read and write `views` folders (schemas/views.md)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from gdtool.cameras import Camera
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.kinds import DOMAINS, IDENTITY, Domain, ViewsContent
from gdtool.core.memory import require_memory
from gdtool.core.stage import Output
from gdtool.folders.records import read_cameras, read_light, write_cameras, write_light

CHANNELS = {"color": 3, "normal": 3, "depth": 1, "albedo": 3, "roughness": 1, "metallic": 1, "closed_form": 3}
_PASSING = 5  # copies of a domain's pictures in memory at one time, while they are stacked, decoded and masked


@dataclass(frozen=True)
class Views:
    """Hold the pictures of k cameras.

    images: domain to (k, h, w, 3) or (k, h, w) float32, zero where mask is zero. color, albedo and closed_form are
    linear in [0, 1]; normal is unit, in world axes; depth is the distance along the viewing axis in world units. mask
    (k, h, w) float32 coverage in [0, 1]. light: the record of light.json (folders.records), or None.
    """

    cameras: list[Camera]
    images: dict[str, np.ndarray]
    mask: np.ndarray
    light: dict[str, Any] | None = None
    names: tuple[str, ...] = field(default=())

    def __post_init__(self):
        object.__setattr__(self, "names", tuple(camera.name for camera in self.cameras))


def read_views(folder: Folder, domains: tuple[str, ...] | None = None) -> Views:
    """Read a views folder. domains: those to read, where the folder has them; all without it."""
    from gdtool.images.color import decode_normal, linear_from_srgb
    from gdtool.images.io import read_image

    cameras = read_cameras(folder.file("cameras.json"))
    content = folder.content_as(ViewsContent)
    if tuple(camera.name for camera in cameras) != tuple(content.views):
        raise InputError(
            folder.file("cameras.json"),
            "does not hold the views that the manifest lists, in that order",
            "list the same views in both",
        )
    chosen = [d for d in content.domains if domains is None or d in domains]

    def load(domain: str, view: str, camera: Camera) -> np.ndarray:
        path = folder.file(f"{domain}/{view}.{'exr' if domain == 'depth' else 'png'}")
        image = read_image(path)
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(
                path,
                f"is {image.shape[1]}x{image.shape[0]}, its camera {camera.width}x{camera.height}",
                "scale the picture, or write its size into cameras.json",
            )
        channels = CHANNELS.get(domain, 1)
        image = image.reshape(camera.height, camera.width, -1)
        if image.shape[2] < channels:
            raise InputError(
                path, f"has {image.shape[2]} channels, {domain} has {channels}", f"save it with {channels} channels"
            )
        image = image[..., :channels]
        if image.dtype.kind == "u":
            image = image.astype(np.float32) / np.iinfo(image.dtype).max
        elif not np.isfinite(image).all():
            row, column = np.argwhere(~np.isfinite(image))[0][:2]
            raise InputError(path, f"is not finite at row {row}, column {column}", "give that pixel a finite value")
        return image if channels == 3 else image[..., 0]

    if len({(camera.height, camera.width) for camera in cameras}) > 1:
        raise InputError(folder.file("cameras.json"), "has cameras of different sizes", "render all views at one size")
    channels = sum(CHANNELS.get(domain, 1) for domain in chosen)
    size = (
        len(cameras)
        * cameras[0].height
        * cameras[0].width
        * (channels + 1 + _PASSING * max((CHANNELS.get(domain, 1) for domain in chosen), default=1))
        * 4
    )
    require_memory(
        size,
        folder.path,
        f"{len(cameras)} views of {cameras[0].width}x{cameras[0].height} pixels",
        "render fewer or smaller views",
    )
    mask = np.stack([load("mask", c.name, c) for c in cameras]).astype(np.float32)
    images: dict[str, np.ndarray] = {}
    for domain in chosen:
        stack = np.stack([load(domain, c.name, c) for c in cameras]).astype(np.float32)
        if domain == "normal":
            stack = decode_normal(stack)
        elif domain in ("color", "albedo", "closed_form"):
            stack = linear_from_srgb(stack).astype(np.float32)
        inside = mask > 0
        images[domain] = np.where(inside[..., None] if stack.ndim == 4 else inside, stack, 0).astype(np.float32)
    light = read_light(folder.file("light.json")) if content.light else None
    return Views(cameras, images, mask, light)


def read_picture(folder: Folder, cameras: list[Camera]) -> tuple[np.ndarray, Camera] | None:
    """Read the picture that the views of a folder were made of, and the camera of the view that it shows.

    The picture (h, w, 4) has linear color and straight alpha. Returns None where the folder has no such picture. Raises
    InputError where its size is not a whole multiple of the size of that view.
    """
    from gdtool.images.color import linear_from_srgb, unit_range
    from gdtool.images.io import read_image

    content = folder.content_as(ViewsContent)
    if not content.picture:
        return None
    camera = next((camera for camera in cameras if camera.name == content.picture), None)
    if camera is None:
        raise InputError(
            folder.path,
            f"the manifest says that picture.png shows the view {content.picture!r}, which it does not hold",
            "name one of its views, or none",
        )
    path = folder.file("picture.png")
    image = unit_range(read_image(path))
    h, w = image.shape[:2]
    if (
        image.ndim != 3
        or image.shape[2] != 4
        or h % camera.height
        or w % camera.width
        or h // camera.height != w // camera.width
    ):
        raise InputError(
            path,
            f"is {w}x{h}, not RGBA of a multiple of its view's {camera.width}x{camera.height}",
            "scale it to a whole multiple of the view",
        )
    return np.concatenate([linear_from_srgb(image[..., :3]), image[..., 3:]], -1).astype(np.float32), camera


def write_views(out: Output, views: Views, *, source_from_world: np.ndarray | None = None, **extra: Any) -> None:
    """Write a views folder and set out.content; extra goes to ViewsContent (exposure, environment, report, …)."""
    from gdtool.images.color import encode_normal, srgb_from_linear
    from gdtool.images.contact import contact_sheet
    from gdtool.images.io import write_exr, write_png

    write_cameras(out.path("cameras.json"), views.cameras)
    sheet: list[list[np.ndarray | None]] = []
    for k, name in enumerate(views.names):
        mask = np.clip(views.mask[k], 0, 1)
        write_png(out.path(f"mask/{name}.png"), mask)
        row: list[np.ndarray | None] = []
        for domain, stack in views.images.items():
            image = stack[k]
            if domain == "depth":
                write_exr(out.path(f"depth/{name}.exr"), image.astype(np.float32))
                near, far = views.cameras[k].near, views.cameras[k].far
                thumbnail = np.where(mask > 0, np.clip((far - image) / (far - near), 0, 1), 1)
            elif domain == "normal":
                encoded = np.where(mask[..., None] > 0, encode_normal(image), 0.5)
                write_png(out.path(f"normal/{name}.png"), encoded, bits=16)
                thumbnail = np.where(mask[..., None] > 0, encoded, 1)
            elif domain in ("color", "albedo", "closed_form"):
                encoded = srgb_from_linear(np.clip(image, 0, 1))
                rgba = np.concatenate([encoded, mask[..., None]], -1) if domain == "color" else encoded
                write_png(out.path(f"{domain}/{name}.png"), rgba)
                thumbnail = encoded * mask[..., None] + 1 - mask[..., None]
            else:
                write_png(out.path(f"{domain}/{name}.png"), np.clip(image, 0, 1))
                thumbnail = image * mask + 1 - mask
            row.append(np.asarray(thumbnail, np.float32))
        sheet.append(row)
    if views.light is not None:
        write_light(out.path("light.json"), views.light)
    if views.images:
        picture = contact_sheet(sheet, labels_top=list(views.images), labels_left=list(views.names))
        write_png(out.path("contact_sheet.png"), picture)
    matrix = IDENTITY if source_from_world is None else tuple(float(x) for x in np.asarray(source_from_world).ravel())
    present = cast(tuple[Domain, ...], tuple(d for d in (*DOMAINS, "closed_form") if d in views.images))
    out.content = ViewsContent(
        views=views.names, domains=present, source_from_world=matrix, light=views.light is not None, **extra
    )


def write_conditions(out: Output, cameras: list[Camera], pictures: Iterable[np.ndarray]) -> None:
    """Write condition pictures (h, w, 4), sRGB with straight alpha in [0, 1], and the cameras that took them."""
    from gdtool.images.io import write_png

    for camera, picture in zip(cameras, out.progress(pictures, len(cameras), "conditions"), strict=True):
        write_png(out.path(f"condition/{camera.name}.png"), picture)
    write_cameras(out.path("condition.json"), cameras)
