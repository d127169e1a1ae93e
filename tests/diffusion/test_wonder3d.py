"""Check Wonder3D's published structure: its block, its camera labels, and a folder that is loaded and sampled."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.checkpoint import wonder3d
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.inference.sampling import SamplingOptions, SamplingSettings, sample_images
from gdtool.diffusion.network.attention import Layout, TransformerBlock
from gdtool.diffusion.network.eight_bit import composite
from gdtool.diffusion.network.labels import class_labels
from gdtool.diffusion.network.schedule import Renewal, alpha_and_sigma, sample, timesteps
from gdtool.diffusion.network.tensors import read_tensors

SMALL = {
    "block_out_channels": (8, 16, 16, 16),
    "norm_num_groups": 4,
    "attention_head_dim": 2,
    "cross_attention_dim": 24,
    "layers_per_block": 2,
}


def heads_attend(weights, name, queries, keys, heads=2):
    """Attend from queries (t, c) to keys (s, e), head by head."""
    q, k, v = (
        queries @ weights[f"{name}.to_q.weight"].T,
        keys @ weights[f"{name}.to_k.weight"].T,
        keys @ weights[f"{name}.to_v.weight"].T,
    )
    width = q.shape[1] // heads
    out = []
    for h in range(heads):
        part = slice(h * width, (h + 1) * width)
        score = (q[:, part] @ k[:, part].T / width**0.5).exp()
        out.append(score / score.sum(1, keepdim=True) @ v[:, part])
    return torch.cat(out, 1) @ weights[f"{name}.to_out.0.weight"].T + weights[f"{name}.to_out.0.bias"]


def normed(weights, name, x):
    centred = x - x.mean(-1, keepdim=True)
    return (
        centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt() * weights[f"{name}.weight"]
        + weights[f"{name}.bias"]
    )


def plain_block(weights, normal, color, context, last=False):
    """Apply Wonder3D's block to each image separately; normal and color are lists of views (t, c).

    An image attends to all views of its domain, then to both domains of its view, then to the picture's embedding. A
    gated feed-forward follows. With `last`, attention across domains comes after the feed-forward instead.
    """

    def joined(domains, place):
        name = f"attn_joint_{place}"
        ready = [[normed(weights, f"norm_joint_{place}", x) for x in views] for views in domains]
        return [
            [
                x + heads_attend(weights, name, ready[d][k], torch.cat([ready[0][k], ready[1][k]]))
                for k, x in enumerate(views)
            ]
            for d, views in enumerate(domains)
        ]

    domains = []
    for views in (normal, color):
        every = torch.cat([normed(weights, "norm1", x) for x in views])
        domains.append([x + heads_attend(weights, "attn1", normed(weights, "norm1", x), every) for x in views])
    if not last:
        domains = joined(domains, "mid")
    domains = [
        [x + heads_attend(weights, "attn2", normed(weights, "norm2", x), context) for x in views] for views in domains
    ]
    out = []
    for views in domains:
        out.append([])
        for x in views:
            value, gate = (
                normed(weights, "norm3", x) @ weights["ff.net.0.proj.weight"].T + weights["ff.net.0.proj.bias"]
            ).chunk(2, -1)
            gate = 0.5 * gate * (1 + torch.erf(gate / 2**0.5))
            out[-1].append(x + (value * gate) @ weights["ff.net.2.weight"].T + weights["ff.net.2.bias"])
    return joined(out, "last") if last else out


@pytest.mark.parametrize("place", ["joint", "joint_last"])
def test_the_block_is_wonder3ds(place):
    torch.manual_seed(0)
    block = TransformerBlock(16, 2, 8, 4, True, place).double()
    for p in block.parameters():
        torch.nn.init.normal_(p, std=0.3)
    layout = Layout(2, (0, 1), 3)  # two objects, as the two halves of classifier-free guidance are
    x = torch.randn(layout.images, 4, 16, dtype=torch.float64)
    context = torch.randn(2, 1, 8, dtype=torch.float64)
    output = block(x, context, layout).view(2, 2, 3, 4, 16)
    parts = x.view(2, 2, 3, 4, 16)
    for b in range(2):
        normal, color = plain_block(
            block.state_dict(), list(parts[b, 1]), list(parts[b, 0]), context[b], place == "joint_last"
        )
        torch.testing.assert_close(output[b, 1], torch.stack(normal))
        torch.testing.assert_close(output[b, 0], torch.stack(color))


def test_joint_attention_starts_with_zero_weights():
    torch.manual_seed(0)
    block = TransformerBlock(16, 2, 8, 4, True, "joint")
    assert not block.attn_joint_mid.to_out[0].weight.any()


def test_camera_embedding_verbatim():
    labels = class_labels(ModelConfig(convention="wonder3d"))
    elevation = [0.0, -0.2362, -0.1686, 0.5220, 0.6904, 0.3733]
    azimuth = [0.0, 0.8125, 1.6934, 3.1406, 4.8359, 5.5859]
    assert labels.shape == (6, 6, 10)
    for domain, switch in (("normal", [1.0, 0.0]), ("color", [0.0, 1.0])):
        for k in range(6):
            raw = np.array([0.0, elevation[k], azimuth[k], *switch], np.float16).astype(float)
            np.testing.assert_allclose(labels[DOMAINS.index(domain), k], [*np.sin(raw), *np.cos(raw)], atol=1e-6)


def test_older_names_are_read():
    assert wonder3d.translate_key("a.attn_joint_twice.to_q.weight") == "a.attn_joint_mid.to_q.weight"
    assert wonder3d.translate_key("a.norm_joint_twice.bias") == "a.norm_joint_mid.bias"
    assert wonder3d.translate_key("a.attn_joint.to_out.0.bias") == "a.attn_joint_last.to_out.0.bias"
    assert wonder3d.translate_key("a.norm_joint_mid.weight") == "a.norm_joint_mid.weight"
    assert wonder3d.translate_key("down_blocks.0.attn1.to_q.weight") == "down_blocks.0.attn1.to_q.weight"


def test_white_background_of_normals_becomes_coverage():
    n = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)[
        ..., None, None
    ]
    torch.testing.assert_close(wonder3d.premultiplied_normals(n), n)
    assert float(wonder3d.premultiplied_normals(torch.ones(3, 2, 2)).abs().max()) == 0.0


def test_a_pickle_is_refused_and_the_line_it_names_converts_it(tmp_path):
    tensors = {"a.weight": torch.arange(6.0).view(2, 3), "b": torch.ones(2).half()}
    torch.save(tensors, tmp_path / "diffusion_pytorch_model.bin")
    with pytest.raises(InputError) as error:
        read_tensors(tmp_path / "diffusion_pytorch_model.safetensors")
    command = str(error.value).partition("convert it to safetensors: ")[2].split()
    assert command[:3] == ["python", "-m", "gdtool.diffusion.convert"]
    done = subprocess.run([sys.executable, *command[1:]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    read, _ = read_tensors(tmp_path / "diffusion_pytorch_model.safetensors")
    assert read.keys() == tensors.keys()
    assert all(torch.equal(read[k], tensors[k]) and read[k].dtype == tensors[k].dtype for k in read)


class Evil:
    def __reduce__(self):
        return (open, ("was_here", "w"))


def test_a_pickle_that_runs_code_is_not_run(tmp_path):
    (tmp_path / "x.bin").write_bytes(pickle.dumps({"w": Evil()}))
    torch.save({"w": Evil()}, tmp_path / "y.bin")
    for name in ("x", "y"):
        done = subprocess.run(
            [sys.executable, "-m", "gdtool.diffusion.convert", f"{name}.bin"],
            capture_output=True,
            text=True,
            cwd=tmp_path,
        )
        assert done.returncode == 3
        assert "Traceback" not in done.stderr
        assert not (tmp_path / "was_here").exists()
        assert not (tmp_path / f"{name}.safetensors").exists()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write the published layout with small random weights.

    The UNet's keys are diffusers' and those of Wonder3D's joint attention.
    """
    diffusers = pytest.importorskip("diffusers", reason="needs pip install 'gdtool[hub]'")
    transformers = pytest.importorskip("transformers", reason="needs pip install 'gdtool[hub]'")
    from safetensors.torch import save_file

    path = tmp_path_factory.mktemp("wonder3d")
    torch.manual_seed(0)
    diffusers.AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
        block_out_channels=(8, 8, 8, 8),
        norm_num_groups=4,
        latent_channels=4,
    ).save_pretrained(path / "vae")
    vision = transformers.CLIPVisionConfig(
        hidden_size=16,
        intermediate_size=32,
        projection_dim=24,
        num_hidden_layers=1,
        num_attention_heads=2,
        image_size=224,
        patch_size=32,
    )
    transformers.CLIPVisionModelWithProjection(vision).save_pretrained(path / "image_encoder")
    diffusers.DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=False,
        steps_offset=1,
    ).save_pretrained(path / "scheduler")
    unet = diffusers.UNet2DConditionModel(
        sample_size=8,
        in_channels=8,
        out_channels=4,
        class_embed_type="projection",
        projection_class_embeddings_input_dim=10,
        **SMALL,
    )
    tensors = dict(unet.state_dict())
    for name in list(tensors):
        if ".attn1." in name:
            tensors[name.replace(".attn1.", ".attn_joint_mid.")] = torch.randn_like(tensors[name]) * 0.3
        if ".norm1." in name and "transformer_blocks" in name:
            tensors[name.replace(".norm1.", ".norm_joint_mid.")] = torch.rand_like(tensors[name])
    unet.save_config(path / "unet")
    save_file(tensors, path / wonder3d.UNET)
    return path


