"""Refuse model folders with invalid configurations or files in one line, before memory is allocated."""

import json
import os

import msgspec
import pytest
import torch
from safetensors.torch import save_file

from gdtool.core import memory
from gdtool.core.errors import InputError, ResourceError
from gdtool.diffusion.checkpoint import wonder3d
from gdtool.diffusion.checkpoint.weights import load_model, read_config, save_model
from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.configure import chosen_configuration
from gdtool.diffusion.inference.familiarity import read_ranges
from gdtool.diffusion.network.grow import resize_config
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.tensors import read_tensors
from gdtool.diffusion.training.loop import CHECKPOINT, load_checkpoint
from gdtool.stages.train import Options
from tests.faults.test_checkpoints import changed

TINY = PRESETS["tiny"][0]


@pytest.fixture
def folder(tmp_path):
    """Make a valid model folder of the smallest configuration."""
    (tmp_path / "model").mkdir()
    save_model(lambda name: tmp_path / "model" / name, TINY, Model(TINY).state_dict())
    return tmp_path / "model"


def write(path, **changes):
    """Write a configuration with changes."""
    path.write_text(json.dumps(msgspec.to_builtins(TINY) | changes))
    return path


BAD_FIELDS = [
    ({"patch": 0}, r"`int` >= 1 - at `\$.patch`"),
    ({"patch": -4}, r"`int` >= 1 - at `\$.patch`"),
    ({"patch": 2**40}, r"`int` <= 4096 - at `\$.patch`"),
    ({"patch": "4"}, r"got `str` - at `\$.patch`"),
    ({"patch": 5}, "image_size is 32, not a multiple of patch 5"),
    ({"image_size": 36}, "is 9, which cannot be halved 1 times for 2 levels"),
    ({"image_size": 10**9}, r"`int` <= 4096 - at `\$.image_size`"),
    ({"channels": [16, -32]}, r"`int` >= 1 - at `\$.channels\[1\]`"),
    ({"channels": [16, 10**8]}, r"`int` <= 16384 - at `\$.channels\[1\]`"),
    ({"channels": []}, r"length >= 1 - at `\$.channels`"),
    ({"channels": [16] * 9}, r"length <= 8 - at `\$.channels`"),
    ({"channels": [15, 32]}, r"channels\[0\] is 15, which has to be even"),
    ({"channels": [16, 30]}, r"channels\[1\] is 30, not a multiple of norm_groups 4"),
    ({"heads": 5}, r"not a multiple of its 5 heads"),
    ({"head_width": 0}, r"`int` >= 1 - at `\$.head_width`"),
    ({"attention_levels": [True]}, "attention_levels has 1 entries, channels has 2"),
    ({"row_attention": [True]}, "row_attention has 1 entries"),
    ({"encoder_patch": 0}, r"`int` >= 1 - at `\$.encoder_patch`"),
    ({"encoder_patch": 7}, "not a multiple of encoder_patch 7"),
    ({"encoder_width": 200}, "encoder_width is 200, not a multiple of its 3 heads"),
    ({"encoder_layers": -1}, r"`int` >= 0 - at `\$.encoder_layers`"),
    ({"layers_per_block": 10**6}, r"`int` <= 64 - at `\$.layers_per_block`"),
    ({"timesteps": 10**12}, r"`int` <= 100000 - at `\$.timesteps`"),
    ({"timesteps": 1}, r"`int` >= 2 - at `\$.timesteps`"),
    ({"sampling_steps": 0}, r"`int` >= 1 - at `\$.sampling_steps`"),
    ({"views": ["front", "top"]}, "views names 'top', which is none of"),
    ({"views": ["front", "front"]}, "views names a value twice"),
    ({"views": []}, r"length >= 1 - at `\$.views`"),
    ({"domains": ["color", "smell"]}, "domains names 'smell'"),
    ({"domains": []}, r"length >= 1 - at `\$.domains`"),
    ({"backgrounds": []}, r"length >= 1 - at `\$.backgrounds`"),
    ({"pretrained": "a\0b"}, "pretrained holds a NUL character"),
    ({"unknown": 1}, "unknown field `unknown`"),
]


@pytest.mark.parametrize("change, message", BAD_FIELDS, ids=lambda x: json.dumps(x) if isinstance(x, dict) else "")
def test_an_invalid_field_of_a_configuration_is_named_with_its_bound(tmp_path, change, message):
    with pytest.raises(InputError, match=message) as refused:
        read_config(write(tmp_path / "config.json", **change))
    assert refused.value.subject == str(tmp_path / "config.json")
    assert refused.value.cure


@pytest.mark.parametrize(
    "text, message",
    [
        ("[]", "Expected `object`"),
        ("{", "is not JSON"),
        ('{"patch": ' + "9" * 5000 + "}", "beyond 64 bits"),
        ("[" * 100_000, "nested too deeply"),
        ('{"patch": 4, "patch": 4}', "appears twice"),
        ('{"patch": NaN}', "NaN"),
    ],
)
def test_a_configuration_that_is_no_valid_json_object_is_refused(tmp_path, text, message):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(InputError, match=message):
        read_config(tmp_path / "config.json")


@pytest.mark.parametrize("config", [one for pair in PRESETS.values() for one in pair], ids=lambda c: type(c).__name__)
def test_every_preset_is_within_the_bounds(config):
    assert msgspec.json.decode(msgspec.json.encode(config), type=type(config)) == config


