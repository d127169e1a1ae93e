"""Write a folder as Wonder3D publishes its weights, small and with random weights."""

import pytest
import torch

from gdtool.diffusion.checkpoint import wonder3d

SMALL = {
    "block_out_channels": (8, 16, 16, 16),
    "norm_num_groups": 4,
    "attention_head_dim": 2,
    "cross_attention_dim": 24,
    "layers_per_block": 2,
}


def write_folder(path):
    """Write unet/, vae/, image_encoder/ and scheduler/ below path; skips the test where diffusers is not installed.

    The UNet's keys are diffusers' and those of Wonder3D's joint attention.
    """
    diffusers = pytest.importorskip("diffusers", reason="needs pip install 'gdtool[hub]'")
    transformers = pytest.importorskip("transformers", reason="needs pip install 'gdtool[hub]'")
    from safetensors.torch import save_file

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