def test_every_key_is_used_and_none_is_missing(folder):
    model = wonder3d.load(folder)
    stored, _ = read_tensors(folder / wonder3d.UNET)
    state = model.unet.state_dict()
    assert state.keys() == stored.keys()
    assert len([k for k in state if "joint_mid" in k]) == 16 * 7
    assert all(torch.equal(state[k], stored[k]) for k in state)
    assert model.config.cross_domain == "joint"
    assert model.config.image_size == 64


def test_without_joint_attention_an_image_gets_diffusers_output(folder):
    """Compare with diffusers' implementation: the class embedding with its labels, and every residual block."""
    import diffusers

    model = wonder3d.load(folder)
    for name, p in model.unet.named_parameters():
        if "attn_joint_mid.to_out" in name:
            p.zero_()
    reference = diffusers.UNet2DConditionModel.from_config(json.loads((folder / "unet/config.json").read_text()))
    reference.load_state_dict({k: v for k, v in model.unet.state_dict().items() if "joint" not in k})
    noisy, condition, context = torch.randn(2, 4, 8, 8), torch.randn(2, 4, 8, 8), torch.randn(1, 1, 24)
    label = model.labels[[0, 1], 2]
    with torch.no_grad():
        output = model.unet(noisy, condition, torch.tensor([400]), label, context, Layout(1, (0, 1), 1))
        expected = reference.eval()(
            torch.cat([noisy, condition], 1), 400, context.expand(2, -1, -1), class_labels=label
        ).sample
    torch.testing.assert_close(output, expected, atol=2e-5, rtol=1e-4)
    assert model.unet.config.prediction == "epsilon"


