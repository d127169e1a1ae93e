"""Check the shape network, its training, and the guides that are made of its volumes."""

import msgspec
import numpy as np
import pytest
import torch

from gdtool.core.errors import UsageError
from gdtool.diffusion.config import PRESETS, SHAPE_TRAINING, ModelConfig, Phase, ShapeConfig
from gdtool.diffusion.configure import configuration
from gdtool.diffusion.data.objects import LIGHT_COUNT, Objects, condition_plane, to_bytes
from gdtool.diffusion.data.volumes import draw_shape_batch, pack_volume
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.inference.shape import make_guides, no_images, predict_volume
from gdtool.diffusion.network.encoding import encode, planes_from_images
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.shape.guides import base_images, mirror_guides, project_picture
from gdtool.diffusion.shape.render import Rendered
from gdtool.diffusion.shape.volume import crop
from gdtool.diffusion.training.loop import RunOptions, new_state, run_training, train_step
from tests.diffusion.spheres import LIGHT, sphere_views

MODEL = msgspec.structs.replace(
    PRESETS["volume"][0],
    image_size=32,
    channels=(16, 32),
    attention_levels=(False, True),
    row_attention=(True, False),
    head_width=16,
    norm_groups=4,
    encoder_width=16,
    encoder_layers=1,
    encoder_patch=8,
    shape=ShapeConfig(channels=(16, 16), norm_groups=4, head_width=16, embedding=16, code=4, prior_width=16),
)
TRAIN = msgspec.structs.replace(PRESETS["volume"][1], batch=2, steps=6, warmup=2, optimizer="adamw")
SHAPE = msgspec.structs.replace(
    SHAPE_TRAINING, batch=2, steps=6, warmup=2, optimizer="adamw", phases=(Phase(learning_rate=2e-3),), ema=0.5
)
MASK = slice(12, 13)


def spheres(count=3, size=32) -> Objects:
    planes = [planes_from_images(v.images, v.mask) for v in (sphere_views(seed, size) for seed in range(count))]
    light = np.zeros((LIGHT_COUNT, 7), np.float32)
    light[:, 2] = 1
    light[:2] = np.concatenate([LIGHT["axes"], np.array(LIGHT["sharpness"])[:, None], LIGHT["amplitudes"]], 1)
    return Objects(
        to_bytes(np.stack(planes)),
        to_bytes(np.stack([p[0][[0, 1, 2, 12]] for p in planes]))[:, None],
        np.stack([light] * count),
        tuple(f"sphere{i}" for i in range(count)),
        np.stack([pack_volume(p, MODEL.views) for p in planes]),
    )


def sphere_picture(size=32) -> torch.Tensor:
    """Return the front view of a sphere as a picture (4, h, h), sRGB times coverage and coverage, in [0, 1]."""
    views = sphere_views(0, size)
    image = np.concatenate([views.images["color"][0], views.mask[0][..., None]], -1)
    rgba = 0.5 + 0.5 * torch.from_numpy(condition_plane(image))
    rgba[:3] -= 0.5 * (1 - rgba[3])
    return rgba


def random_model(seed=0) -> Model:
    torch.manual_seed(seed)
    model = Model(MODEL).eval()
    torch.nn.init.normal_(model.shape.write.weight, std=0.3)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    return model


def true_guides():
    views = sphere_views(0, 32)
    rgba = sphere_picture()[None]
    normal = torch.from_numpy(np.moveaxis(views.images["normal"], -1, 1))[None]
    mask, depth = (torch.from_numpy(x)[None] for x in (views.mask, views.images["depth"]))
    return project_picture(rgba, Rendered(mask, depth, normal), MODEL.views), views


def test_the_front_silhouette_of_a_predicted_volume_is_the_pictures():
    rgba = sphere_picture()
    volume = predict_volume(random_model(), rgba)
    behind = volume[0].amax(0) > 0.5
    assert torch.equal(behind, crop(rgba)[3] > 0.5)


@pytest.mark.parametrize("fill", [0.0, 1.0])
def test_empty_and_full_pictures_give_finite_guides(fill):
    rgba = torch.full((1, 4, 32, 32), 2 * fill - 1)
    guides = make_guides(random_model(), rgba)
    assert all(torch.isfinite(x).all() for x in guides)


def test_a_code_changes_the_shape_only_where_it_is_told():
    model, rgba = random_model(), sphere_picture()
    best = predict_volume(model, rgba)
    assert torch.equal(best, predict_volume(model, rgba))
    first, second = (predict_volume(model, rgba, seed=seed) for seed in (1, 2))
    assert torch.equal(first, predict_volume(model, rgba, seed=1))
    assert not torch.equal(first, second)


def test_known_silhouettes_bound_the_volume():
    model, objects = random_model(), spheres(1)
    known = no_images(model, 1)
    k = MODEL.views.index("right")
    known.given[0, 0, k] = 1
    known.mask[0, k, :, 14:18] = 1  # a narrow strip
    rgba = torch.from_numpy(condition_plane(np.ones((32, 32, 4), np.float32)))[None]
    guides = make_guides(model, rgba, known)
    columns = torch.nonzero((guides.mask[0, k] > 0.5).any(0)).flatten()
    assert columns.min() >= 14
    assert columns.max() <= 17
    assert len(objects)


def test_known_geometry_is_taken_as_it_is():
    model, objects = random_model(), spheres(1)
    planes = torch.from_numpy(objects.planes.astype(np.float32)) / 127 - 1
    images = encode(planes, tuple(range(6)), torch.zeros(1))
    known = no_images(model, 1)._replace(images=images, mask=0.5 + 0.5 * planes[:, :, 12])
    known.given[0, [MODEL.domains.index(d) for d in ("normal", "depth")]] = 1
    rgba = (2 * sphere_picture() - 1)[None]
    sampled = sample_images(model, rgba, SamplingOptions(steps=1), known=known)
    for domain in ("normal", "depth"):
        torch.testing.assert_close(sampled[domain], images[:, MODEL.domains.index(domain)])
    assert not torch.allclose(sampled["color"], images[:, 0])


