"""Check training: batches, augmentation, the loop, and exact resuming."""

import csv

import msgspec
import numpy as np
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import PRESETS, Phase
from gdtool.diffusion.data.objects import (
    LIGHT_COUNT,
    Objects,
    draw_batch,
    from_bytes,
    mirror_object,
    object_order,
    permute_colors,
    to_bytes,
)
from gdtool.diffusion.network.encoding import PLANES, planes_from_images
from gdtool.diffusion.network.labels import class_labels
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.training import loop as training
from gdtool.diffusion.training import objective, optimizer
from gdtool.diffusion.training.loop import (
    CHECKPOINT,
    Observers,
    RunOptions,
    learning_rate,
    new_state,
    phase_at,
    run_training,
)
from gdtool.diffusion.training.objective import choose_step
from tests.diffusion.spheres import LIGHT, sphere_views

MODEL, TRAIN = PRESETS["tiny"]
MODEL = msgspec.structs.replace(MODEL, channels=(8, 16), head_width=8, encoder_width=16, image_size=16)


def spheres(count=4, size=16) -> Objects:
    planes, conditions = [], []
    for seed in range(count):
        views = sphere_views(seed, size)
        planes.append(planes_from_images(views.images, views.mask))
        conditions.append(planes[-1][0][[0, 1, 2, 12]])
    light = np.zeros((LIGHT_COUNT, 7), np.float32)
    light[:, 2] = 1
    light[:2] = np.concatenate([LIGHT["axes"], np.array(LIGHT["sharpness"])[:, None], LIGHT["amplitudes"]], 1)
    return Objects(
        to_bytes(np.stack(planes)),
        to_bytes(np.stack(conditions))[:, None],
        np.stack([light] * count),
        tuple(f"sphere{i}" for i in range(count)),
    )


def test_bytes_keep_zero_exactly():
    assert float(from_bytes(to_bytes(np.zeros(1)))) == 0.0
    x = np.linspace(-1, 1, 101)
    np.testing.assert_allclose(from_bytes(to_bytes(x)), x, atol=0.5 / 127 + 1e-6)


def test_mirroring_swaps_sides_and_is_its_own_inverse():
    objects = spheres(1, 32)
    args = from_bytes(objects.planes[0]), from_bytes(objects.conditions[0, 0]), torch.from_numpy(objects.lights[0])
    once = mirror_object(*args, MODEL.views)
    for a, b in zip(args, mirror_object(*once, MODEL.views), strict=True):
        torch.testing.assert_close(a, b)
    right, left = (MODEL.views.index(v) for v in ("right", "left"))
    albedo = once[0][:, PLANES["albedo"]]
    # red is on +x before and on -x after; the right camera looks at +x
    assert args[0][right, PLANES["albedo"]][0].max() > 0.2 > args[0][left, PLANES["albedo"]][0].max()
    assert albedo[left, 0].max() > 0.2 > albedo[right, 0].max()
    # normals still point toward the camera that sees them
    x = once[0][right, PLANES["normal"].start]
    assert x.min() >= 0
    assert x.max() > 0.9


def test_permuted_colors_permute_the_light_as_well():
    objects = spheres(1)
    planes, rgba, light = (
        from_bytes(objects.planes[0]),
        from_bytes(objects.conditions[0, 0]),
        torch.from_numpy(objects.lights[0]),
    )
    new = permute_colors(planes, rgba, light, [2, 0, 1])
    torch.testing.assert_close(new[0][:, 0], planes[:, 2])
    torch.testing.assert_close(new[0][:, PLANES["albedo"].start], planes[:, PLANES["albedo"].start + 2])
    torch.testing.assert_close(new[1][0], rgba[2])
    torch.testing.assert_close(new[2][:, 4], light[:, 6])
    torch.testing.assert_close(new[0][:, PLANES["normal"]], planes[:, PLANES["normal"]])


def test_each_pass_shows_each_object_once():
    order = np.concatenate([object_order(6, step, 4, seed=1) for step in range(3)])
    assert sorted(order[:6]) == list(range(6)) == sorted(order[6:])
    assert (object_order(6, 1, 4, 1) == object_order(6, 1, 4, 1)).all()
    assert (object_order(50, 0, 50, 1) != object_order(50, 0, 50, 2)).any()