def test_guidance_extrapolates_from_no_condition_to_the_condition(folder):
    """Compute one step at guidance 3, the default, separately.

    No condition means a zero embedding and a zero latent, with the same camera labels. The noise of normals is drawn
    before that of color.
    """
    model = wonder3d.load(folder)
    rgba = torch.rand(1, 4, 64, 64) * 2 - 1
    options = SamplingOptions(domains=("color", "normal"), steps=1, eta=0.0, spacing="trailing", seed=5)
    sampled = sample_images(model, rgba, options)
    layout, views = Layout(1, (0, 1), 6), torch.arange(6)
    noise = torch.randn(2, 6, 4, 8, 8, generator=torch.Generator().manual_seed(5)).flip(0).flatten(0, 1)
    white = composite(rgba, torch.ones(1))
    latent, context = model.condition_latents(white, layout, views), model.encoder(white)
    label = model.labels[[0, 1]].flatten(0, 1)
    with torch.no_grad():
        e = [model.unet(noise, latent * on, torch.tensor([999]), label, context * on, layout) for on in (0.0, 1.0)]
        a, s = model.alpha[999], model.sigma[999]
        clean = (noise - s * (e[0] + 3.0 * (e[1] - e[0]))) / a
        images = model.codec.decode(clean).unflatten(0, (2, 6))
    for j, domain in enumerate(("color", "normal")):
        torch.testing.assert_close(sampled[domain][0], images[j], atol=2e-3, rtol=2e-3)


