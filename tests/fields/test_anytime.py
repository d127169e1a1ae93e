"""Results that are whole however little time there is."""

import numpy as np
import pytest

from gdtool.fields.clock import Clock
from gdtool.fields.grid import fusion
from gdtool.fields.grid.fusion import (
    AlignmentOptions,
    FusionOptions,
    align_depth,
    align_views,
    fuse_views,
    fuse_within_budget,
    grid_step,
    is_closed_manifold,
    prepare_all,
)

from .shapes import torus, views_of

SIZE = 48


@pytest.fixture(scope="module")
def ring():
    return views_of(torus, SIZE, 1)


@pytest.fixture(scope="module")
def bent(ring):
    cameras, images, mask = ring
    bend = np.stack([0.012 * np.sin(np.arange(SIZE) / 7 + 2 * k) for k in range(6)])[:, None, :]
    return np.where(images["depth"] > 0, images["depth"] + bend, 0).astype(np.float32)


class Ticking:
    """A clock that is a second later every time it is read."""

    def __init__(self, tick=1.0):
        self.now, self.tick = 0.0, tick

    def __call__(self):
        self.now += self.tick
        return self.now


def test_clock():
    ticking = Ticking()
    clock = Clock(3.0, ticking)
    assert clock.limited
    assert clock.left() == 2.0
    assert clock.spent() == 2.0
    assert clock.left() == 0.0
    assert Clock().left() == float("inf")
    assert not Clock().limited


def test_rounds_end_at_a_plateau_and_each_says_the_error(ring, bent):
    cameras, images, mask = ring
    told = []
    prepared = prepare_all(cameras, mask, bent, images["normal"])
    before = fusion.disagreement(prepared)
    _, after = align_views(cameras, mask, bent, images["normal"], prepared, AlignmentOptions(tell=told.append))
    assert after < 0.5 * before
    assert len(fusion.ROUNDS) <= len(told) < len(fusion.ROUNDS) + fusion.MORE_ROUNDS
    assert f"{after:.5f}" in told[-1]


def test_no_time_at_all_gives_one_round_and_the_draft(ring, bent):
    cameras, images, mask = ring
    step, told = grid_step(cameras, 0), []
    clock = Clock(0.5, Ticking())
    prepared, before, noise = align_depth(
        cameras, mask, bent, images["normal"], step, AlignmentOptions(clock=clock, tell=told.append)
    )
    assert len(told) == 1
    assert noise < before
    shape, coarser = fuse_within_budget(prepared, step, options=FusionOptions(noise=noise, outvoted=0), clock=clock)
    assert coarser
    assert shape.step == fusion.DRAFT_COARSENESS * step
    assert is_closed_manifold(shape.mesh.faces)
    assert np.abs(torus(shape.mesh.vertices)).mean() < 0.01


def test_the_finest_grid_that_there_is_time_for(ring):
    cameras, images, mask = ring
    step = grid_step(cameras, 0)
    prepared = prepare_all(cameras, mask, images["depth"], images["normal"])
    steps = [
        fuse_within_budget(
            prepared, step, options=FusionOptions(noise=0.0, outvoted=0), clock=Clock(budget, Ticking())
        )[0].step
        / step
        for budget in (5, 10, 60)
    ]
    assert steps == pytest.approx([2.0, 1.4, 1.0])
    shape, coarser = fuse_within_budget(prepared, step, options=FusionOptions(noise=0.0, outvoted=0), clock=Clock())
    whole = fuse_views(prepared, step)
    assert coarser == ""
    assert (shape.mesh.vertices == whole.mesh.vertices).all()
    assert (shape.mesh.faces == whole.mesh.faces).all()
