"""Check that a model grown to larger images predicts what the small one predicts, each pixel repeated to a square."""

import msgspec
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.grow import grow_weights, resize_config
from gdtool.diffusion.network.model import Model

SMALL = msgspec.structs.replace(PRESETS["tiny"][0], image_size=16, channels=(8, 16), head_width=8, encoder_width=16)


def random_model(config, seed=0):
    torch.manual_seed(seed)
    model = Model(config).eval().requires_grad_(False)
    for p in model.parameters():  # layers that start at zero would hide an error
        p.copy_(torch.randn_like(p) * 0.2)
    return model


@pytest.mark.parametrize("factor", [2, 3])
def test_a_grown_model_predicts_what_the_small_one_did(factor):
    large_config = resize_config(SMALL, 16 * factor)
    small = random_model(SMALL)
    large = random_model(large_config, seed=1)
    large.load_state_dict(grow_weights(small.state_dict(), SMALL, large_config))
    assert large.codec.side == small.codec.side  # as many tokens, so the same cost
    layout, views = Layout(1, (0, 1, 2), 6), torch.arange(6)
    generator = torch.Generator().manual_seed(2)
    rgba = torch.rand(1, 4, 16, 16, generator=generator) * 2 - 1
    noise = torch.randn(layout.images, 3, 16, 16, generator=generator)

    def predicted(model, rgba, pixels):
        condition = model.condition_latents(rgba, layout, views)
        latents = model.predict_clean(
            model.codec.encode(pixels), condition, torch.tensor([500]), model.encoder(rgba), layout, views
        )
        return model.codec.decode(latents)

    def squares(image):
        return image.repeat_interleave(factor, -2).repeat_interleave(factor, -1)

    expected = squares(predicted(small, rgba, noise))
    assert expected.std() > 0.1
    torch.testing.assert_close(predicted(large, squares(rgba), squares(noise)), expected, atol=2e-4, rtol=1e-4)


def test_the_same_size_changes_nothing_and_another_network_is_refused():
    tensors = random_model(SMALL).state_dict()
    assert grow_weights(tensors, SMALL, SMALL) is tensors
    with pytest.raises(InputError, match="cannot be grown"):
        grow_weights(tensors, SMALL, msgspec.structs.replace(resize_config(SMALL, 32), channels=(8, 32)))
    with pytest.raises(InputError, match="neither a multiple"):
        resize_config(SMALL, 24)