def test_its_own_scheduler_says_which_timesteps_are_visited(folder):
    config = wonder3d.load(folder).config
    assert timesteps(config, 4) == [751, 501, 251, 1]
    assert not config.sampling_ends_clean


def test_50_steps_guidance_3_and_eta_1_are_its_defaults(folder):
    used = SamplingOptions().used_with(wonder3d.load(folder).config)
    assert used == SamplingSettings(steps=50, guidance=3.0, eta=1.0, spacing="leading")


@pytest.mark.parametrize("eta", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("steps", [4, 7])
def test_every_step_is_diffusers(folder, steps, eta):
    """Compare with diffusers' scheduler: the same predicted noise and the same generator give the same latents."""
    import diffusers

    reference = diffusers.DDIMScheduler.from_pretrained(folder / "scheduler")
    reference.set_timesteps(steps)
    config = wonder3d.load(folder).config
    start, predicted = torch.randn(2, 3), torch.randn(steps, 2, 3)
    a, s = alpha_and_sigma(config)
    ours, theirs = (torch.Generator().manual_seed(3) for _ in range(2))
    expected = start
    for i, t in enumerate(reference.timesteps):
        expected = reference.step(predicted[i], t, expected, eta=eta, generator=theirs).prev_sample
    renewal = Renewal(eta, lambda: torch.randn(2, 3, generator=ours)) if eta else None
    out = sample(
        lambda x, t, i: (x - s[t] * predicted[i]) / a[t], start, config, steps, "ddim", config.sampling_spacing, renewal
    )
    torch.testing.assert_close(out, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("change", [{"clip_sample": True}, {"beta_end": 0.02}, {"num_train_timesteps": 500}])
def test_another_schedulers_noise_is_refused_by_name(folder, tmp_path, change):
    import shutil

    shutil.copytree(folder, tmp_path / "w")
    path = tmp_path / "w/scheduler/scheduler_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=f"scheduler_config.json: has {next(iter(change))}"):
        wonder3d.load(tmp_path / "w")


def test_color_alone_is_the_color_of_both_domains(folder):
    model, rgba = wonder3d.load(folder), torch.rand(1, 4, 64, 64) * 2 - 1
    alone, both = (
        sample_images(model, rgba, SamplingOptions(steps=2, domains=d)) for d in (("color",), ("color", "normal"))
    )
    assert torch.equal(alone["color"], both["color"])


def test_color_and_normal_come_out_by_command(folder, gdtool, tmp_path):
    from gdtool.core.folder import open_folder
    from gdtool.folders.views import read_views
    from gdtool.images.io import read_image, write_png

    image = np.zeros((64, 64, 4), np.float32)
    image[16:48, 20:44] = [0.8, 0.2, 0.1, 1.0]
    write_png(tmp_path / "x.png", image)
    result = gdtool("sample-views", "x.png", "--model", folder, "--steps", 2, "-o", "views")
    assert result.returncode == 0, result.stderr
    views = read_views(open_folder(tmp_path / "views"))
    assert set(views.images) == {"color", "normal"}
    assert views.cameras[0].half_width == pytest.approx(0.675)
    report = json.loads((tmp_path / "views/manifest.json").read_text())["content"]["report"]
    used = {name: report[name] for name in ("steps", "guidance", "eta", "spacing")}
    assert used == {"steps": 2, "guidance": 3.0, "eta": 1.0, "spacing": "leading"}
    condition = read_image(tmp_path / "views/condition/000.png")
    rows, columns = np.nonzero(condition[..., 3])
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (48, 35)  # of a box of 31 x 23 pixels: 48 * 23 / 31 = 35.6
    assert gdtool("validate", "views").returncode == 0


def test_a_folder_with_pickles_is_refused_by_command(folder, gdtool, tmp_path):
    import shutil

    shutil.copytree(folder, tmp_path / "w")
    (tmp_path / "w" / wonder3d.UNET).rename(tmp_path / "w/unet/diffusion_pytorch_model.bin")
    image = np.full((64, 64, 4), 1.0, np.float32)
    image[:8, :, 3] = 0
    from gdtool.images.io import write_png

    write_png(tmp_path / "x.png", image)
    result = gdtool("sample-views", "x.png", "--model", "w", "-o", "views")
    assert result.returncode == 3
    assert "python -m gdtool.diffusion.convert" in result.stderr
    assert "Traceback" not in result.stderr
