"""Check the training losses: which maps the rendering loss depends on, and the weights of the image error."""

import numpy as np
import torch

from gdtool.diffusion.config import PRESETS, TrainConfig
from gdtool.diffusion.network.codec import make_codec
from gdtool.diffusion.network.encoding import encode, planes_from_images
from gdtool.diffusion.training.losses import LitObject, image_error, linear, rendering_error, view_directions
from gdtool.images.color import linear_from_srgb
from tests.diffusion.spheres import LIGHT, sphere_views

CONFIG = PRESETS["tiny"][0]
ORDER = {i: i for i in range(6)}


def setting():
    views = sphere_views(2, 16)
    planes = torch.from_numpy(planes_from_images(views.images, views.mask))
    truth = encode(planes[None], tuple(range(6)), torch.zeros(1))[0]
    light = np.concatenate([LIGHT["axes"], np.array(LIGHT["sharpness"])[:, None], LIGHT["amplitudes"]], 1)
    return planes, truth, torch.tensor(light, dtype=torch.float32)


def error(predicted, truth, planes, light, pixels=64):
    return rendering_error(
        predicted,
        truth,
        ORDER,
        LitObject(planes=planes, lights=light, views=view_directions(CONFIG), background=0.0),
        pixels=pixels,
        generator=torch.Generator().manual_seed(0),
    )


def test_the_true_maps_have_no_error_and_changed_ones_have():
    planes, truth, light = setting()
    assert float(error(truth, truth, planes, light)) < 1e-12
    for domain in (1, 3, 4, 5):
        changed = truth.clone()
        changed[domain] = changed[domain] * 0.5
        if domain == 1:  # a shorter normal is the same normal: turn it
            changed[1] = truth[1].flip(1)
        assert float(error(changed, truth, planes, light)) > 1e-6, domain
    for domain in (0, 2):  # color and depth do not enter
        changed = truth.clone()
        changed[domain] = 0
        assert float(error(changed, truth, planes, light)) < 1e-12


def test_gradients_are_finite_at_extreme_maps_and_point_to_the_truth():
    planes, truth, light = setting()
    for start in (torch.zeros_like(truth), torch.ones_like(truth), -torch.ones_like(truth)):
        predicted = start.requires_grad_()
        error(predicted, truth, planes, light).backward()
        assert torch.isfinite(predicted.grad).all()
    predicted = truth.clone()
    predicted[3] = predicted[3] * 0.5 + 0.3  # too bright
    predicted.requires_grad_()
    error(predicted, truth, planes, light).backward()
    assert float(predicted.grad[3].sum()) > 0


def test_an_empty_view_has_no_rendering_error():
    planes, truth, light = setting()
    planes = planes.clone()
    planes[:, 12] = -1
    assert float(error(truth * 0.5, truth, planes, light)) == 0.0


def test_decoding_of_srgb_is_that_of_images():
    x = np.linspace(0, 1, 101)
    np.testing.assert_allclose(linear(torch.from_numpy(x)), linear_from_srgb(x), atol=1e-12)
    edge = torch.tensor([0.0], requires_grad=True)
    linear(edge).sum().backward()
    assert torch.isfinite(edge.grad).all()


def test_view_directions_point_to_the_cameras():
    directions = view_directions(CONFIG)
    np.testing.assert_allclose(directions[CONFIG.views.index("right")], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(directions[CONFIG.views.index("back")], [0, 0, -1], atol=1e-6)


def test_a_weighted_domain_counts_more_and_its_coverage_does_not():
    codec = make_codec(CONFIG)
    _, truth, _ = setting()
    truth = torch.nn.functional.interpolate(truth.flatten(0, 1), size=CONFIG.image_size)
    clean, train = codec.encode(truth), TrainConfig(domain_weights=(1.0, 2.0, 8.0, 1.0, 1.0, 0.5))

    def both(channel, domain):
        changed = truth.clone()
        changed[domain * 6 : domain * 6 + 6, channel] += 0.3
        return (x[0, domain] for x in image_error(codec.encode(changed), clean, 1, tuple(range(6)), CONFIG, train))

    for domain, channel, factor in ((0, 0, 1), (1, 2, 2), (2, 0, 8), (2, 1, 8), (2, 2, 1), (5, 0, 0.5), (5, 2, 1)):
        weighted, plain = both(channel, domain)
        torch.testing.assert_close(plain, torch.tensor(0.03))
        torch.testing.assert_close(weighted, factor * plain)


def test_a_domain_compared_by_distance_prefers_the_median():
    """Of one estimate for the truths 0, 0 and 0.9, the squared error is least at the mean, the distance at the median.

    Coverage is always compared by its square.
    """
    codec, base = make_codec(CONFIG), torch.zeros(36, 3, CONFIG.image_size, CONFIG.image_size)
    train = TrainConfig(absolute_domains=("normal", "depth"))

    def cost(domain, channels, estimate):
        guess, total = base.clone(), 0.0
        guess[domain * 6 : domain * 6 + 6, channels] = estimate
        for value in (0.0, 0.0, 0.9):
            target = base.clone()
            target[domain * 6 : domain * 6 + 6, channels] = value
            total += float(
                image_error(codec.encode(guess), codec.encode(target), 1, tuple(range(6)), CONFIG, train)[0][0, domain]
            )
        return total

    for domain, channels in ((1, [0, 1, 2]), (2, [0, 1])):
        assert cost(domain, channels, 0.0) < 0.8 * cost(domain, channels, 0.3)
    for domain, channels in ((0, [0]), (2, [2]), (4, [0, 1])):
        assert cost(domain, channels, 0.3) < cost(domain, channels, 0.0)


def test_the_distance_of_a_normal_does_not_depend_on_the_axes():
    codec, train = make_codec(CONFIG), TrainConfig(absolute_domains=("normal",))
    zero = torch.zeros(6, 3, CONFIG.image_size, CONFIG.image_size)

    def cost(vector):
        return image_error(
            codec.encode(zero + torch.tensor(vector)[:, None, None]), codec.encode(zero), 1, (1,), CONFIG, train
        )[0]

    torch.testing.assert_close(cost([0.3, 0.0, 0.0]), cost([0.3 / 3**0.5] * 3))
