"""The grid method on analytic solids: distance bounds, closedness, orientation, any subset of the domains."""

import numpy as np
import pytest
import trimesh

from gdtool.cameras import rig
from gdtool.fields.grid.carve import silhouettes_outvoted
from gdtool.fields.grid.fusion import (
    BUMPY_DEGREES,
    FusionOptions,
    align_depth,
    depth_for,
    fold_midpoints,
    fuse_views,
    grid_step,
    is_closed_manifold,
    prepare_all,
)
from gdtool.fields.grid.refine import _inside_silhouettes, drop_debris, fit_to_normals, normal_deviation_degrees, refine
from gdtool.fields.views.depth_alignment import (
    Corrections,
    agreement,
    corrections,
    disagreement,
    normals_fit_depth,
    slope_equations,
)
from gdtool.fields.views.prepared_view import (
    free_distance,
    grow_silhouette,
    hull_distance,
    prepare,
    silhouette_distance,
)
from gdtool.geometry.distance import closest_points
from gdtool.geometry.grids import components, signed_volume
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.metrics import inside
from gdtool.geometry.normals import vertex_normals
from gdtool.geometry.topology import euler_number

from .shapes import cube, gradient, sphere, torus, two_balls, views_of

SIZE = 72


@pytest.fixture(scope="module")
def seen():
    return {solid.__name__: views_of(solid, SIZE) for solid in (sphere, cube, torus, two_balls)}


def reconstruct(cameras, images, mask, depth=True, normal=True):
    step = grid_step(cameras, 0)
    given = images["depth"] if depth else depth_for(cameras, mask, images["normal"]) if normal else None
    prepared, _, noise = align_depth(cameras, mask, given, images["normal"] if normal else None, step)
    return fuse_views(prepared, step, FusionOptions(noise=noise, outvoted=silhouettes_outvoted(prepared)))


# Pixels are 0.02 wide here: the bounds are a tenth of one on average, two at the worst.
@pytest.mark.parametrize("solid, volume", [(sphere, np.pi / 6), (cube, 1.0), (torus, 2 * np.pi**2 * 0.35 * 0.15**2)])
def test_all_domains_meet_the_analytic_surface(seen, solid, volume):
    shape = reconstruct(*seen[solid.__name__])
    error = np.abs(solid(shape.mesh.vertices))
    assert is_closed_manifold(shape.mesh.faces)
    assert error.mean() < 0.002
    assert error.max() < 0.04
    assert signed_volume(shape.mesh) == pytest.approx(volume, rel=0.02)  # positive: wound outward


@pytest.mark.parametrize("depth, normal, bound", [(True, False, 0.003), (False, True, 0.006), (False, False, 0.02)])
def test_subsets_of_the_domains(seen, depth, normal, bound):
    shape = reconstruct(*seen["torus"], depth=depth, normal=normal)
    assert is_closed_manifold(shape.mesh.faces)
    assert np.abs(torus(shape.mesh.vertices)).mean() < bound
    euler = len(shape.mesh.vertices) - len(shape.mesh.faces) // 2
    assert euler == 0  # one hole, as seen from the front


def test_edges_are_drawn_out(monkeypatch):
    """Of a cube turned away from the grid: marching cubes alone takes a bevel a cell wide off every edge."""
    turn = np.linalg.qr(np.array([[0.8, 0.3, -0.5], [-0.2, 0.9, 0.4], [0.6, -0.1, 0.8]]))[0]
    cameras, images, mask = views_of(lambda points: cube(points @ turn, 0.3), SIZE)
    prepared, step = prepare_all(cameras, mask, images["depth"], images["normal"]), grid_step(cameras, 0)
    along = np.linspace(-0.25, 0.25, 41)
    edges = [
        np.insert(np.full((41, 2), (a, b)), axis, along, 1) @ turn.T
        for axis in range(3)
        for a in (0.3, -0.3)
        for b in (0.3, -0.3)
    ]

    def missed():
        shape = fuse_views(prepared, step)
        assert is_closed_manifold(shape.mesh.faces)
        assert len(fold_midpoints(shape.mesh)) == 0
        return np.array([closest_points(edge, shape.mesh)[0].mean() for edge in edges])

    sharp = missed()
    monkeypatch.setattr("gdtool.fields.grid.fusion.sharpen_creases", lambda mesh, *_: mesh)
    blunt = missed()
    assert (sharp < blunt).all()
    assert sharp.mean() < 0.85 * blunt.mean()