def test_steps_have_color_and_the_phases_number_of_domains_and_views():
    for step in range(5):
        chosen = choose_step(MODEL, Phase(domains=3, views=2), 0, step)
        assert chosen.domains[0] == 0
        assert len(set(chosen.domains)) == 3
        assert len(chosen.views.unique()) == 2
    assert choose_step(MODEL, Phase(), 0, 0).domains == tuple(range(6))


def test_a_phase_may_set_its_batch_size(monkeypatch):
    batches = []
    monkeypatch.setattr(
        training, "draw", lambda objects, idx, *rest: batches.append(len(idx)) or draw_batch(objects, idx, *rest)
    )
    train = msgspec.structs.replace(TRAIN, phases=(Phase(share=1.0, domains=1, views=1, batch=3),))
    training.train_step(new_state(Model(MODEL), train), spheres(), train, 0, None, "cpu")
    assert sum(batches) == 3 != TRAIN.batch


def test_phases_and_rate_follow_progress():
    train = msgspec.structs.replace(
        TRAIN, phases=(Phase(share=0.5, learning_rate=1.0), Phase(share=1.0, learning_rate=0.1)), warmup=10
    )
    assert phase_at(0.49, train).learning_rate == 1.0
    assert phase_at(0.5, train).learning_rate == 0.1
    assert phase_at(1.0, train).learning_rate == 0.1
    state = new_state(Model(MODEL), train)
    assert learning_rate(state, 0.0, train) == pytest.approx(0.1)
    state.step = 100
    assert learning_rate(state, 0.0, train) == pytest.approx(1.0)


def test_class_labels_tell_all_36_apart():
    labels = class_labels(MODEL).flatten(0, 1)
    assert labels.shape == (36, 18)
    assert (torch.cdist(labels, labels) + torch.eye(36) > 0.5).all()


def train(workspace, steps, **changes):
    torch.manual_seed(0)
    options = msgspec.structs.replace(TRAIN, steps=12, warmup=2, **changes)
    workspace.mkdir(exist_ok=True)
    stopped = {}

    class Stop(Exception):
        pass

    def stop(state):
        stopped["state"] = state
        if state.step == steps:
            raise Stop

    try:
        return run_training(
            Model(MODEL),
            spheres(),
            options,
            workspace,
            RunOptions(seed=3, checkpoint_every=4, validate_every=1),
            observers=Observers(validate=stop),
        )
    except Stop:
        return stopped["state"]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_killed_run_resumes_bit_for_bit(tmp_path, precision):
    whole = train(tmp_path / "a", None, precision=precision)
    train(tmp_path / "b", 7, precision=precision)  # dies at step 7, its last checkpoint is of step 4
    resumed = train(tmp_path / "b", None, precision=precision)
    assert resumed.step == whole.step == 12
    for (name, p), (_, q) in zip(whole.model.named_parameters(), resumed.model.named_parameters(), strict=True):
        assert torch.equal(p, q), name
        assert torch.equal(whole.average[name], resumed.average[name]), name
    without_time = [
        [
            {k: v for k, v in row.items() if k != "seconds"}
            for row in csv.DictReader((tmp_path / w / "loss.csv").read_text().splitlines())
        ]
        for w in "ab"
    ]
    assert without_time[0] == without_time[1]
    assert len(without_time[0]) == 12


def test_a_killed_run_with_muon_resumes_bit_for_bit(tmp_path, monkeypatch):
    monkeypatch.setattr(optimizer, "MIN_MUON_SIDE", 8)
    whole = train(tmp_path / "a", None, optimizer="muon")
    assert len(whole.optimizer.matrices) > 20
    train(tmp_path / "b", 7, optimizer="muon")
    resumed = train(tmp_path / "b", None, optimizer="muon")
    for (name, p), (_, q) in zip(whole.model.named_parameters(), resumed.model.named_parameters(), strict=True):
        assert torch.equal(p, q), name
    adam = train(tmp_path / "c", None)
    name, p = next((n, p) for n, p in whole.model.named_parameters() if any(p is q for q in whole.optimizer.matrices))
    assert not torch.equal(p, dict(adam.model.named_parameters())[name])


