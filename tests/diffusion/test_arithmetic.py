"""The choice of a training's number format, and Muon's step in either."""

import msgspec
import pytest
import torch

from gdtool.diffusion.config import PRESETS, TrainConfig
from gdtool.diffusion.training import arithmetic, optimizer


@pytest.mark.parametrize(
    "seconds, precision", [((1.0, 11.0), "float32"), ((1.0, 0.9), "float32"), ((1.0, 0.4), "bfloat16")]
)
def test_bfloat16_is_chosen_only_where_it_is_clearly_faster(monkeypatch, seconds, precision):
    full, half = seconds
    monkeypatch.setattr(arithmetic, "seconds_of_product", lambda dtype: full if dtype == torch.float32 else half)
    assert arithmetic.choose_arithmetic("cpu").precision == precision


def test_the_probe_takes_longer_for_larger_matrices():
    assert arithmetic.seconds_of_product(torch.float32, 16) < arithmetic.seconds_of_product(torch.float32, 512)


def test_a_precision_that_was_asked_for_is_not_probed(monkeypatch):
    monkeypatch.setattr(arithmetic, "choose_arithmetic", lambda device: pytest.fail("probed"))
    train = msgspec.structs.replace(PRESETS["tiny"][1], precision="float32")
    assert arithmetic.with_arithmetic(train, "cpu")[0] == train


def muon_steps(precision):
    """Four steps of our optimiser on a convolution's weights, and of torch's Muon on the same matrix."""
    generator = torch.Generator().manual_seed(0)
    start = torch.randn(64, 32, 3, 3, generator=generator)
    own, reference = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start.flatten(1).clone())
    train = TrainConfig(precision=precision, weight_decay=0.01)
    ours = optimizer.MuonAndAdam([own], [{"params": [torch.nn.Parameter(torch.zeros(1))]}], train)
    theirs = torch.optim.Muon([reference], weight_decay=0.01, momentum=0.95, adjust_lr_fn="match_rms_adamw")
    for group in (*ours.param_groups, *theirs.param_groups):
        group["lr"] = 0.01
    for _ in range(4):
        own.grad = torch.randn(start.shape, generator=generator)
        reference.grad = own.grad.flatten(1).clone()
        ours.step()
        theirs.step()
    return own.detach().flatten(1), reference.detach()


def test_muon_in_bfloat16_is_torchs_to_the_bit():
    own, reference = muon_steps("bfloat16")
    assert torch.equal(own, reference)


def test_muon_in_float32_differs_from_bfloat16_by_rounding_only():
    own, reference = muon_steps("float32")
    assert (own - reference).abs().max() < 0.02 * 4 * 0.01 * 0.2 * 288**0.5  # of the four steps' length


def test_orthogonalised_matrices_have_singular_values_near_one():
    matrix = torch.randn(96, 40, generator=torch.Generator().manual_seed(1))
    values = torch.linalg.svdvals(optimizer.orthogonalise(matrix, torch.float32))
    assert values.min() > 0.6
    assert values.max() < 1.3
