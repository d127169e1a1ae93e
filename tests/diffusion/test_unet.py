"""Check the network's structure: Stable Diffusion's names, conditioning, and which parts start without effect."""

import msgspec
import pytest
import torch

from gdtool.core.errors import InputError, UsageError
from gdtool.diffusion.checkpoint.weights import load_stable_diffusion
from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.inference.sampling import SamplingOptions, SamplingSettings, sample_images, sampled_domains
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.encoding import mirror_images
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.unet import UNet

TINY = msgspec.structs.replace(PRESETS["tiny"][0], channels=(8, 16), head_width=8, encoder_width=16, image_size=16)
PAPER = PRESETS["paper"][0]


def test_the_paper_preset_has_stable_diffusions_keys_and_size():
    with torch.device("meta"):
        unet = UNet(PAPER, 4, 4, 32)
    shapes = {name: tuple(p.shape) for name, p in unet.state_dict().items()}
    for name, shape in {
        "conv_in.weight": (320, 8, 3, 3),
        "time_embedding.linear_1.weight": (1280, 320),
        "class_embedding.linear_1.weight": (1280, 18),
        "down_blocks.0.attentions.1.transformer_blocks.0.attn1.to_q.weight": (320, 320),
        "down_blocks.1.resnets.0.conv_shortcut.weight": (640, 320, 1, 1),
        "down_blocks.2.downsamplers.0.conv.weight": (1280, 1280, 3, 3),
        "down_blocks.3.resnets.1.conv2.weight": (1280, 1280, 3, 3),
        "mid_block.attentions.0.transformer_blocks.0.attn2.to_k.weight": (1280, 768),
        "mid_block.resnets.1.time_emb_proj.weight": (1280, 1280),
        "up_blocks.0.resnets.2.conv1.weight": (1280, 2560, 3, 3),
        "up_blocks.1.attentions.2.transformer_blocks.0.ff.net.0.proj.weight": (10240, 1280),
        "up_blocks.3.attentions.0.transformer_blocks.0.ff.net.2.weight": (320, 1280),
        "up_blocks.3.resnets.0.conv1.weight": (320, 960, 3, 3),
        "conv_norm_out.weight": (320,),
        "conv_out.weight": (4, 320, 3, 3),
    }.items():
        assert shapes[name] == shape, name
    new = ("cross_domain", "class_embedding")
    original = sum(p.numel() for name, p in unet.named_parameters() if not any(part in name for part in new))
    # Stable Diffusion 1's UNet has 859,520,964 parameters; ours has four more input channels
    assert original == 859_520_964 + 4 * 320 * 9


def small_stable_diffusion(cross_domain="two_way"):
    """Return this network, Stable Diffusion's, and the weights of the latter, all small.

    Stable Diffusion's has 4 input channels, no classes and no attention across domains.
    """
    config = msgspec.structs.replace(
        PAPER,
        channels=(8, 16, 16, 16),
        heads=2,
        norm_groups=4,
        encoder_width=12,
        gradient_checkpointing=False,
        cross_domain=cross_domain,
    )
    torch.manual_seed(0)
    grown = UNet(config, 4, 4, 8)
    plain = UNet(msgspec.structs.replace(config, cross_domain="none", multi_view=False), 4, 0, 8)
    weights = {k: v for k, v in plain.state_dict().items() if "class_embedding" not in k}
    return grown, plain, weights


@pytest.mark.parametrize("cross_domain", ["none", "one_way", "two_way", "joint", "joint_last"])
def test_pretrained_weights_start_unchanged(cross_domain):
    """Load pretrained weights into the network with its new parts: every image gets the original network's output.

    There is one view, so that multi-view attention is self-attention.
    """
    grown, plain, weights = small_stable_diffusion(cross_domain)
    new = load_stable_diffusion(grown, weights)
    assert all("domain" in name or "joint" in name or "class_embedding" in name for name in new)
    for p in plain.class_embedding.parameters():
        torch.nn.init.zeros_(p)
    layout, context, t = Layout(1, (0, 1, 2), 1), torch.randn(1, 1, 12), torch.tensor([500])
    noisy, condition, label = torch.randn(3, 4, 8, 8), torch.randn(3, 4, 8, 8), torch.randn(3, 18)
    torch.testing.assert_close(
        grown(noisy, condition, t, label, context, layout),
        plain(noisy, torch.zeros(3, 0, 8, 8), t, label, context, layout),
        rtol=1e-5,
        atol=1e-5,
    )


def test_pretrained_weights_of_a_class_embedding_are_kept():
    grown, _, weights = small_stable_diffusion()
    own = {"class_embedding.linear_2.weight": torch.ones(32, 32)}
    load_stable_diffusion(grown, weights | own)
    assert bool((grown.class_embedding.linear_2.weight == 1).all())


def test_pretrained_weights_that_do_not_fit_are_named():
    grown, _, weights = small_stable_diffusion()
    with pytest.raises(InputError, match="conv_out.weight has shape"):
        load_stable_diffusion(grown, {"conv_out.weight": torch.zeros(4, 9, 3, 3)})
    with pytest.raises(InputError, match="encoder_hid_proj"):
        load_stable_diffusion(grown, weights | {"encoder_hid_proj.weight": torch.zeros(1)})