def test_the_picture_is_projected_where_it_is_seen():
    guides, views = true_guides()
    front, back, right = (MODEL.views.index(name) for name in ("front", "back", "right"))
    assert guides.visible[0, back].sum() == 0
    seen = guides.visible[0, front] > 0.5
    assert seen.sum() > 0.9 * views.mask[front].sum()
    torch.testing.assert_close(guides.color[0, front][:, seen], (sphere_picture()[:3])[:, seen], atol=1e-5, rtol=0)
    # The right view sees the half that faces the front on the left of its image, the other half on the right.
    columns = torch.nonzero(guides.visible[0, right] > 0.5)[:, 1]
    assert columns.max() < 16
    assert len(columns) > 50


def test_base_images_are_the_true_ones_where_the_shape_is():
    guides, views = true_guides()
    planes = torch.from_numpy(planes_from_images(views.images, views.mask))[None]
    truth, base = (encode(planes, (1, 2), torch.zeros(1)), base_images(guides, (1, 2)))
    torch.testing.assert_close(base, truth, atol=1e-5, rtol=0)


def test_guides_mirrored_twice_are_the_same():
    guides, _ = true_guides()
    for once, twice in zip(guides, mirror_guides(mirror_guides(guides, MODEL.views), MODEL.views), strict=True):
        torch.testing.assert_close(once, twice)


def test_mirrored_guides_are_those_of_the_mirrored_object():
    model, rgba = random_model(), (2 * sphere_picture() - 1)[None]
    rgba[:, 0, :, 10:] *= 0.5
    mirrored = make_guides(model, rgba.flip(-1), mirror=True)
    for own, other in zip(mirrored, mirror_guides(make_guides(model, rgba, mirror=True), MODEL.views), strict=True):
        torch.testing.assert_close(own, other, atol=1e-3, rtol=0)


@pytest.mark.parametrize("part", ["shape", "views"])
def test_training_one_part_leaves_the_other_as_it_is(part):
    torch.manual_seed(0)
    model, train = Model(MODEL), SHAPE if part == "shape" else TRAIN
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    state = new_state(model, train)
    for _ in range(3):
        row = train_step(state, spheres(), train, 0, None, "cpu")
        assert not row["skipped"]
    changed = {name for name, p in model.named_parameters() if not torch.equal(p, before[name])}
    assert changed
    assert all(name.startswith("shape.") == (part == "shape") for name in changed)
    for name in set(before) - changed:
        assert torch.equal(state.average[name], before[name]), name


def test_a_resumed_shape_training_equals_one_that_was_not_stopped(tmp_path):
    results = []
    for name, stops in (("whole", (6,)), ("stopped", (3, 6))):
        (tmp_path / name).mkdir()
        for steps in stops:
            torch.manual_seed(0)
            train = msgspec.structs.replace(SHAPE, decay=False, precision="float32")
            state = _run_to(steps, train, tmp_path / name)
        results.append({n: p.detach().clone() for n, p in state.model.named_parameters()})
    for name, p in results[0].items():
        assert torch.equal(p, results[1][name]), name
    rows = (tmp_path / "stopped/loss.csv").read_text().splitlines()
    assert rows[0].endswith("voxels,front,side,diagonal,prior")
    assert len(rows) == 7


def _run_to(steps, train, folder):
    """Train up to a step; the identity of the run does not depend on where it stops."""

    class Stop(Exception):
        pass

    def log(row):
        if row["step"] == steps < train.steps:
            raise Stop

    from gdtool.diffusion.training.loop import Observers

    model = Model(MODEL)
    try:
        return run_training(model, spheres(), train, folder, RunOptions(seed=0, checkpoint_every=3), Observers(log=log))
    except Stop:
        return None


def test_shape_training_learns_the_volume_of_spheres():
    torch.manual_seed(0)
    train = msgspec.structs.replace(SHAPE, steps=40, precision="float32")
    state, losses = new_state(Model(MODEL), train), []
    for _ in range(40):
        losses.append(train_step(state, spheres(), train, 0, None, "cpu")["loss"])
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:3])


def test_batches_depend_on_their_generators_alone():
    objects, idx = spheres(), np.array([0, 1])
    twice = [
        draw_shape_batch(objects, idx, MODEL, SHAPE, [np.random.default_rng((7, i)) for i in range(2)])
        for _ in range(2)
    ]
    alone = draw_shape_batch(objects, idx[1:], MODEL, SHAPE, [np.random.default_rng((7, 1))])
    for name in ("picture", "space", "occupancy", "known"):
        assert torch.equal(getattr(twice[0], name), getattr(twice[1], name)), name
        assert torch.equal(getattr(twice[0], name)[1:], getattr(alone, name)), name


def test_a_preset_without_a_shape_network_has_no_shape_to_train():
    with pytest.raises(UsageError, match="no shape network"):
        configuration("small", "shape", "none", None, {}, None)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"domain_layout": "images"}, "needs domain_layout"),
        ({"image_size": 48}, "not a multiple of 32"),
        ({"views": ("right", "left")}, "needs the view front"),
    ],
)
def test_a_shape_network_that_does_not_fit_its_model_is_refused(changes, words):
    fields = msgspec.to_builtins(PRESETS["volume"][0]) | changes
    with pytest.raises(msgspec.ValidationError, match=words):
        msgspec.convert(fields, ModelConfig)
