"""Check the paper's configuration with Stable Diffusion's parts, on small random weights of the same structure."""

import json

import msgspec
import pytest
import torch

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.checkpoint.pretrained import start_from_pretrained
from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.tensors import read_tensors
from tests.stages.dataset import write_spheres

diffusers = pytest.importorskip("diffusers", reason="needs pip install 'gdtool[hub]'")
transformers = pytest.importorskip("transformers", reason="needs pip install 'gdtool[hub]'")

CHANGES = {
    "image_size": 64,
    "channels": (8, 16, 16, 16),
    "heads": 2,
    "norm_groups": 4,
    "encoder_width": 24,
    "sampling_steps": 2,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Write unet/, vae/ and image_encoder/ as Stable Diffusion Image Variations has them, small and with random
    weights.
    """
    path = tmp_path_factory.mktemp("small-sd")
    torch.manual_seed(0)
    blocks = {"block_out_channels": (8, 8, 8, 8), "norm_num_groups": 4, "latent_channels": 4}
    diffusers.AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4, up_block_types=("UpDecoderBlock2D",) * 4, **blocks
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
    diffusers.UNet2DConditionModel(
        sample_size=8,
        in_channels=4,
        out_channels=4,
        block_out_channels=CHANGES["channels"],
        layers_per_block=2,
        norm_num_groups=4,
        attention_head_dim=2,
        cross_attention_dim=24,
    ).save_pretrained(path / "unet")
    return path


@pytest.fixture(scope="module")
def model(folder):
    config = msgspec.structs.replace(
        PRESETS["paper"][0], pretrained=str(folder), gradient_checkpointing=False, **CHANGES
    )
    torch.manual_seed(1)
    network = Model(config)
    start_from_pretrained(network)
    return network.eval()


@pytest.mark.parametrize("domain", DOMAINS)
def test_at_its_start_each_domains_image_gets_the_output_of_diffusers_network(folder, model, domain):
    """Compare with diffusers' implementation of the same structure on the same weights, with all domains in a batch."""
    reference = diffusers.UNet2DConditionModel.from_pretrained(folder / "unet", use_safetensors=True).eval()
    index = DOMAINS.index(domain)
    noisy, condition = torch.randn(6, 4, 8, 8), torch.randn(6, 4, 8, 8)
    context, t = torch.randn(1, 1, 24), torch.tensor([321])
    with torch.no_grad():
        output = model.unet(noisy, condition, t, model.labels[:, 2], context, Layout(1, tuple(range(6)), 1))[index]
        expected = reference(noisy[index : index + 1], t, context).sample[0]
    torch.testing.assert_close(output, expected, atol=1e-5, rtol=1e-4)


def test_every_pretrained_tensor_is_used(folder, model):
    tensors, _ = read_tensors(folder / "unet" / "diffusion_pytorch_model.safetensors")
    state = model.unet.state_dict()
    assert len(tensors) > 300
    for name, tensor in tensors.items():
        loaded = state[name][:, : tensor.shape[1]] if tensor.ndim > 1 else state[name]
        torch.testing.assert_close(loaded, tensor, msg=name)


def test_the_image_encoder_is_clips(folder, model):
    """Compare with transformers' CLIP on an image of half grey, which is 0 in [-1, 1]."""
    reference = transformers.CLIPVisionModelWithProjection.from_pretrained(folder / "image_encoder").eval()
    rgba = torch.zeros(1, 4, 64, 64)
    mean, deviation = (torch.tensor(x)[:, None, None] for x in (model.encoder.MEAN, model.encoder.DEVIATION))
    with torch.no_grad():
        expected = reference((torch.full((1, 3, 224, 224), 0.5) - mean) / deviation).image_embeds
        torch.testing.assert_close(model.encoder(rgba)[:, 0], expected, atol=1e-5, rtol=1e-4)


def test_trains_and_samples_by_command(folder, gdtool, tmp_path):
    """Train from pretrained parts, sample with the result, and validate the views."""
    spheres = write_spheres(tmp_path / "spheres", size=64)
    changes = {
        "model": CHANGES | {"pretrained": str(folder)},
        "train": {"accumulate": 1, "pbr_pixels": 16, "precision": "float32"},
    }
    (tmp_path / "config.json").write_text(json.dumps(changes))
    trained = gdtool(
        "train",
        spheres,
        "--preset",
        "paper",
        "--config",
        "config.json",
        "--steps",
        2,
        "--batch",
        1,
        "--held-out",
        0,
        "-o",
        "model",
    )
    assert trained.returncode == 0, trained.stderr
    view = next(spheres.glob("**/color/front.png"))
    sampled = gdtool(
        "sample-views", view, "--mask", view.parents[1] / "mask" / "front.png", "--model", "model", "-o", "views"
    )
    assert sampled.returncode == 0, sampled.stderr
    checked = gdtool("validate", "views")
    assert checked.returncode == 0, checked.stderr
