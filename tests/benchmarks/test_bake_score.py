"""The scores of benchmarks/bake/sweep.py: errors and seams that are put into maps are found again."""

import numpy as np
import pytest

from benchmarks.bake.cases import Case
from benchmarks.bake.score import Truth, scored
from gdtool.assets.gltf.write import write_glb
from gdtool.assets.scene import Material, Scene, Texture
from gdtool.images.color import linear_from_srgb

SIZE = 128


@pytest.fixture
def case(tmp_path):
    """A plane in 8 x 8 quads with a smooth texture; its quad mesh has a chart for its left half and one for its
    right."""
    side = np.linspace(-0.5, 0.5, 9)
    vertices = np.stack([*np.meshgrid(side, side), np.zeros((9, 9))], -1).reshape(-1, 3)
    corner = np.arange(81).reshape(9, 9)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], -1).reshape(-1, 4)
    uv = vertices[:, :2] * (1, -1) + 0.5
    shade = (np.indices((64, 64)).sum(0) * 1.5 + 30).astype(np.uint8)
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    material = Material(
        base_color_texture=Texture(np.repeat(shade[..., None], 3, -1), "srgb", wrap_u="clamp", wrap_v="clamp"),
        metallic=0.0,
        roughness=0.5,
    )
    write_glb(tmp_path / "plane.glb", Scene(vertices, triangles.astype(np.int32), (material,), uvs=(uv,)))
    right = vertices[quads].mean(1)[:, 0] > 0
    apart = np.concatenate([uv * 0.9 + (0.01, 0.05), uv * 0.9 + (0.09, 0.05)])
    np.savez(tmp_path / "plane.npz", vertices=vertices, faces=quads, uv=apart, face_uvs=quads + 81 * right[:, None])
    return Case("plane", tmp_path / "plane.glb", tmp_path / "plane.npz")


def perfect(case):
    """The maps a bake without error gives, gutters and all."""
    column, row = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, (np.arange(SIZE) + 0.5) / SIZE)
    u, v = np.where(column < 0.5, (column - 0.01) / 0.9, (column - 0.09) / 0.9), (row - 0.05) / 0.9
    shade = (np.clip(64 * u - 0.5, 0, 63) + np.clip(64 * v - 0.5, 0, 63)) * 1.5 / 255 + 30 / 255
    albedo = linear_from_srgb(shade)[..., None] * np.ones(3)
    return {
        "albedo": albedo,
        "roughness": np.full((SIZE, SIZE), 0.5),
        "metallic": np.zeros((SIZE, SIZE)),
        "normal": np.full((SIZE, SIZE, 3), (0.5, 0.5, 1.0)),
    }


def test_a_perfect_bake_scores_so_and_errors_are_found(case):
    truth, maps = Truth(case), perfect(case)
    good = scored(truth, maps)
    assert good["albedo dB"] > 45
    assert good["roughness dB"] == 120
    assert good["normal deg"] < 0.1
    assert good["missed"] == 0
    assert 0.8 < good["seam albedo"] < 1.2
    assert good["seam roughness"] == pytest.approx(1)
    bad = {name: image.copy() for name, image in maps.items()}
    bad["albedo"][:, SIZE // 2 :] += 0.1
    bad["roughness"] += 0.1
    bad["normal"][...] = (0.5 + 0.5 * np.sin(0.1), 0.5, 0.5 + 0.5 * np.cos(0.1))
    worse = scored(truth, bad)
    assert worse["seam albedo"] > 3
    assert worse["albedo dB"] < 26
    assert worse["roughness dB"] == pytest.approx(20)
    assert worse["normal deg"] == pytest.approx(np.degrees(0.1), rel=0.01)
    assert worse["seam roughness"] == pytest.approx(1)


def test_what_lies_beside_charts_is_seen_along_their_rims_at_a_coarse_level(case):
    from benchmarks.bake.mips import rim_error

    target, maps = Truth(case).target, perfect(case)
    gutter = np.ones((SIZE, SIZE), bool)
    from gdtool.geometry.uv_raster import owners_of

    gutter.ravel()[owners_of(target.uv, target.face_uvs, SIZE) >= 0] = False
    good = rim_error(target, maps["albedo"], 32)
    black = np.where(gutter[..., None], 0.0, maps["albedo"])
    assert good > 35 > 25 > rim_error(target, black, 32)
