"""Declare the types that the JSON of a glTF 2.0 document is decoded into and checked against.

Field names and defaults are the specification's (https://registry.khronos.org/glTF/specs/2.0, section 5), the names in
snake case. Fields that gdtool does not read are not listed; the decoder ignores them.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Index = Annotated[int, Meta(ge=0, le=1 << 40)]
Size = Annotated[int, Meta(ge=0, le=1 << 40)]
Count = Annotated[int, Meta(ge=1, le=1 << 31)]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]


class Gltf(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """Define the base of the types: immutable, with the specification's camelCase names in the file."""


class Asset(Gltf, frozen=True, kw_only=True):
    version: str
    min_version: str = "2.0"


class MeshoptView(Gltf, frozen=True, kw_only=True):
    buffer: Index
    byte_offset: Size = 0
    byte_length: Size
    byte_stride: Annotated[int, Meta(ge=1, le=256)]
    count: Count
    mode: Literal["ATTRIBUTES", "TRIANGLES", "INDICES"]
    filter: Literal["NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL"] = "NONE"


class BufferViewExtensions(msgspec.Struct, frozen=True):
    EXT_meshopt_compression: MeshoptView | None = None


class Buffer(Gltf, frozen=True, kw_only=True):
    byte_length: Annotated[int, Meta(ge=1, le=1 << 40)]
    uri: str | None = None


class BufferView(Gltf, frozen=True, kw_only=True):
    buffer: Index
    byte_offset: Size = 0
    byte_length: Annotated[int, Meta(ge=1, le=1 << 40)]
    byte_stride: Annotated[int, Meta(ge=4, le=252)] | None = None
    extensions: BufferViewExtensions = BufferViewExtensions()


class SparseIndices(Gltf, frozen=True, kw_only=True):
    buffer_view: Index
    byte_offset: Size = 0
    component_type: Literal[5121, 5123, 5125]


class SparseValues(Gltf, frozen=True, kw_only=True):
    buffer_view: Index
    byte_offset: Size = 0


class Sparse(Gltf, frozen=True, kw_only=True):
    count: Count
    indices: SparseIndices
    values: SparseValues


class Accessor(Gltf, frozen=True, kw_only=True):
    component_type: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    count: Count
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    buffer_view: Index | None = None
    byte_offset: Size = 0
    normalized: bool = False
    sparse: Sparse | None = None


class DracoPrimitive(Gltf, frozen=True, kw_only=True):
    buffer_view: Index
    attributes: dict[str, Index]


class PrimitiveExtensions(msgspec.Struct, frozen=True):
    KHR_draco_mesh_compression: DracoPrimitive | None = None


class Primitive(Gltf, frozen=True, kw_only=True):
    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Meta(ge=0, le=6)] = 4
    targets: tuple[dict[str, Index], ...] = ()
    extensions: PrimitiveExtensions = PrimitiveExtensions()


class Mesh(Gltf, frozen=True, kw_only=True):
    primitives: Annotated[tuple[Primitive, ...], Meta(min_length=1)]
    name: str = ""
    weights: tuple[float, ...] = ()


class Node(Gltf, frozen=True, kw_only=True):
    name: str = ""
    children: tuple[Index, ...] = ()
    mesh: Index | None = None
    skin: Index | None = None
    weights: tuple[float, ...] = ()
    matrix: Annotated[tuple[float, ...], Meta(min_length=16, max_length=16)] | None = None
    translation: Vector3 = (0.0, 0.0, 0.0)
    rotation: Vector4 = (0.0, 0.0, 0.0, 1.0)
    scale: Vector3 = (1.0, 1.0, 1.0)


class Skin(Gltf, frozen=True, kw_only=True):
    joints: Annotated[tuple[Index, ...], Meta(min_length=1)]
    inverse_bind_matrices: Index | None = None


class SceneNodes(Gltf, frozen=True, kw_only=True):
    nodes: tuple[Index, ...] = ()
    name: str = ""


class Image(Gltf, frozen=True, kw_only=True):
    uri: str | None = None
    buffer_view: Index | None = None
    mime_type: str = ""


