"""Check that Wonder3D's weights are sampled by default as the original code samples them."""

import json
import shutil

import numpy as np
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.checkpoint import wonder3d
from gdtool.diffusion.inference.sampling import SamplingOptions, SamplingSettings, sample_images
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.eight_bit import composite
from gdtool.diffusion.network.schedule import Renewal, alpha_and_sigma, sample, timesteps
from tests.diffusion.wonder3d_folder import write_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("wonder3d")
    write_folder(path)
    return path


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
