"""Check what each ablation changes in the configuration, and which image attends to which."""

import msgspec
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ABLATIONS
from gdtool.diffusion.configure import chosen_configuration
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.model import Model
from gdtool.stages.train import Options

SMALL = {"channels": (8, 16), "head_width": 8, "encoder_width": 16, "image_size": 16, "row_attention": ()}
COLOR, NORMAL, ROUGHNESS = (DOMAINS.index(d) for d in ("color", "normal", "roughness"))


def model_of(name):
    config, train = chosen_configuration(Options(preset="tiny", ablation=name))
    torch.manual_seed(0)
    model = Model(msgspec.structs.replace(config, **SMALL)).eval()
    for p in model.parameters():  # no weight at zero, so that every path has an effect
        if p.ndim >= 2 and not p.any():
            torch.nn.init.normal_(p, std=0.2)
    return model, train


# (reader, read): which domain attends to which
READS = {
    "none": {(COLOR, NORMAL), (COLOR, ROUGHNESS), (NORMAL, COLOR), (ROUGHNESS, COLOR)},
    "two_way": {(COLOR, NORMAL), (COLOR, ROUGHNESS), (NORMAL, COLOR), (ROUGHNESS, COLOR)},
    "no_pbr": {(COLOR, NORMAL), (COLOR, ROUGHNESS), (NORMAL, COLOR), (ROUGHNESS, COLOR)},
    "one_way": {(COLOR, NORMAL), (COLOR, ROUGHNESS)},
    "no_cross_domain": set(),
    "color_normal": {(COLOR, NORMAL), (NORMAL, COLOR)},
}


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_image_changes_exactly_those_that_attend_to_it(name):
    """Change one image before a transformer block: exactly the images that attend to it change after the block.

    Across domains an image attends to the same view only, and only along the star around color.
    """
    model, _ = model_of(name)
    domains = (COLOR, NORMAL) if name == "color_normal" else (COLOR, NORMAL, ROUGHNESS)
    layout = Layout(1, domains, 2)
    block = next(m for m in model.modules() if type(m).__name__ == "TransformerBlock")
    block.attn1.to_out[0].weight.data.zero_()  # no attention across views here
    block.attn1.to_out[0].bias.data.zero_()
    x = torch.randn(layout.images, 4, 16)
    context = torch.randn(1, 3, 16)
    before = block(x, context, layout).view(len(domains), 2, 4, 16)
    for j, read in enumerate(domains):
        changed = x.clone().view(len(domains), 2, 4, 16)
        changed[j, 0] += torch.randn(4, 16)
        moved = (block(changed.flatten(0, 1), context, layout).view_as(before) - before).abs().amax((2, 3)) > 1e-6
        for i, reader in enumerate(domains):
            assert bool(moved[i, 0]) == (reader == read or (reader, read) in READS[name])
            assert not moved[i, 1]


@pytest.mark.parametrize("name", ABLATIONS)
def test_each_ablation_samples_its_domains(name):
    model, train = model_of(name)
    images = sample_images(model, torch.rand(1, 4, 16, 16), SamplingOptions(steps=1))
    assert tuple(images) == (("color", "normal") if name == "color_normal" else DOMAINS)
    assert all(bool(torch.isfinite(x).all()) and x.shape == (1, 6, 3, 16, 16) for x in images.values())
    assert (train.pbr_weight == 0) == (name in ("no_pbr", "color_normal"))


def test_flags_and_a_file_change_an_ablation_further(tmp_path):
    (tmp_path / "c.json").write_text('{"model": {"multi_view": false}, "train": {"clip": 2.0}}')
    model, train = chosen_configuration(
        Options(preset="small", ablation="one_way", config=str(tmp_path / "c.json"), batch=3)
    )
    assert (model.cross_domain, model.multi_view, train.clip, train.batch) == ("one_way", False, 2.0, 3)
    with pytest.raises(InputError, match="does not exist"):
        chosen_configuration(Options(config="missing.json"))