class Sampler(Gltf, frozen=True, kw_only=True):
    mag_filter: Literal[9728, 9729] = 9729
    wrap_s: Literal[33071, 33648, 10497] = 10497
    wrap_t: Literal[33071, 33648, 10497] = 10497


class OtherSource(Gltf, frozen=True, kw_only=True):
    source: Index


class ImageExtensions(msgspec.Struct, frozen=True):
    EXT_texture_webp: OtherSource | None = None
    KHR_texture_basisu: OtherSource | None = None


class TextureSource(Gltf, frozen=True, kw_only=True):
    sampler: Index | None = None
    source: Index | None = None
    extensions: ImageExtensions = ImageExtensions()


class TextureTransform(Gltf, frozen=True, kw_only=True):
    offset: Vector2 = (0.0, 0.0)
    rotation: float = 0.0
    scale: Vector2 = (1.0, 1.0)
    tex_coord: Index | None = None


class TextureInfoExtensions(msgspec.Struct, frozen=True):
    KHR_texture_transform: TextureTransform | None = None


class TextureInfo(Gltf, frozen=True, kw_only=True):
    index: Index
    tex_coord: Index = 0
    scale: float = 1.0
    strength: float = 1.0
    extensions: TextureInfoExtensions = TextureInfoExtensions()


class MetallicRoughness(Gltf, frozen=True, kw_only=True):
    base_color_factor: Vector4 = (1.0, 1.0, 1.0, 1.0)
    base_color_texture: TextureInfo | None = None
    metallic_factor: float = 1.0
    roughness_factor: float = 1.0
    metallic_roughness_texture: TextureInfo | None = None


class SpecularGlossiness(Gltf, frozen=True, kw_only=True):
    diffuse_factor: Vector4 = (1.0, 1.0, 1.0, 1.0)
    diffuse_texture: TextureInfo | None = None
    specular_factor: Vector3 = (1.0, 1.0, 1.0)
    glossiness_factor: float = 1.0
    specular_glossiness_texture: TextureInfo | None = None


class EmissiveStrength(Gltf, frozen=True, kw_only=True):
    emissive_strength: float = 1.0


class Ior(Gltf, frozen=True, kw_only=True):
    ior: float = 1.5


class Specular(Gltf, frozen=True, kw_only=True):
    specular_factor: float = 1.0
    specular_texture: TextureInfo | None = None
    specular_color_factor: Vector3 = (1.0, 1.0, 1.0)
    specular_color_texture: TextureInfo | None = None


class Unlit(Gltf, frozen=True, kw_only=True):
    pass


class MaterialExtensions(msgspec.Struct, frozen=True):
    KHR_materials_emissive_strength: EmissiveStrength | None = None
    KHR_materials_ior: Ior | None = None
    KHR_materials_specular: Specular | None = None
    KHR_materials_unlit: Unlit | None = None
    KHR_materials_pbrSpecularGlossiness: SpecularGlossiness | None = None


class MaterialRecord(Gltf, frozen=True, kw_only=True):
    name: str = ""
    pbr_metallic_roughness: MetallicRoughness = MetallicRoughness()
    normal_texture: TextureInfo | None = None
    occlusion_texture: TextureInfo | None = None
    emissive_texture: TextureInfo | None = None
    emissive_factor: Vector3 = (0.0, 0.0, 0.0)
    alpha_mode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alpha_cutoff: float = 0.5
    double_sided: bool = False
    extensions: MaterialExtensions = MaterialExtensions()


class Document(Gltf, frozen=True, kw_only=True):
    asset: Asset
    extensions_used: tuple[str, ...] = ()
    extensions_required: tuple[str, ...] = ()
    scene: Index | None = None
    scenes: tuple[SceneNodes, ...] = ()
    nodes: tuple[Node, ...] = ()
    meshes: tuple[Mesh, ...] = ()
    skins: tuple[Skin, ...] = ()
    accessors: tuple[Accessor, ...] = ()
    buffers: tuple[Buffer, ...] = ()
    buffer_views: tuple[BufferView, ...] = ()
    materials: tuple[MaterialRecord, ...] = ()
    textures: tuple[TextureSource, ...] = ()
    images: tuple[Image, ...] = ()
    samplers: tuple[Sampler, ...] = ()
