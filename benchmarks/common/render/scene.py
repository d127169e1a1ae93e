"""Write a model and a light as in_blender.py and in_mitsuba.py read them.

  python -m benchmarks.common.render.scene MODEL ENV FOLDER

Writes FOLDER/model.glb (a .glb or .gltf is used as it is), light.exr, and scene.npz with a mesh for each material.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np

from gdtool.assets.scene import Scene, Texture


def normalised(scene: Scene) -> Scene:
    """Move a scene so that its bounding box is centred, and scale its longest side to 1."""
    from gdtool.geometry.frames import invert_similarity, transform_points, unit_box

    matrix = unit_box(scene.vertices[np.unique(scene.faces)])
    return dataclasses.replace(scene, vertices=transform_points(invert_similarity(matrix), scene.vertices))


def times(texture: Texture | None, factor: np.ndarray, channels: slice) -> np.ndarray:
    """Multiply the channels of a texture by a factor (c,); returns (h, w, c), or the factor where there is no texture.

    The result is 8-bit as stored where the factor is 1, else linear float32.
    """
    if texture is None:
        return factor
    from gdtool.images.color import linear_from_srgb

    image = texture.image if texture.image.ndim == 3 else texture.image[..., None]
    image = np.repeat(image[..., :1], 3, -1) if image.shape[-1] < 3 else image
    if np.all(factor == 1) and image.dtype == np.uint8 and channels.stop - channels.start == 3:
        return image[..., channels]
    values = image[..., channels].astype(np.float32) / (np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1)
    return (linear_from_srgb(values) if texture.encoding == "srgb" else values) * factor.astype(np.float32)


def for_mitsuba(scene: Scene) -> dict[str, np.ndarray]:
    """Return the arrays of each material's mesh by name: m0_vertices, m0_faces, m0_normals, m0_uv, m0_colors,
    m0_base_color, …

    normals and colors are empty where the scene has none. Each material input is an image or a number. One UV set and
    transform serve all textures: those of the base color, else of the normal map.
    """
    from gdtool.shading.render.textures import transform_uv

    out = {}
    for number, material in enumerate(scene.materials):
        faces = scene.faces[scene.material_idx == number]
        if not len(faces):
            continue
        used, flat = np.unique(faces, return_inverse=True)
        texture = next(
            (
                t
                for t in (material.base_color_texture, material.normal_texture, material.metallic_roughness_texture)
                if t is not None
            ),
            None,
        )
        uv = None if texture is None or texture.uv_set >= len(scene.uvs) else scene.uvs[texture.uv_set]
        uv = np.zeros((len(used), 2)) if uv is None else transform_uv(texture, uv[used])
        factor = np.asarray(material.base_color[:3])
        surface = material.metallic_roughness_texture
        key = f"m{number}"
        out |= {
            f"{key}_vertices": scene.vertices[used],
            f"{key}_faces": flat.reshape(-1, 3),
            f"{key}_normals": np.zeros((0, 3)) if scene.normals is None else scene.normals[used],
            f"{key}_uv": uv,
            f"{key}_colors": np.zeros((0, 3)) if scene.colors is None else scene.colors[used, :3] * factor,
            f"{key}_base_color": times(material.base_color_texture, factor, slice(0, 3)),
            f"{key}_roughness": np.float32(material.roughness)
            if surface is None
            else times(surface, np.full(1, material.roughness), slice(1, 2)),
            f"{key}_metallic": np.float32(material.metallic)
            if surface is None
            else times(surface, np.full(1, material.metallic), slice(2, 3)),
            f"{key}_normal": np.float32(0)
            if material.normal_texture is None
            else times(material.normal_texture, np.ones(3), slice(0, 3)),
        }
    return out


def exported(model: str, env: str, folder: Path, seed: int = 0) -> dict[str, str]:
    """Write what the peers read, and return the paths of model, light and scene.

    The result also has the azimuths of the cameras in degrees, their half width and the number of faces.
    """
    from gdtool.assets.gltf.write import write_glb
    from gdtool.assets.load import load_scene
    from gdtool.cameras import rig
    from gdtool.images.io import write_exr
    from gdtool.shading.lights.studio import studio

    folder.mkdir(parents=True, exist_ok=True)
    scene = normalised(load_scene(model))
    light = studio(env, seed, fit=False)[0].image.astype(np.float32)
    write_exr(folder / "light.exr", light)
    model_path = model
    if Path(model).suffix not in (".glb", ".gltf"):
        model_path = str(folder / "model.glb")
        write_glb(model_path, scene)
    cameras = rig("six", 16)
    azimuths = {
        camera.name: float(np.degrees(np.arctan2(camera.position[0], camera.position[2]))) for camera in cameras
    }
    half = cameras[0].pixel_size * 8
    np.savez(
        folder / "scene.npz",
        light=light,
        half_width=half,
        **{f"azimuth_{name}": angle for name, angle in azimuths.items()},
        **for_mitsuba(scene),
    )
    written = {
        "model": model_path,
        "light": str(folder / "light.exr"),
        "scene": str(folder / "scene.npz"),
        "azimuths": azimuths,
        "half_width": half,
        "faces": len(scene.faces),
    }
    (folder / "scene.json").write_text(json.dumps(written))
    return written


def main() -> None:
    """Write the files for the model and the light that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("model", "env", "folder"):
        parser.add_argument(name)
    arguments = parser.parse_args()
    print(json.dumps(exported(arguments.model, arguments.env, Path(arguments.folder))))


if __name__ == "__main__":
    main()
