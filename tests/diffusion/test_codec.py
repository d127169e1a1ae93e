"""Check the VAE codec: the size of its chunks, its gradient and its device; and what is decoded for rendering."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch

from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.data.objects import draw_batch
from gdtool.diffusion.network import codec as codecs
from gdtool.diffusion.network.codec import CHUNK, PatchCodec, VaeCodec
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.training.loop import phase_at
from gdtool.diffusion.training.objective import choose_step, view_losses
from tests.diffusion.test_training import MODEL, TRAIN, spheres


class StandInVae(torch.nn.Module):
    """Stand in for diffusers' AutoencoderKL: encode to means of 8 x 8 pixels, and decode by repetition.

    batches: the number of images of each call.
    """

    config = SimpleNamespace(scaling_factor=0.5)

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.batches = []

    def encode(self, images):
        self.batches.append(len(images))
        latent = torch.nn.functional.avg_pool2d(torch.cat([images, images[:, :1]], 1), 8) * self.weight
        return SimpleNamespace(latent_dist=SimpleNamespace(mode=lambda: latent))

    def decode(self, latents):
        self.batches.append(len(latents))
        return SimpleNamespace(
            sample=torch.tanh(torch.nn.functional.interpolate(latents[:, :3], scale_factor=8) * self.weight)
        )


def vae_codec():
    vae = StandInVae()
    return VaeCodec(msgspec.structs.replace(PRESETS["tiny"][0], codec="vae"), vae), vae


def test_the_vae_runs_in_chunks_with_the_result_of_one_call():
    codec, vae = vae_codec()
    images = torch.rand(2 * CHUNK + 1, 3, 16, 16)
    latents = codec.encode(images)
    assert vae.batches == [CHUNK, CHUNK, 1]
    torch.testing.assert_close(latents, torch.cat([codec.encode(image[None]) for image in images]))
    torch.testing.assert_close(codec.decode(latents), vae.decode(latents / 0.5).sample)


def test_a_gradient_through_decode_is_exact_and_takes_the_activations_of_one_chunk():
    codec, vae = vae_codec()
    start = torch.randn(2 * CHUNK, 4, 2, 2)
    saved = []
    held = []
    for decode in (codec.decode, lambda x: vae.decode(x / 0.5).sample):
        latents = start.clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(lambda x: saved.append(x.numel()) or x, lambda x: x):
            out = decode(latents)
        held.append(sum(saved))
        saved.clear()
        out.square().sum().backward()
        if decode == codec.decode:
            expected = latents.grad
    torch.testing.assert_close(latents.grad, expected)
    assert held[0] < held[1] / 4


def test_the_vae_follows_its_input(monkeypatch):
    codec, vae = vae_codec()
    moved = []
    monkeypatch.setattr(vae, "to", lambda device: moved.append(torch.device(device).type) or StandInVae().to(device))
    out = codec.encode(torch.zeros(1, 3, 16, 16, device="meta"))
    assert moved == ["meta"]
    assert out.device.type == "meta"


@pytest.mark.parametrize("near", [0, 1, 2])
def test_only_the_domains_and_objects_of_the_rendering_loss_are_decoded(monkeypatch, near):
    """These are the four domains that shading reads, of the objects with little noise."""
    counts, plain = [], PatchCodec.decode
    monkeypatch.setattr(codecs.PatchCodec, "decode", lambda self, x: counts.append(len(x)) or plain(self, x))
    model, objects = Model(MODEL), spheres(2)
    train = msgspec.structs.replace(TRAIN, pure_noise=0.0)
    step = choose_step(MODEL, phase_at(1.0, train), 0, 0)
    model.alpha = torch.full_like(model.alpha, 1e-3)
    model.sigma = torch.ones_like(model.sigma)
    choices, generators = zip(*(step.choices(place) for place in range(2)), strict=True)
    model.alpha[_timesteps(step)[:near]] = 3.0
    view_losses(model, draw_batch(objects, np.arange(2), MODEL, train, choices), step, list(generators), train)
    assert sum(counts) == near * 4 * len(step.views)


def _timesteps(step):
    """Return the timesteps that view_losses() chooses for two objects."""
    choices = [step.choices(place) for place in range(2)]
    draw_batch(spheres(2), np.arange(2), MODEL, TRAIN, [numpy_generator for numpy_generator, _ in choices])
    return [int(torch.rand(4, generator=generator)[0] * MODEL.timesteps) for _, generator in choices]
