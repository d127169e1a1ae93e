"""Run gdtool sample-views with a tiny model that was trained for one step."""

import json
import shutil
import subprocess
import sys

import msgspec
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from gdtool.core.errors import InputError
from gdtool.core.kinds import ModelContent
from gdtool.core.manifest import MANIFEST, Manifest, encode, list_files
from gdtool.diffusion.checkpoint.weights import load_model, save_model
from gdtool.diffusion.config import PRESETS
from gdtool.diffusion.network.model import Model
from gdtool.images.io import read_image, write_png

CONFIG = msgspec.structs.replace(PRESETS["tiny"][0], channels=(8, 16), head_width=8, encoder_width=16, image_size=16)


def write_manifest(folder):
    content = ModelContent(preset="tiny", image_size=16, domains=CONFIG.domains, parameters=1, steps=1)
    (folder / MANIFEST).unlink(missing_ok=True)
    manifest = Manifest(
        kind="model", name="tiny", stage="train", tool_version="0", content=content, files=list_files(folder)
    )
    (folder / MANIFEST).write_bytes(encode(manifest))


@pytest.fixture(scope="module")
def tiny_model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny") / "model"
    folder.mkdir()
    torch.manual_seed(0)
    model = Model(CONFIG)
    torch.nn.init.normal_(model.unet.conv_out.weight, std=0.1)
    save_model(lambda name: folder / name, CONFIG, model.state_dict())
    write_manifest(folder)
    return folder


@pytest.fixture
def picture(tmp_path):
    y, x = np.mgrid[:80, :80]
    alpha = ((x - 50) ** 2 + (y - 30) ** 2 < 20**2).astype(float)
    rgba = np.stack([0.8 * alpha, 0.3 * alpha, x / 80 * alpha, alpha], -1)
    write_png(tmp_path / "ball.png", rgba)
    return tmp_path / "ball.png"


def sample(gdtool, *arguments, **kwargs):
    return gdtool("sample-views", *arguments, "--steps", 2, "--threads", 1, **kwargs)


def test_a_picture_becomes_six_views_in_six_domains(gdtool, picture, tiny_model, tmp_path):
    result = sample(gdtool, "ball.png", "--model", tiny_model)
    assert result.returncode == 0, result.stderr
    assert result.stdout == "ball.asset/views\n"
    views = tmp_path / "ball.asset/views"
    for domain in ("color", "normal", "depth", "albedo", "roughness", "metallic", "mask"):
        assert len(list((views / domain).glob("*"))) == 6, domain
    assert read_image(views / "normal/back.png").dtype == np.uint16
    assert (views / "contact_sheet.png").is_file()
    # The ball is 39 pixels of the picture wide and 11 of the views: what they were made of is kept four times as fine.
    record = json.loads((views / MANIFEST).read_text())
    assert record["content"]["picture"] == "front"
    skipped = {entry["what"] for entry in record["skipped"]}
    assert (record["content"]["report"]["drawn_share"] > 0) != ("parts of the picture in the other views" in skipped)
    # Views that a model made of a picture: their surface is moved out by a fifth of a pixel.
    made = gdtool("reconstruct", views)
    assert made.returncode == 0, made.stderr
    surface = json.loads((tmp_path / "ball.asset/surface" / MANIFEST).read_text())
    assert surface["content"]["report"]["grown"] > 0
    assert "growth of the surface" not in {entry["what"] for entry in surface["skipped"]}
    assert (surface["content"]["report"]["restored_share"] > 0) != (
        "parts that the picture alone shows" in {entry["what"] for entry in surface["skipped"]}
    )
    kept, shown = read_image(views / "picture.png"), read_image(views / "condition/000.png")
    assert kept.shape == (64, 64, 4)
    assert np.abs(kept[..., 3].reshape(16, 4, 16, 4).mean((1, 3)) - shown[..., 3]).mean() < 8
    assert gdtool("validate", views).returncode == 0
    second_run = sample(gdtool, "ball.png", "--model", tiny_model)
    assert "up to date" in second_run.stderr
    assert second_run.stdout == "ball.asset/views\n"


def bytes_of(folder):
    return {
        p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and p.name != MANIFEST
    }


def test_a_result_does_not_depend_on_the_other_sources(gdtool, picture, tiny_model, tmp_path):
    shutil.copyfile(picture, tmp_path / "other.png")
    assert sample(gdtool, "ball.png", "--model", tiny_model, "--seed", 5, "-o", "alone").returncode == 0
    assert sample(gdtool, "other.png", "ball.png", "--model", tiny_model, "--seed", 5, "-o", "both").returncode == 0
    assert bytes_of(tmp_path / "alone") == bytes_of(tmp_path / "both/ball.asset/views")
    assert sample(gdtool, "ball.png", "--model", tiny_model, "--seed", 6, "-o", "else").returncode == 0
    assert bytes_of(tmp_path / "else") != bytes_of(tmp_path / "alone")