def box(points, centre, half):
    q = np.abs(points - centre) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def test_a_narrow_gap_stays_open():
    """Two handles before a head: only a pixel or two of one view shows, beside jumps in depth, that they do not
    touch."""

    def opener(points):
        handles = np.minimum(*(box(points, [0.12, 0, side * 0.125], [0.3, 0.12, 0.1]) for side in (1, -1)))
        return np.minimum(handles, box(points, [-0.3, 0, 0], [0.12, 0.2, 0.2]))

    shape = reconstruct(*views_of(opener, SIZE))
    along, up = np.meshgrid(np.linspace(-0.1, 0.38, 25), np.linspace(-0.08, 0.08, 9))
    between, within = (np.stack([along, up, np.full_like(along, z)], -1).reshape(-1, 3) for z in (0.0, 0.1))
    assert is_closed_manifold(shape.mesh.faces)
    assert inside(between, shape.mesh).mean() < 0.1
    assert inside(within, shape.mesh).all()


def test_what_leaves_a_silhouette_goes_back_as_far_as_it_must():
    """Also where it began beyond a picture that cuts the object, of which nothing is known."""
    camera = rig("six", SIZE)[0]
    mask = np.zeros((SIZE, SIZE), np.float32)
    mask[:, : SIZE // 2] = 1
    prepared_view = prepare(camera, mask)
    at = np.array([1.0, 0.0, 0.0])  # to the right of the front view
    start, end = np.array([-0.2, 0.1, 3.0])[:, None] * at, np.array([0.3, 0.1, 0.3])[:, None] * at
    found = _inside_silhouettes(end, start, [prepared_view], 0.01)
    assert prepared_view.cropped
    assert np.isfinite(found).all()
    assert np.allclose(found @ at, [0.01, 0.1, 3.0], atol=2e-3)


def test_two_pieces_stay_two(seen):
    shape = reconstruct(*seen["two_balls"])
    assert components(shape.mesh.faces, len(shape.mesh.vertices)).max() == 1
    assert np.abs(two_balls(shape.mesh.vertices)).mean() < 0.002


def test_silhouette_distance_is_subpixel():
    """A half-plane whose edge cuts pixels at 10.3: distances are exact to a hundredth of a pixel beside it."""
    mask = np.zeros((32, 32), np.float32)
    mask[:, :10], mask[:, 10] = 1, 0.3
    distance = silhouette_distance(mask)
    assert distance[16, 8] == pytest.approx(8.5 - 10.3, abs=0.1)
    assert distance[16, 12] == pytest.approx(12.5 - 10.3, abs=0.1)


def test_line_thinner_than_a_pixel_keeps_an_inside():
    mask = np.zeros((16, 16), np.float32)
    mask[:, 8] = 0.3
    assert (silhouette_distance(mask) < 0).any()
    assert (silhouette_distance(np.zeros((16, 16), np.float32)) > 8).all()


def test_views_measure_distances_from_both_sides(seen):
    cameras, images, mask = seen["sphere"]
    front = prepare_all(cameras, mask, images["depth"], images["normal"])[0]
    points = np.array([[0, 0, 0.55], [0, 0, 0.45], [0.1, 0.1, 0.5]])
    value, weight = free_distance(front, points)
    assert value == pytest.approx(sphere(points), abs=2e-3)
    assert (weight > 0.5).all()
    assert hull_distance(front, np.array([[0.6, 0, 0], [0, 0.4, 0]])) == pytest.approx([0.1, -0.1], abs=2e-3)


def test_alignment_undoes_a_shift_of_depth(seen):
    cameras, images, mask = seen["torus"]
    depth = images["depth"].copy()
    depth[0][mask[0] > 0] += 0.02
    prepared = prepare_all(cameras, mask, depth, images["normal"])
    clean = disagreement(prepare_all(cameras, mask, images["depth"], images["normal"]))
    assert disagreement(prepared) > 5 * clean
    found = corrections(prepared, [slope_equations(s) for s in prepared], Corrections.none(len(prepared)), 0.08, 2.0)
    assert found.depth(0, mask[0].shape)[mask[0] > 0.99].mean() < -0.008
    after = align_depth(cameras, mask, depth, images["normal"], grid_step(cameras, 0))
    assert after[2] < 0.4 * after[1]


def test_views_of_which_only_some_agree_are_brought_together(seen):
    """One lies a step too deep: most points are confirmed for all that."""
    cameras, images, mask = seen["sphere"]
    step, k, depth = grid_step(cameras, 0), [camera.name for camera in cameras].index("right"), images["depth"].copy()
    depth[k] += np.where(mask[k] > 0, step, 0).astype(np.float32)
    prepared, before, noise = align_depth(cameras, mask, depth, images["normal"], step)
    assert before < 0.1 * step < 0.2 * step < noise
    exact = align_depth(cameras, mask, images["depth"], images["normal"], step)
    assert exact[1] == exact[2] < 0.1 * step


def bumpy(seen, name):
    """Sights of a solid whose depths are off by waves of a pixel, their grid step and noise."""
    cameras, images, mask = seen[name]
    y, x = np.mgrid[:SIZE, :SIZE]
    waves = np.stack([0.02 * np.sin(0.6 * x + k) * np.sin(0.5 * y - 2 * k) for k in range(6)])
    depth = np.where(images["depth"] > 0, images["depth"] + waves, 0).astype(np.float32)
    step = grid_step(cameras, 0)
    prepared, _, noise = align_depth(cameras, mask, depth, images["normal"], step)
    return prepared, step, noise


def degrees_off(solid, vertices, faces):
    cosine = (vertex_normals(TriMesh(vertices, faces)) * gradient(solid, vertices)).sum(1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("solid", [sphere, torus])
def test_bumps_that_the_normals_do_not_show_go(seen, solid):
    prepared, step, noise = bumpy(seen, solid.__name__)
    rough, smooth = (
        fuse_views(prepared, step, FusionOptions(noise=noise, has_normals=shaded)) for shaded in (False, True)
    )
    assert rough.bumps is None
    assert smooth.bumps > BUMPY_DEGREES
    assert is_closed_manifold(smooth.mesh.faces)
    before, after = (
        degrees_off(solid, rough.mesh.vertices, rough.mesh.faces),
        degrees_off(solid, smooth.mesh.vertices, smooth.mesh.faces),
    )
    assert np.median(after) < 0.6 * np.median(before)
    assert np.abs(solid(smooth.mesh.vertices)).mean() < np.abs(solid(rough.mesh.vertices)).mean() + 1e-4


@pytest.mark.parametrize("solid", [sphere, torus])
def test_a_surface_grows_by_as_much_as_it_is_asked_to(seen, solid):
    prepared, step, noise = bumpy(seen, solid.__name__)
    plain, grown = (fuse_views(prepared, step, FusionOptions(noise=noise, grow=grow)) for grow in (0.0, step / 2))
    assert np.mean(solid(grown.mesh.vertices)) - np.mean(solid(plain.mesh.vertices)) == pytest.approx(
        step / 2, rel=0.15
    )
    assert is_closed_manifold(grown.mesh.faces)


@pytest.mark.parametrize("solid", [sphere, cube, torus])
def test_a_surface_that_fits_its_normals_hardly_follows_them(seen, solid):
    """What the skip leaves out: a tenth of a grid step at most places."""
    cameras, images, mask = seen[solid.__name__]
    step = grid_step(cameras, 0)
    shape = reconstruct(cameras, images, mask)
    prepared = prepare_all(cameras, mask, images["depth"], images["normal"])
    assert normal_deviation_degrees(shape.mesh, prepared, 2 * step) < BUMPY_DEGREES
    moved = (
        np.linalg.norm(
            fit_to_normals(shape.mesh, prepared, step, reach=2 * step) - shape.mesh.vertices,
            axis=1,
        )
        / step
    )
    assert moved.mean() < 0.05
    assert np.quantile(moved, 0.9) < 0.1


def test_a_thin_wall_that_two_views_turn_inside_out_has_no_hole():
    """A dish that opens to the front; from the front its floor, 0.02 thick, lies 0.04 too deep in the middle, and so it
    does from the back."""

    def dish(points):
        return np.maximum(
            box(points, np.zeros(3), np.array([0.4, 0.4, 0.15])),
            -box(points, np.array([0, 0, 0.02]), np.array([0.34, 0.34, 0.15])),
        )

    cameras, images, mask = views_of(dish)
    names, depth = [camera.name for camera in cameras], images["depth"].copy()
    y, x = np.mgrid[:96, :96] + 0.5
    bump = 0.04 * np.exp(-((x - 48) ** 2 + (y - 48) ** 2) / 20**2)
    for name in ("front", "back"):
        k = names.index(name)
        depth[k] += np.where(mask[k] > 0, bump, 0).astype(np.float32)
    step = grid_step(cameras, 0)
    prepared, _, noise = align_depth(cameras, mask, depth, images["normal"], step)
    shape = fuse_views(prepared, step, FusionOptions(noise=noise))
    assert is_closed_manifold(shape.mesh.faces)
    assert components(shape.mesh.faces, len(shape.mesh.vertices)).max() == 0
    assert euler_number(shape.mesh.faces) == 2


def test_what_a_grown_silhouette_gains_is_free_as_far_as_beside_it(seen):
    cameras, images, mask = seen["cube"]
    pixel, edge = cameras[0].pixel_size, 2 * cameras[0].pixel_size
    small = np.zeros_like(mask[0])
    small[4:-4, 4:-4] = mask[0][4:-4, 4:-4] * (
        np.hypot(*(np.indices(small.shape[:2])[:, 4:-4, 4:-4] - SIZE / 2 + 0.5)) < 0.3 / pixel
    )
    prepared_view = prepare(cameras[0], small, np.where(small > 0, images["depth"][0], 0), images["normal"][0])
    grown = grow_silhouette(prepared_view, edge)
    rim, beyond = np.array([[0.3 + pixel, 0, 0.6]]), np.array([[0.3 + 6 * pixel, 0, 0.6]])
    assert hull_distance(grown, rim) < 0 < hull_distance(prepared_view, rim)
    assert not np.isfinite(free_distance(prepared_view, rim)[0])
    assert free_distance(grown, rim)[0] == pytest.approx([0.1], abs=2e-3)
    assert free_distance(grown, rim)[1] < 1e-3  # a bound: no surface of its own
    assert not np.isfinite(free_distance(grown, beyond)[0])
    # Nothing is gained by one that shrinks, and what was seen is seen as before.
    inner = np.array([[0.1, 0.05, 0.6]])
    assert np.array_equal(grow_silhouette(prepared_view, -edge).weight, prepared_view.weight)
    assert free_distance(grown, inner)[0] == free_distance(prepared_view, inner)[0]


@pytest.mark.parametrize("seen_vertices, hollows, left", [(40, True, 2), (40, False, 1), (1, True, 1)])
def test_a_hollow_stays_where_views_see_into_it(seen_vertices, hollows, left):
    from skimage.measure import marching_cubes

    axis = np.linspace(-0.6, 0.6, 61)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    vertices, faces, _, _ = marching_cubes(np.maximum(sphere(grid), -sphere(grid, 0.2)), 0.0, spacing=(0.02,) * 3)
    vertices, inner = vertices - 0.6, np.linalg.norm(vertices - 0.6, axis=1) < 0.3
    support = np.where(inner, 0.0, 1.0)
    support[np.flatnonzero(inner)[:seen_vertices]] = 1.0
    made, dropped = drop_debris(TriMesh(vertices, faces), support, 0.02, hollows)
    vertices, faces = made.vertices, made.faces
    assert components(faces, len(vertices)).max() + 1 == left
    assert dropped == 2 - left


def test_silhouettes_that_were_grown_or_shrunk_are_found_out(seen):
    """Half of the masks a pixel too large, half too small, and every depth bent: each view's share is told apart."""
    from scipy.ndimage import maximum_filter, minimum_filter

    cameras, images, mask = seen["torus"]
    grown = np.array([1, -1, 1, -1, -1, 1])
    wrong = np.stack([(maximum_filter if g > 0 else minimum_filter)(m, 3) for g, m in zip(grown, mask, strict=True)])
    bend = np.stack([0.01 * np.sin(np.arange(SIZE) / 9 + k) for k in range(6)])[:, None, :]
    depth = np.where(images["depth"] > 0, images["depth"] + bend, 0).astype(np.float32)
    prepared = prepare_all(cameras, wrong, depth, images["normal"])
    slopes, found = [slope_equations(s) for s in prepared], Corrections.none(6)
    found = corrections(prepared, slopes, found, 0.08, 1.0)
    pixel = cameras[0].pixel_size
    # What all have in common stays open to within a part of a pixel; the difference is two pixels.
    assert np.abs(found.edge / pixel + grown).max() < 0.5
    assert (found.edge[grown < 0].min() - found.edge[grown > 0].max()) / pixel > 1.5


def test_slopes_say_how_the_depth_bends(seen):
    cameras, images, mask = seen["sphere"]
    ramp = 0.02 * np.linspace(-1, 1, SIZE)[None, :]
    prepared_view = prepare_all(
        cameras[:1],
        mask[:1],
        np.where(mask[:1] > 0, images["depth"][:1] + ramp, 0).astype(np.float32),
        images["normal"][:1],
    )[0]
    _, _, slope, weight = slope_equations(prepared_view)
    # Down the rows first, then along them.
    across = np.average(slope[: len(slope) // 2], weights=weight[: len(slope) // 2])
    along = np.average(slope[len(slope) // 2 :], weights=weight[len(slope) // 2 :])
    assert abs(across) < 0.004
    assert along == pytest.approx(-0.04 / (SIZE * cameras[0].pixel_size), abs=0.006)


def test_views_that_contradict_one_another_still_close(seen):
    cameras = seen["sphere"][0]
    kinds = ["sphere", "torus", "two_balls", "cube", "torus", "two_balls"]
    images = {n: np.stack([seen[kind][1][n][k] for k, kind in enumerate(kinds)]) for n in ("depth", "normal")}
    shape = reconstruct(cameras, images, np.stack([seen[kind][2][k] for k, kind in enumerate(kinds)]))
    assert is_closed_manifold(shape.mesh.faces)
    assert np.isfinite(shape.mesh.vertices).all()
    assert signed_volume(shape.mesh) > 0.01


def test_flat_card_and_empty_views_close():
    """A card a thirtieth of a pixel thick, edge-on in two views; one view shows nothing at all."""

    def card(p):
        return np.max(np.abs(p) - [0.5, 0.4, 0.0005], -1)

    cameras, images, mask = views_of(card, 48)
    mask[4] = 0
    shape = reconstruct(cameras, images, mask)
    assert is_closed_manifold(shape.mesh.faces)
    assert np.ptp(shape.mesh.vertices[:, 0]) > 0.95
    assert np.ptp(shape.mesh.vertices[:, 1]) > 0.75
    # As thin as the grid can hold, and without a hole.
    assert np.abs(shape.mesh.vertices[:, 2]).max() < 1.2 * shape.step
    assert len(shape.mesh.vertices) - len(shape.mesh.faces) // 2 == 2


def test_true_views_confirm_one_another_and_noise_does_not(seen):
    cameras, images, mask = seen["torus"]
    normal = images["normal"]
    assert agreement(prepare_all(cameras, mask, images["depth"], normal)) > 0.6
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.uniform(1.5, 2.5, (len(cameras), SIZE // 12, SIZE // 12)), np.ones((12, 12)))
    assert agreement(prepare_all(cameras, mask, np.where(mask > 0.5, blocks, 0).astype(np.float32), normal)) < 0.25
    assert agreement(prepare_all(cameras, mask, None, None)) == 1.0


def test_normals_of_another_surface_are_found_out(seen):
    for name in ("sphere", "cube", "torus"):
        cameras, images, mask = seen[name]
        assert normals_fit_depth(cameras, mask, images["depth"], images["normal"]) > 0.9
    assert normals_fit_depth(cameras, mask, images["depth"], np.roll(images["normal"], 1, -1)) < 0.5
    assert normals_fit_depth(cameras, mask, images["depth"], -images["normal"]) == 0.0


def test_what_no_view_sees_stays_where_the_carving_put_it():
    """A cube that nothing is known of: its corners give way to bending by less than a cell, the rest hardly at all."""
    cube, cell = trimesh.creation.box((1, 1, 1)), 1 / 32
    for _ in range(5):
        cube = cube.subdivide()
    move = np.linalg.norm(
        refine(TriMesh(np.asarray(cube.vertices), np.asarray(cube.faces)), [], cell, reach=0.1) - cube.vertices, axis=1
    )
    assert 0 < move.max() < 0.8 * cell
    assert move.mean() < 0.08 * cell
