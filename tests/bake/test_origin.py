"""The sources of a bake: views come before the field, and the field before the vertices."""

import numpy as np
import pytest

from gdtool.bake.origin import from_surface, material_field
from gdtool.bake.reproject import Places
from gdtool.core.errors import InputError
from gdtool.folders.surface import Surface
from gdtool.folders.views import Views
from tests.bake.shapes import albedo_of, psnr, torus, triangles_of
from tests.stages.bake_folders import torus_views


@pytest.fixture(scope="module")
def surface():
    vertices, quads, normals = torus(160, 90)
    count = len(vertices)
    return Surface(
        vertices,
        triangles_of(quads),
        np.full((count, 3), 0.5),
        np.full(count, 0.2),
        np.full(count, 0.1),
        np.ones(count),
        normals,
    )


def places_on(surface, count=4000):
    rng = np.random.default_rng(0)
    return Places(
        rng.integers(0, len(surface.faces), count).astype(np.int32),
        rng.dirichlet((1, 1, 1), count).astype(np.float32),
        np.ones(count, bool),
        np.zeros(count, bool),
    )


def at(origin, places):
    return origin.source.at(places.face_idx, places.barycentric, origin.source.mesh.vertices)


def test_views_give_what_they_see_and_vertices_everything_else(surface):
    origin = from_surface(surface, torus_views(192))
    places = places_on(surface)
    read = origin.lookup(places)
    points = at(origin, places)
    # Six views at eye level see the outside of the ring, but neither its inner side nor its top.
    outside = (np.linalg.norm(points[:, [0, 2]], axis=1) > 0.42) & (read["seen"] > 0.95)
    assert outside.mean() > 0.3
    assert psnr(read["albedo"][outside], albedo_of(points[outside])) > 32
    np.testing.assert_allclose(read["roughness"][outside], 0.5 + 0.4 * points[outside, 0], atol=0.02)
    hidden = np.linalg.norm(points[:, [0, 2]], axis=1) < 0.25
    np.testing.assert_allclose(read["seen"][hidden], 0)
    np.testing.assert_allclose(read["albedo"][hidden], 0.5, atol=1e-5)


def test_a_part_in_front_does_not_colour_what_it_hides(surface):
    # A plate between the ring and the front camera, painted red in that view only.
    views = torus_views(192)
    vertices = np.concatenate(
        [surface.vertices, [[-0.3, -0.1, 0.6], [0.3, -0.1, 0.6], [0.3, 0.1, 0.6], [-0.3, 0.1, 0.6]]]
    )
    n = len(surface.vertices)
    faces = np.concatenate([surface.faces, [[n, n + 1, n + 2], [n, n + 2, n + 3]]])
    albedo = views.images["albedo"].copy()
    covered = np.abs(np.arange(192) + 0.5 - 96) * 2 * 0.72 / 192
    plate = (covered[:, None] < 0.1) & (covered[None] < 0.3)
    albedo[0][plate] = (1.0, 0.0, 0.0)
    mask = views.mask.copy()
    mask[0][plate] = 1
    extend = lambda a, value: np.concatenate([a, np.full((4, *a.shape[1:]), value)])  # noqa: E731
    whole = Surface(
        vertices,
        faces,
        extend(surface.albedo, 0.5),
        extend(surface.roughness, 0.2),
        extend(surface.metallic, 0),
        extend(surface.confidence, 1),
    )
    origin = from_surface(whole, Views(views.cameras[:1], {"albedo": albedo[:1]}, mask[:1]))
    read = origin.lookup(places_on(surface))
    assert read["albedo"][:, 1].min() > 0.04  # the plate's green is 0; the ring's is above 0.1
    on_plate = Places(
        np.array([len(faces) - 2], np.int32), np.full((1, 3), 1 / 3, np.float32), np.ones(1, bool), np.zeros(1, bool)
    )
    np.testing.assert_allclose(origin.lookup(on_plate)["albedo"], [[1, 0, 0]], atol=1e-3)


def test_a_view_that_disagrees_with_the_others_is_left_out(surface):
    views = torus_views(192)
    albedo = views.images["albedo"].copy()
    albedo[1] = (0.0, 1.0, 0.0)  # front right, between front and right
    truth = Surface(
        surface.vertices,
        surface.faces,
        albedo_of(surface.vertices),
        surface.roughness,
        surface.metallic,
        surface.confidence,
        surface.normals,
    )
    origin = from_surface(truth, Views(views.cameras, {"albedo": albedo}, views.mask))
    places = places_on(surface)
    points = at(origin, places)
    read = origin.lookup(places)["albedo"]
    toward = (surface.normals[surface.faces[places.face_idx, 0]] * (np.sqrt(0.5), 0, np.sqrt(0.5))).sum(1) > 0.9
    # The front and right views see the same surface at 45 degrees, and the vertices agree with them.
    error = np.abs(read[toward] - albedo_of(points[toward])).max(1)
    assert (error < 0.1).mean() > 0.8


def test_the_field_replaces_materials_that_views_lack(surface, tmp_path):
    import torch
    from safetensors.torch import save_file

    from gdtool.fields.neural.networks import MaterialNetwork

    torch.manual_seed(0)
    network = MaterialNetwork()
    save_file({f"material.{k}": v for k, v in network.state_dict().items()}, str(tmp_path / "field.safetensors"))
    field = material_field(tmp_path / "field.safetensors")
    views = torus_views(96)
    origin = from_surface(surface, Views(views.cameras, {"roughness": views.images["roughness"]}, views.mask), field)
    places = places_on(surface, 500)
    read = origin.lookup(places)
    expected = network(torch.as_tensor(at(origin, places), dtype=torch.float32)).detach().numpy()
    np.testing.assert_allclose(read["albedo"], expected[:, :3], atol=1e-5)
    assert origin.label == "field: albedo metallic, views: roughness"
    (tmp_path / "bad.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{}      ")
    with pytest.raises(InputError, match="is not the material field"):
        material_field(tmp_path / "bad.safetensors")


def test_detail_is_a_texel_of_the_finest_texture():
    from gdtool.assets.scene import Material, Scene, Texture
    from gdtool.bake.origin import texture_detail

    vertices, faces = (
        np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    image = lambda size: Texture(np.zeros((size, size, 3), np.uint8))  # noqa: E731
    for material, expected in (
        (Material(base_color_texture=image(64)), 2 / 64),
        (Material(base_color_texture=image(64), normal_texture=image(256)), 2 / 256),
        (Material(), None),
    ):
        assert texture_detail(Scene(vertices, faces, (material,), uvs=(uv,))) == (
            None if expected is None else pytest.approx(expected)
        )
    # Repeated four times along each side, it is four times as fine.
    assert texture_detail(
        Scene(vertices, faces, (Material(base_color_texture=image(64)),), uvs=(4 * uv,))
    ) == pytest.approx(2 / 256)
