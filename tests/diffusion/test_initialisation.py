"""Check which files are requested of Stable Diffusion Image Variations, and the errors for unsuitable repositories."""

import json
import sys
from types import SimpleNamespace

import msgspec
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.checkpoint import wonder3d
from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.network.encoder import ClipEncoder
from gdtool.diffusion.network.tensors import pretrained_part

PAPER = PRESETS["paper"][0]


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """Stand in for huggingface_hub: every download is tmp_path. Returns the list of requests."""
    requests = []
    stand_in = SimpleNamespace(snapshot_download=lambda name, **how: requests.append((name, how)) or str(tmp_path))
    monkeypatch.setitem(sys.modules, "huggingface_hub", stand_in)
    return requests


def test_revision_2_is_requested_without_pickles(hub, tmp_path):
    (tmp_path / "unet").mkdir()
    (tmp_path / "unet" / "diffusion_pytorch_model.safetensors").touch()
    assert pretrained_part(PAPER, "unet") == tmp_path / "unet"
    name, how = hub[0]
    assert name == "lambdalabs/sd-image-variations-diffusers"
    assert how["revision"] == "v2.0"
    assert not any(pattern.endswith(".bin") for pattern in how["allow_patterns"])


def test_a_repository_of_pickles_is_refused_with_the_line_that_converts_it(hub, tmp_path):
    (tmp_path / "vae").mkdir()
    (tmp_path / "vae" / "config.json").write_text("{}")
    with pytest.raises(
        InputError,
        match=r"no safetensors in vae/ .* hf download lambdalabs/sd-image-variations-diffusers "
        r"--revision v2\.0 --local-dir DIR && python -m gdtool\.diffusion\.convert DIR",
    ):
        pretrained_part(PAPER, "vae")


def test_a_local_folder_of_pickles_is_refused_by_the_files_name(tmp_path):
    (tmp_path / "vae").mkdir()
    (tmp_path / "vae" / "diffusion_pytorch_model.bin").touch()
    with pytest.raises(InputError, match=r"diffusion_pytorch_model\.bin: is a pickle"):
        pretrained_part(msgspec.structs.replace(PAPER, pretrained=str(tmp_path)), "vae")


def test_it_is_refused_as_a_multi_view_model(tmp_path):
    (tmp_path / "unet").mkdir()
    (tmp_path / "unet" / "config.json").write_text(json.dumps({"in_channels": 4}))
    assert wonder3d.recognises(tmp_path)
    with pytest.raises(InputError, match="makes single pictures.*--preset paper"):
        wonder3d.load(tmp_path)


def test_gdtool_resizes_pictures_without_antialiasing_and_wonder3d_with_it():
    """At a third of the size, bicubic interpolation without antialiasing takes every third pixel; with it, no single
    one.
    """
    rows = torch.rand(3, 672, generator=torch.Generator().manual_seed(0))
    rgba = torch.cat([rows[:, :, None].expand(3, 672, 672) * 2 - 1, torch.ones(1, 672, 672)])[None]
    mean, deviation = (torch.tensor(x)[:, None] for x in (ClipEncoder.MEAN, ClipEncoder.DEVIATION))
    resized = []

    class Clip(torch.nn.Module):
        def forward(self, image):
            resized.append(image[0, :, :, 5] * deviation + mean)
            return SimpleNamespace(image_embeds=torch.zeros(1, 768))

    for convention in ("gdtool", "wonder3d"):
        ClipEncoder(msgspec.structs.replace(PAPER, convention=convention), Clip())(rgba)
    torch.testing.assert_close(resized[0], rows[:, 1::3], atol=1e-5, rtol=0)
    assert (resized[1] - rows[:, 1::3]).std() > 0.1
    assert resized[1].std() < 0.75 * rows.std()
