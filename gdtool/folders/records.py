"""Read and write the JSON records inside folders: cameras.json and light.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from gdtool.cameras import Camera
from gdtool.core.errors import InputError
from gdtool.core.names import checked_name
from gdtool.core.reading import read_json

MAX_SIDE = 16384  # pixels of a view: no larger picture is read
Vector3 = tuple[float, float, float]
Positive = Annotated[float, Meta(gt=0)]


class CameraRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One camera of cameras.json; OpenGL camera axes, pixel centres at half-integers, row 0 at the top."""

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.-]+$")]
    projection: Literal["orthographic", "perspective"]
    width: Annotated[int, Meta(ge=1, le=MAX_SIDE)]
    height: Annotated[int, Meta(ge=1, le=MAX_SIDE)]
    world_from_camera: Annotated[tuple[float, ...], Meta(min_length=16, max_length=16, description="rigid, row-major")]
    half_width: Annotated[float, Meta(ge=0, description="orthographic: the image covers ±half_width across")] = 0.0
    fx: Annotated[float, Meta(ge=0, description="perspective: focal length in pixels")] = 0.0
    fy: Annotated[float, Meta(ge=0)] = 0.0
    cx: float = 0.0
    cy: float = 0.0
    near: Positive
    far: Positive


class Cameras(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """cameras.json."""

    cameras: Annotated[tuple[CameraRecord, ...], Meta(min_length=1)]


class Light(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """light.json: radiance L(v) = sum_k amplitude_k exp(sharpness_k (v·axis_k − 1)), linear; axes toward the light."""

    kind: Literal["spherical_gaussians"] = "spherical_gaussians"
    axes: tuple[Vector3, ...]
    sharpness: tuple[Annotated[float, Meta(ge=0)], ...]
    amplitudes: tuple[Vector3, ...]
    environment: Annotated[str, Meta(description="name of the environment it was fitted to; empty: recovered")] = ""
    fit_error: Annotated[dict[str, float], Meta(description="errors of the fit, by name")] = {}


def _convert(path: Path, kind: type) -> Any:
    """Read a JSON file as a msgspec type. Raises InputError."""
    try:
        return msgspec.convert(read_json(path), kind)
    except msgspec.ValidationError as error:
        fact = str(error)
        raise InputError(
            path, fact[0].lower() + fact[1:], f"write it as schemas/{kind.__name__.lower()}.schema.json says"
        ) from None


def _write(path: Path, record: Any) -> None:
    """Write a record as indented JSON."""
    path.write_bytes(msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n")


def read_cameras(path: Path) -> list[Camera]:
    """Read cameras.json. Raises InputError for poses that are not rigid, near ≥ far, or a repeated name."""
    out = []
    for record in _convert(path, Cameras).cameras:
        checked_name(record.name, path, "camera")
        pose = np.array(record.world_from_camera, np.float64).reshape(4, 4)
        rotation = pose[:3, :3]
        rigid = np.abs(rotation).max() < 2 and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not (rigid and np.linalg.det(rotation) > 0 and np.allclose(pose[3], (0, 0, 0, 1))):
            raise InputError(
                path,
                f"camera {record.name!r}: world_from_camera is not rigid (rotation and translation)",
                "remove scale and shear from it",
            )
        if record.near >= record.far:
            raise InputError(
                path,
                f"camera {record.name!r}: near {record.near:g} is not below far {record.far:g}",
                "write near < far",
            )
        needed = ("half_width",) if record.projection == "orthographic" else ("fx", "fy")
        for key in needed:
            if getattr(record, key) <= 0:
                raise InputError(path, f"camera {record.name!r}: {record.projection} needs {key} > 0", f"write {key}")
        fields = {f: getattr(record, f) for f in record.__struct_fields__}
        out.append(Camera(**{**fields, "world_from_camera": pose}))
    names = [camera.name for camera in out]
    if len(set(names)) < len(names):
        raise InputError(path, "two cameras have one name", "give each camera a name of its own")
    return out


def write_cameras(path: Path, cameras: list[Camera]) -> None:
    """Write cameras.json."""
    records = []
    for c in cameras:
        pose = tuple(float(x) for x in c.world_from_camera.ravel())
        optics = (
            {"half_width": float(c.half_width)}
            if c.projection == "orthographic"
            else {k: float(getattr(c, k)) for k in ("fx", "fy", "cx", "cy")}
        )
        records.append(
            CameraRecord(
                name=c.name,
                projection=c.projection,
                width=c.width,
                height=c.height,
                world_from_camera=pose,
                near=float(c.near),
                far=float(c.far),
                **optics,
            )
        )
    _write(path, Cameras(tuple(records)))


def read_light(path: Path) -> dict[str, Any]:
    """Read light.json as plain values: axes, sharpness and amplitudes become float64 arrays (k, 3), (k,), (k, 3)."""
    light = _convert(path, Light)
    if not len(light.axes) == len(light.sharpness) == len(light.amplitudes):
        raise InputError(path, "axes, sharpness and amplitudes differ in number", "write one of each for every lobe")
    return {
        "kind": light.kind,
        "axes": np.array(light.axes, np.float64).reshape(-1, 3),
        "sharpness": np.array(light.sharpness, np.float64),
        "amplitudes": np.array(light.amplitudes, np.float64).reshape(-1, 3),
        "environment": light.environment,
        "fit_error": light.fit_error,
    }


def write_light(path: Path, light: dict[str, Any]) -> None:
    """Write light.json from arrays axes, sharpness and amplitudes (and environment, fit_error where known)."""
    plain = json.loads(
        json.dumps(
            {k: np.asarray(v).tolist() if isinstance(v, (np.ndarray, list, tuple)) else v for k, v in light.items()},
            default=float,
        )
    )
    _write(path, msgspec.convert(plain, Light))