def test_a_subset_of_the_domains(gdtool, picture, tiny_model, tmp_path):
    result = sample(
        gdtool, "ball.png", "--model", tiny_model, "--domains", "normal,depth", "--scheduler", "dpm", "--guidance", 2
    )
    assert result.returncode == 0, result.stderr
    content = json.loads((tmp_path / "ball.asset/views" / MANIFEST).read_text())["content"]
    assert content["domains"] == ["normal", "depth"]
    assert [content["report"][name] for name in ("steps", "guidance", "eta", "spacing")] == [2, 2.0, 0.0, "trailing"]
    assert not (tmp_path / "ball.asset/views/color").exists()
    wrong = sample(gdtool, "ball.png", "--model", tiny_model, "--domains", "normals")
    assert wrong.returncode == 2
    assert "normals" in wrong.stderr


def test_a_subset_is_what_a_run_of_all_domains_writes(gdtool_here, picture, tiny_model, tmp_path):
    for name, more in (("all", ()), ("some", ("--domains", "albedo,normal"))):
        made = sample(gdtool_here, "ball.png", "--model", tiny_model, *more, "-o", name)
        assert made.returncode == 0, made.stderr
    whole = bytes_of(tmp_path / "all")
    for path, content in bytes_of(tmp_path / "some").items():
        assert path.name == "contact_sheet.png" or whole[path] == content, path


def test_renewed_noise_is_asked_of_ddim_alone(gdtool_here, picture, tiny_model):
    refused = sample(gdtool_here, "ball.png", "--model", tiny_model, "--scheduler", "dpm", "--eta", 1)
    assert refused.returncode == 2
    assert "--eta" in refused.stderr


@pytest.mark.slow
def test_a_compiled_network_gives_the_same(gdtool, picture, tiny_model, tmp_path):
    for name, more in (("plain", ()), ("compiled", ("--compile",))):
        result = sample(gdtool, "ball.png", "--model", tiny_model, *more, "-o", name)
        assert result.returncode == 0, result.stderr
    for path in sorted((tmp_path / "plain/color").glob("*.png")):
        np.testing.assert_allclose(read_image(path), read_image(tmp_path / "compiled/color" / path.name), atol=1)


@pytest.mark.slow
def test_a_missing_compiler_is_reported(gdtool, picture, tiny_model, monkeypatch, tmp_path):
    monkeypatch.setenv("CXX", "/bin/false")
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    result = sample(gdtool, "ball.png", "--model", tiny_model, "--compile", "-o", "out")
    assert result.returncode == 5
    assert "--compile: PyTorch cannot compile" in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_mask_file_says_what_the_subject_is(gdtool, tiny_model, tmp_path):
    rng = np.random.default_rng(0)
    write_png(tmp_path / "busy.png", rng.random((64, 64, 3)))
    mask = np.zeros((64, 64))
    mask[10:30, 20:50] = 1
    write_png(tmp_path / "mask.png", mask)
    assert sample(gdtool, "busy.png", "--model", tiny_model, "--mask", "mask.png").returncode == 0
    seen = read_image(tmp_path / "busy.asset/views/condition/000.png")[..., 3] > 127
    rows, columns = np.nonzero(seen)
    # 30 x 20 pixels, centred, the longer side 0.694 of the frame
    assert abs(np.ptp(columns) + 1 - 11) <= 1
    assert abs(rows.mean() - 7.5) < 0.6
    write_png(tmp_path / "mask.png", np.zeros((64, 64)))
    empty = sample(gdtool, "busy.png", "--model", tiny_model, "--mask", "mask.png", "-o", "none")
    assert empty.returncode == 3
    assert "Traceback" not in empty.stderr
    assert not (tmp_path / "none").exists()


def test_bad_pictures_are_bad_input(gdtool, tiny_model, tmp_path):
    (tmp_path / "text.png").write_text("not a picture")
    write_png(tmp_path / "small.png", np.ones((8, 8, 4)))
    write_png(tmp_path / "clear.png", np.zeros((64, 64, 4)))
    for name in ("text.png", "small.png", "clear.png"):
        result = sample(gdtool, name, "--model", tiny_model)
        assert result.returncode == 3, result.stderr
        assert name.split(".")[0] in result.stderr, result.stderr
        assert "Traceback" not in result.stderr, result.stderr


