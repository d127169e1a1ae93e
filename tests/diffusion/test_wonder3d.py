"""Check Wonder3D's published structure: its block, its camera labels, and a folder that is loaded."""

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
from gdtool.diffusion.network.attention import Layout, TransformerBlock
from gdtool.diffusion.network.labels import class_labels
from gdtool.diffusion.network.tensors import read_tensors
from tests.diffusion.wonder3d_folder import write_folder


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
    path = tmp_path_factory.mktemp("wonder3d")
    write_folder(path)
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