def tiny(**changes):
    torch.manual_seed(0)
    model = Model(msgspec.structs.replace(TINY, **changes)).eval()
    for p in model.parameters():  # no weight at zero, so that every path has an effect
        if p.ndim >= 2 and not p.any():
            torch.nn.init.normal_(p, std=0.05)
    return model


def test_checkpointing_changes_no_gradient():
    grads = []
    for on in (False, True):
        model = tiny(gradient_checkpointing=on).train()
        layout, views = Layout(1, (0, 1), 2), torch.tensor([0, 3])
        rgba = torch.randn(1, 4, 16, 16, generator=torch.Generator().manual_seed(1))
        noisy = torch.randn(model.latent_shape(layout), generator=torch.Generator().manual_seed(2))
        out = model.predict_clean(
            noisy, model.condition_latents(rgba, layout, views), torch.tensor([300]), model.encoder(rgba), layout, views
        )
        out.square().sum().backward()
        grads.append({n: p.grad for n, p in model.named_parameters() if p.grad is not None})
    assert grads[0].keys() == grads[1].keys()
    for name in grads[0]:
        torch.testing.assert_close(grads[0][name], grads[1][name])


def test_the_view_from_behind_gets_the_mirrored_condition():
    model = tiny()
    rgba = torch.randn(1, 4, 16, 16)
    latent = model.condition_latents(rgba, Layout(1, (0, 2), 2), torch.tensor([0, 3])).inputs.view(
        2, 2, *model.codec.encode_condition(rgba).shape[1:]
    )
    torch.testing.assert_close(latent[1, 0], model.codec.encode_condition(rgba)[0])
    torch.testing.assert_close(latent[1, 1], model.codec.encode_condition(rgba.flip(-1))[0])
    torch.testing.assert_close(model.codec.decode(latent[:, 0, :48]), rgba[:, :3].expand(2, -1, -1, -1))


def test_an_untrained_x_model_shows_the_condition_as_front_color():
    torch.manual_seed(0)
    model = Model(TINY).eval()
    rgba = torch.rand(1, 4, 16, 16) * 2 - 1
    rgba[:, 3] = 1.0
    images = sample_images(model, rgba, SamplingOptions(steps=2))
    torch.testing.assert_close(images["color"][0, 0], rgba[0, :3])
    assert float(images["albedo"].abs().max()) == 0.0


@pytest.mark.parametrize("guidance", [1.0, 2.5])
def test_objects_of_a_batch_are_independent(guidance):
    model = tiny()
    rgba = torch.rand(2, 4, 16, 16) * 2 - 1
    both = sample_images(model, rgba, SamplingOptions(steps=2, seed=4, guidance=guidance))
    alone = sample_images(model, rgba[1:], SamplingOptions(steps=2, seed=4, guidance=guidance))
    for domain in both:
        torch.testing.assert_close(both[domain][1], alone[domain][0], rtol=1e-4, atol=1e-5)


def test_guidance_acts_and_costs_only_between_its_timesteps(monkeypatch):
    model, batches = tiny(), []
    rgba = torch.rand(1, 4, 16, 16) * 2 - 1
    whole = model.predict_clean
    monkeypatch.setattr(model, "predict_clean", lambda x, *rest: batches.append(len(x)) or whole(x, *rest))
    plain, all_over = (
        sample_images(model, rgba, SamplingOptions(steps=4, seed=4, guidance=guidance)) for guidance in (1.0, 2.5)
    )
    images = batches[0]
    assert batches == [images] * 4 + [2 * images] * 4
    batches.clear()
    early = sample_images(model, rgba, SamplingOptions(steps=4, seed=4, guidance=2.5, guided_from=0.6))
    assert batches == [2 * images] * 2 + [images] * 2
    never = sample_images(model, rgba, SamplingOptions(steps=4, seed=4, guidance=2.5, guided_to=0.0, guided_from=1.0))
    for domain in plain:
        assert torch.equal(never[domain], plain[domain])
    assert not torch.allclose(early["color"][0, 1:], plain["color"][0, 1:])
    assert not torch.allclose(early["color"][0, 1:], all_over["color"][0, 1:])


@pytest.mark.parametrize("guidance", [1.0, 2.5])
def test_sampling_with_the_mirror_image_is_equivariant_to_mirroring(guidance):
    """A mirrored picture gives the mirrored views, in one step, in which the noise has no weight.

    In two steps the result of an object does not depend on the rest of its batch.
    """
    model = tiny(noisy_input="shrunk")
    rgba = torch.rand(2, 4, 16, 16) * 2 - 1
    plain = sample_images(model, rgba, SamplingOptions(steps=1, guidance=guidance))
    of_picture, of_mirrored = (
        sample_images(model, x, SamplingOptions(steps=1, guidance=guidance, mirror=True)) for x in (rgba, rgba.flip(-1))
    )
    whole, mirrored, apart = (torch.stack([of[d] for d in TINY.domains], 1) for of in (of_picture, of_mirrored, plain))
    torch.testing.assert_close(mirror_images(mirrored, tuple(range(6)), TINY.views), whole, rtol=1e-4, atol=1e-4)
    assert float((apart - whole).abs().mean()) > 1e-3  # the network alone is not equivariant
    two = sample_images(model, rgba[1:], SamplingOptions(steps=2, seed=4, guidance=guidance, mirror=True))
    both = sample_images(model, rgba, SamplingOptions(steps=2, seed=4, guidance=guidance, mirror=True))
    for domain in both:
        torch.testing.assert_close(both[domain][1], two[domain][0], rtol=1e-4, atol=1e-5)


