"""Define what each kind of folder says of itself: the `content` of its manifest.

These types are the format: the JSON Schemas in schemas/ are generated from them (`make schemas`), and every manifest is
decoded through them. The files that go with them are described in schemas/<kind>.md.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Scalar = bool | int | float | str
Matrix4 = Annotated[
    tuple[float, ...],
    Meta(min_length=16, max_length=16, description="4x4 matrix, row-major, acting on column vectors (x, y, z, 1)"),
]
Count = Annotated[int, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]
Report = Annotated[dict[str, Scalar], Meta(description="figures the stage measured, by name")]

DOMAINS = ("color", "normal", "depth", "albedo", "roughness", "metallic")
# Views of the default rig, around the object from the front; their azimuths are in cameras/camera.py.
VIEW_NAMES = ("front", "front_right", "right", "back", "left", "front_left")
Domain = Literal["color", "normal", "depth", "albedo", "roughness", "metallic", "closed_form"]

IDENTITY: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Content(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Fields that the content of every kind has. source_from_world takes points from the normalised frame to the frame
    of the source.
    """

    source_from_world: Matrix4 = IDENTITY
    report: Report = {}


class ViewsContent(Content, frozen=True, kw_only=True):
    """What a rig of cameras sees: cameras.json, <domain>/<view>.png or .exr, mask/<view>.png."""

    views: Annotated[
        tuple[str, ...], Meta(min_length=1, description="names of the views, in the order of cameras.json")
    ]
    domains: Annotated[tuple[Domain, ...], Meta(description="domains that every view has")]
    exposure: Annotated[float, Meta(gt=0, description="radiance was multiplied by this before sRGB encoding")] = 1.0
    clipped_share: Annotated[Share, Meta(description="share of foreground color values that clipped at 1")] = 0.0
    light: Annotated[bool, Meta(description="light.json holds the light as spherical Gaussians")] = False
    environment: Annotated[str, Meta(description="name of the environment the color was lit by; empty: unknown")] = ""
    conditions: Annotated[int, Meta(ge=0, description="number of condition images, condition/000.png and so on")] = 0
    model: Annotated[bool, Meta(description="source.glb holds the model the views show")] = False
    picture: Annotated[
        str, Meta(description="name of the view that picture.png shows: what the views were made of; empty: none")
    ] = ""


class DatasetObject(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One object of a dataset."""

    path: Annotated[str, Meta(description="its views folder, relative to the dataset")]
    digest: Annotated[str, Meta(description="digest of that folder")]


class DatasetContent(Content, frozen=True, kw_only=True):
    """A root with one views folder per object."""

    objects: tuple[DatasetObject, ...]


class ModelContent(Content, frozen=True, kw_only=True):
    """Weights in safetensors, config.json, card.md."""

    preset: str
    image_size: Annotated[int, Meta(ge=1)]
    domains: tuple[Domain, ...]
    parameters: Count
    steps: Count


class SurfaceContent(Content, frozen=True, kw_only=True):
    """surface.ply: a closed triangle mesh with albedo, roughness, metallic and confidence per vertex."""

    vertices: Count
    faces: Count
    watertight: bool
    light: Annotated[bool, Meta(description="light.json holds the recovered light")] = False
    field: Annotated[bool, Meta(description="field.safetensors holds the material field")] = False
    method: str = ""


class MeshContent(Content, frozen=True, kw_only=True):
    """mesh.obj: quads (and the few triangles that could not be paired)."""

    vertices: Count
    quads: Count
    triangles: Count
    watertight: bool
    engine: str = ""
    tried: Annotated[tuple[str, ...], Meta(description="methods tried before, and why each was not used")] = ()


class AtlasContent(Content, frozen=True, kw_only=True):
    """mesh.obj with texture coordinates."""

    vertices: Count
    quads: Count
    triangles: Count
    charts: Count
    size: Annotated[int, Meta(ge=1, description="texture size in texels that the padding was chosen for")]
    padding: Annotated[int, Meta(ge=0, description="texels between charts at that size")]
    coverage: Share
    watertight: bool = False
    tried: Annotated[tuple[str, ...], Meta(description="methods tried before, and why each was not used")] = ()


class AssetContent(Content, frozen=True, kw_only=True):
    """asset.glb, asset.obj with asset.mtl, and the maps."""

    size: Annotated[int, Meta(ge=1, description="texture size in texels")]
    maps: Annotated[dict[str, str], Meta(description="map name to file; a map that is constant is a factor instead")]
    factors: Annotated[dict[str, tuple[float, ...]], Meta(description="factors written to the material, linear")]
    usd: Annotated[str, Meta(description="the OpenUSD file, if one was asked for")] = ""
    lods: Annotated[
        tuple[str, ...], Meta(description="coarser levels on the same maps, finest first, if they were asked for")
    ] = ()
    normal_convention: Literal["opengl", "directx"] = "opengl"
    frame: Annotated[Literal["normalised", "source"], Meta(description="frame that the vertices are in")] = "normalised"


class RendersContent(Content, frozen=True, kw_only=True):
    """000.png, 001.png and so on: pictures of the lit object, straight alpha."""

    frames: Count
    environment: str
    light: str
    exposure: float = 1.0


CONTENTS: dict[str, type[Content]] = {
    "views": ViewsContent,
    "dataset": DatasetContent,
    "model": ModelContent,
    "surface": SurfaceContent,
    "mesh": MeshContent,
    "atlas": AtlasContent,
    "asset": AssetContent,
    "renders": RendersContent,
}

# The stage that makes each kind, for error messages.
MADE_BY = {
    "views": "render-dataset or gdtool sample-views",
    "dataset": "render-dataset",
    "model": "train",
    "surface": "reconstruct",
    "mesh": "remesh",
    "atlas": "unwrap",
    "asset": "bake",
    "renders": "relight",
}