def test_it_works_in_a_pipe(gdtool, picture, tiny_model):
    result = sample(gdtool, "--model", tiny_model, stdin="ball.png\n")
    assert result.returncode == 0
    assert result.stdout == "ball.asset/views\n"
    assert sample(gdtool, "--model", tiny_model).returncode == 2


@pytest.fixture
def damaged(tiny_model, tmp_path):
    shutil.copytree(tiny_model, tmp_path / "damaged")
    return tmp_path / "damaged"


def test_weights_of_the_wrong_shape_are_named(damaged):
    weights = load_file(damaged / "model.safetensors")
    weights["unet.conv_in.weight"] = weights["unet.conv_in.weight"][:4]
    save_file(weights, damaged / "model.safetensors")
    with pytest.raises(InputError, match=r"unet\.conv_in\.weight has shape \(4, "):
        load_model(damaged)


def test_weights_that_are_missing_unknown_or_nan_are_named(damaged):
    whole = load_file(damaged / "model.safetensors")
    for change, words in (
        ({"unet.conv_out.bias": None}, "lacks tensor unet.conv_out.bias"),
        ({"surplus": np.zeros(3, np.float16)}, "surplus"),
        ({"unet.conv_out.bias": np.full_like(whole["unet.conv_out.bias"], np.nan)}, "unet.conv_out.bias holds NaN"),
    ):
        save_file({k: v for k, v in (whole | change).items() if v is not None}, damaged / "model.safetensors")
        with pytest.raises(InputError, match=words):
            load_model(damaged)


def test_a_cut_file_is_named_and_a_pickle_never_opened(gdtool, picture, damaged):
    path = damaged / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-10])
    write_manifest(damaged)
    result = sample(gdtool, "ball.png", "--model", damaged)
    assert result.returncode == 3
    assert "safetensors" in result.stderr
    path.unlink()
    (damaged / "model.ckpt").write_bytes(b"cos\nsystem\n(S'touch owned'\ntR.")
    write_manifest(damaged)
    result = sample(gdtool, "ball.png", "--model", damaged)
    assert result.returncode == 3
    assert "pickle" in result.stderr
    assert not (damaged.parent / "owned").exists()


def test_a_picture_unlike_the_training_is_sampled_with_a_warning(gdtool, picture, tiny_model, tmp_path):
    model = shutil.copytree(tiny_model, tmp_path / "model")
    (model / "pictures.json").write_text(json.dumps({"width over height of the subject": {"low": 0.9, "high": 1.1}}))
    write_manifest(model)
    assert "unlike" not in sample(gdtool, "ball.png", "--model", model).stderr
    (model / "pictures.json").write_text(json.dumps({"width over height of the subject": {"low": 2.0, "high": 3.0}}))
    write_manifest(model)
    result = sample(gdtool, "ball.png", "--model", model, "-o", "again")
    assert result.returncode == 0
    assert "width over height of the subject is 1.09, in training 2 to 3" in result.stderr


def test_a_result_that_the_model_is_unsure_of_gets_a_warning(gdtool, picture, tiny_model, tmp_path):
    model = shutil.copytree(tiny_model, tmp_path / "model")
    for name, high in (("sure", 1e6), ("unsure", 0.0)):
        (model / "pictures.json").write_text(json.dumps({"outline_blur": {"low": 0.0, "high": high}}))
        write_manifest(model)
        result = sample(gdtool, "ball.png", "--model", model, "-o", name)
        record = json.loads((tmp_path / name / MANIFEST).read_text())
        width = record["content"]["report"]["outline_blur"]
        doubts = [text for text in record["warnings"] if "unsure" in text]
        assert result.returncode == 0
        assert width > 0
        assert len(doubts) == (name == "unsure")
    assert f"blurred over {width:.1f} pixels, 0.0 at most is usual" in doubts[0]
    assert doubts[0] in result.stderr
    # What is usual is known of one way of sampling.
    result = sample(gdtool, "ball.png", "--model", model, "--domains", "normal,depth", "-o", "other")
    record = json.loads((tmp_path / "other" / MANIFEST).read_text())
    assert not any("unsure" in text for text in record["warnings"])
    assert "the model's doubt of its result" in {entry["what"] for entry in record["skipped"]}


def test_loading_a_model_leaves_pytorchs_compiler_out():
    # It takes a second to import, and one operation on the meta device, where shapes are checked, can do that.
    code = (
        "import sys; from pathlib import Path; import gdtool.models; from gdtool.diffusion.checkpoint.weights import "
        "load_model; "
        "load_model(Path(gdtool.models.__file__).parent / 'default'); print([m for m in ('torch._dynamo', 'sympy') "
        "if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