def test_only_a_patch_codec_samples_with_the_mirror_image():
    with pytest.raises(InputError, match="mirror"):
        sample_images(tiny(convention="wonder3d"), torch.rand(1, 4, 16, 16), SamplingOptions(steps=1, mirror=True))
    half = tiny(sampling_mirrored=True, views=("front", "right"))
    with pytest.raises(InputError, match="both sides"):
        sample_images(half, torch.rand(1, 4, 16, 16), SamplingOptions(steps=1, mirror=True))
    # The configuration asks for mirroring, the model cannot mirror its views.
    assert sample_images(half, torch.rand(1, 4, 16, 16), SamplingOptions(steps=1))["color"].shape[1] == 2


# what is sampled for depth alone, and for color alone, by the attention across domains
SAMPLED_WITH = {
    "none": (("depth",), ("color",)),
    "one_way": (("depth",), TINY.domains),
    "two_way": (TINY.domains, TINY.domains),
    "joint": (TINY.domains, TINY.domains),
    "joint_last": (TINY.domains, TINY.domains),
}


@pytest.mark.parametrize("mode", SAMPLED_WITH)
def test_domains_that_others_read_are_sampled_with_them(mode):
    config = msgspec.structs.replace(TINY, cross_domain=mode)
    assert (sampled_domains(config, ("depth",)), sampled_domains(config, ("color",))) == SAMPLED_WITH[mode]


def test_a_star_without_color_reads_no_other_domain():
    config = msgspec.structs.replace(TINY, cross_domain="two_way", domains=("normal", "depth"))
    assert sampled_domains(config, ("depth",)) == ("depth",)


@pytest.mark.parametrize("domain", ["color", "depth"])
@pytest.mark.parametrize("mode", SAMPLED_WITH)
def test_a_domain_does_not_depend_on_which_others_are_asked_for(mode, domain):
    model, rgba = tiny(cross_domain=mode), torch.rand(1, 4, 16, 16)
    alone, whole = (sample_images(model, rgba, SamplingOptions(steps=2, domains=d)) for d in ((domain,), TINY.domains))
    assert set(alone) == set(sampled_domains(model.config, (domain,)))
    torch.testing.assert_close(alone[domain], whole[domain], rtol=1e-4, atol=1e-5)


def test_renewed_noise_is_the_seeds():
    model, rgba = tiny(sampling_eta=1.0), torch.rand(1, 4, 16, 16)
    first, again = (sample_images(model, rgba, SamplingOptions(steps=3, seed=4))["color"] for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.allclose(first, sample_images(model, rgba, SamplingOptions(steps=3, seed=4, eta=0.0))["color"])


def test_renewed_noise_does_not_depend_on_the_batch_or_the_domains():
    model, rgba = tiny(sampling_eta=1.0, cross_domain="none"), torch.rand(2, 4, 16, 16)
    both = sample_images(model, rgba, SamplingOptions(steps=3, seed=4))
    alone = sample_images(model, rgba[1:], SamplingOptions(steps=3, seed=4, domains=("depth",)))
    torch.testing.assert_close(both["depth"][1], alone["depth"][0], rtol=1e-4, atol=1e-5)


def test_the_models_own_settings_are_used_where_none_are_given():
    config = msgspec.structs.replace(
        TINY, sampling_steps=7, sampling_guidance=3.0, sampling_eta=0.5, sampling_spacing="leading"
    )
    assert SamplingOptions().used_with(config) == SamplingSettings(7, 3.0, 0.5, "leading")
    given = SamplingOptions(steps=2, guidance=1.0, eta=0.0, spacing="trailing")
    assert given.used_with(config) == SamplingSettings(2, 1.0, 0.0, "trailing")


def test_dpm_renews_no_noise():
    config = msgspec.structs.replace(TINY, sampling_eta=1.0)
    assert SamplingOptions(scheduler="dpm").used_with(config).eta == 0
    with pytest.raises(UsageError, match="--eta"):
        SamplingOptions(scheduler="dpm", eta=0.5).used_with(config)


def test_bfloat16_stays_near_float32():
    model = tiny()
    rgba = torch.rand(1, 4, 16, 16)
    a, b = (sample_images(model, rgba, SamplingOptions(steps=2, precision=p)) for p in ("float32", "bfloat16"))
    for domain in a:
        assert float((a[domain] - b[domain]).abs().mean()) < 2e-2