def test_muon_moves_a_matrix_alike_in_all_its_directions(monkeypatch):
    monkeypatch.setattr(optimizer, "MIN_MUON_SIDE", 8)
    model = Model(MODEL)
    muon = optimizer.make_optimizer(model, msgspec.structs.replace(TRAIN, optimizer="muon", weight_decay=0.0))
    for group in muon.param_groups:
        group["lr"] = 1e-3 * group["rate"]
    p = muon.matrices[0]
    before = p.detach().clone()
    generator = torch.Generator().manual_seed(0)
    # a gradient that is nearly of rank one: AdamW would move the same way everywhere
    p.grad = torch.outer(
        torch.randn(p.shape[0], generator=generator), torch.randn(p[0].numel(), generator=generator)
    ).view(p.shape)
    p.grad += 0.05 * torch.randn(p.shape, generator=generator)
    muon.step()
    gradient, moved = (torch.linalg.svdvals(x.flatten(1)) for x in (p.grad, p.detach() - before))
    middle = len(gradient) // 2
    assert gradient[0] / gradient[middle] > 20
    assert moved[0] / moved[middle] < 3  # Newton-Schulz brings singular values near 1


def test_a_checkpoint_of_another_configuration_is_refused(tmp_path):
    train(tmp_path / "a", 5)
    with pytest.raises(InputError, match="another configuration"):
        train(tmp_path / "a", None, clip=2.0)


def test_a_damaged_checkpoint_is_named(tmp_path):
    train(tmp_path / "a", 5)
    path = tmp_path / "a" / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match="safetensors"):
        train(tmp_path / "a", None)


def test_training_lowers_the_error(tmp_path):
    torch.manual_seed(0)
    options = msgspec.structs.replace(
        TRAIN,
        steps=60,
        batch=2,
        pbr_weight=0.0,
        pure_noise=1.0,
        phases=(Phase(learning_rate=3e-3),),
        precision="float32",
    )
    state = run_training(Model(MODEL), spheres(), options, tmp_path, RunOptions(seed=0))
    rows = list(csv.DictReader((tmp_path / "loss.csv").read_text().splitlines()))
    first, last = (np.mean([float(r["loss"]) for r in part]) for part in (rows[:5], rows[-5:]))
    assert state.step == 60
    assert last < 0.5 * first
    assert all(float(rows[-1][d]) > 0 for d in DOMAINS)


def poisoned(monkeypatch, bad):
    """Make the gradient of view_losses() not finite in the steps for which bad(number) is true."""
    plain = objective.view_losses

    def losses(model, batch, step, *rest):
        out = plain(model, batch, step, *rest)
        return out | {"loss": out["loss"] * float("nan")} if bad(step.number) else out

    monkeypatch.setattr(objective, "view_losses", losses)


def test_steps_with_a_gradient_that_is_not_finite_are_skipped_with_a_warning(tmp_path, monkeypatch):
    poisoned(monkeypatch, lambda number: number in (1, 2, 5))
    warnings = []
    state = run_training(
        Model(MODEL),
        spheres(),
        msgspec.structs.replace(TRAIN, steps=7),
        tmp_path,
        RunOptions(seed=0),
        observers=Observers(warn=warnings.append),
    )
    assert [line.split(" is left out")[0] for line in warnings] == ["step 2", "step 3", "step 6"]
    assert "2 in a row" in warnings[1]
    assert [row["skipped"] for row in csv.DictReader((tmp_path / "loss.csv").read_text().splitlines())] == list(
        "0110010"
    )
    assert all(torch.isfinite(p).all() for p in state.model.parameters())


def test_a_lost_run_ends_with_finite_weights_in_its_checkpoint(tmp_path, monkeypatch):
    poisoned(monkeypatch, lambda number: number >= 4)
    with pytest.raises(InputError, match="not finite in 10 steps up to 14"):
        run_training(
            Model(MODEL),
            spheres(),
            msgspec.structs.replace(TRAIN, steps=40),
            tmp_path,
            RunOptions(seed=0, checkpoint_every=4),
        )
    assert all(torch.isfinite(x).all() for x in training.read_tensors(tmp_path / CHECKPOINT)[0].values())


def test_minutes_end_a_run(tmp_path):
    options = msgspec.structs.replace(TRAIN, steps=10**9, pbr_weight=0.0)
    state = run_training(Model(MODEL), spheres(), options, tmp_path, RunOptions(seed=0, minutes=0.01))
    assert 0.6 <= state.seconds < 60
    assert 1 <= state.step < 10**6  # on a busy machine one step may take seconds