@pytest.mark.parametrize(
    "changes",
    [
        {"train": {"batch": 0}},
        {"train": {"betas": [0.9, 1.0]}},
        {"train": {"phases": []}},
        {"train": {"warmup": 0}},
        {"train": {"phases": [{"domains": 0}]}},
        {"train": {"pbr_pixels": -1}},
        {"model": {"patch": 3}},
    ],
)
def test_train_refuses_invalid_changes_to_its_configuration(tmp_path, changes):
    (tmp_path / "changes.json").write_text(json.dumps(changes))
    with pytest.raises(InputError, match="changes.json"):
        chosen_configuration(Options(config=str(tmp_path / "changes.json")))


def test_an_image_size_that_the_network_cannot_have_is_refused():
    with pytest.raises(InputError, match="size: 8 does not fit the configuration: .*; give a multiple of 32"):
        resize_config(msgspec.structs.replace(TINY, codec="vae", encoder="clip"), 8)


def test_a_network_larger_than_the_memory_is_refused_with_the_prediction(folder):
    write(folder / "config.json", channels=[16384] * 2, layers_per_block=64)
    with pytest.raises(
        ResourceError, match=r"its network of [\d,.]+ million weights would take [\d.]+ GiB of memory, more than"
    ):
        load_model(folder)


def test_a_network_is_refused_when_too_little_memory_is_left(folder, monkeypatch):
    load_model(folder)
    monkeypatch.setattr(memory, "max_input_bytes", lambda: 2**20)
    with pytest.raises(ResourceError, match="million weights would take"):
        load_model(folder)


def test_weights_of_another_network_are_refused_before_it_is_built(folder, monkeypatch):
    write(folder / "config.json", channels=[16, 256])
    monkeypatch.setattr(torch.nn.Module, "load_state_dict", None)
    with pytest.raises(
        InputError,
        match="has shape .*, the configuration needs .*; give the config.json that these weights were trained with",
    ):
        load_model(folder)


def test_integer_weights_are_refused(folder):
    changed(lambda x: x.astype("int64"))(folder)
    with pytest.raises(InputError, match="holds int64, no floating-point numbers"):
        load_model(folder)


def test_nan_is_found_in_8_bit_weights(tmp_path):
    save_file({"x": torch.tensor([1.0, float("nan")]).to(torch.float8_e4m3fn)}, tmp_path / "x.safetensors")
    with pytest.raises(InputError, match="tensor x holds NaN"):
        read_tensors(tmp_path / "x.safetensors")


@pytest.mark.parametrize("name", ["model.safetensors", "config.json", "pictures.json"])
@pytest.mark.parametrize(
    "make",
    [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), lambda path: path.mkdir()],
    ids=["fifo", "device", "folder"],
)
def test_files_of_a_model_that_are_not_regular_are_refused(folder, name, make):
    (folder / name).unlink(missing_ok=True)
    make(folder / name)
    with pytest.raises(InputError, match=f"{name}: is a .*, not a file"):
        read_ranges(folder) if name == "pictures.json" else load_model(folder)


@pytest.mark.parametrize("content", ['{"a": 5}', '{"a": {"low": 0}}', '{"a": {"low": "x", "high": 1}}', "[]"])
def test_malformed_ranges_of_training_pictures_are_refused(folder, content):
    (folder / "pictures.json").write_text(content)
    with pytest.raises(InputError, match="pictures.json"):
        read_ranges(folder)


UNET = {
    "in_channels": 8,
    "class_embed_type": "projection",
    "projection_class_embeddings_input_dim": 10,
    "block_out_channels": [32, 64],
    "down_block_types": ["CrossAttnDownBlock2D", "DownBlock2D"],
    "cross_attention_dim": 32,
    "attention_head_dim": 2,
    "sample_size": 8,
    "norm_num_groups": 8,
}


@pytest.mark.parametrize(
    "change",
    [
        {"block_out_channels": 5},
        {"block_out_channels": []},
        {"block_out_channels": [-4, 8]},
        {"down_block_types": [1, 2]},
        {"down_block_types": ["DownBlock2D"]},
        {"sample_size": 10**9},
        {"sample_size": 0},
        {"layers_per_block": -1},
        {"attention_head_dim": "x"},
        {"norm_num_groups": 0},
        {"cross_attention_dim": None},
        {"in_channels": [8]},
    ],
    ids=lambda x: json.dumps(x),
)
def test_an_invalid_wonder3d_configuration_names_its_file(tmp_path, change):
    for name, content in (
        ("unet/config.json", UNET | change),
        ("scheduler/scheduler_config.json", {"beta_schedule": "scaled_linear"}),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(json.dumps(content))
    with pytest.raises(InputError, match="unet/config.json"):
        wonder3d.read_config(tmp_path, {})


def test_a_checkpoint_without_a_valid_record_is_refused(tmp_path):
    for metadata in (
        {},
        {"state": "{}"},
        {"state": '{"step": -1, "seconds": 0, "identity": ""}'},
        {"state": "nonsense"},
    ):
        save_file({"x": torch.zeros(1)}, tmp_path / CHECKPOINT, metadata=metadata)
        with pytest.raises(InputError, match=CHECKPOINT):
            load_checkpoint(None, tmp_path, "")
