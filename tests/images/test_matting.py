"""Cut out a subject by a tiny ONNX network."""

import sys

import numpy as np
import pytest

from gdtool.core.errors import InputError, ResourceError
from gdtool.images.mask import foreground
from gdtool.images.matting import DEVIATION, MEAN
from tests.images.test_mask import busy_scene, overlap


@pytest.fixture
def network(tmp_path):
    """Write a network with U²-Net's interface and a single convolution, which finds red."""
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    weight = (np.array([1.0, -0.5, -0.5]) * DEVIATION).astype(np.float32).reshape(1, 3, 1, 1)
    bias = np.array([np.dot([1.0, -0.5, -0.5], MEAN)], np.float32)
    graph = helper.make_graph(
        [
            helper.make_node("Conv", ["input.1", "weight", "bias"], ["redness"]),
            helper.make_node("Sigmoid", ["redness"], ["found"]),
        ],
        "red",
        [helper.make_tensor_value_info("input.1", TensorProto.FLOAT, [1, 3, 320, 320])],
        [helper.make_tensor_value_info("found", TensorProto.FLOAT, [1, 1, 320, 320])],
        [numpy_helper.from_array(weight, "weight"), numpy_helper.from_array(bias, "bias")],
    )
    path = tmp_path / "red.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
    return path


def test_a_network_cuts_out_what_it_finds_on_any_background(network):
    image, truth = busy_scene(size=480)
    warned = []
    mask = foreground(image, None, "leaf.png", warned.append, network)
    assert mask.shape == truth.shape
    assert mask.dtype == np.float32
    assert not warned
    assert overlap(mask, truth) > 0.97


def test_a_mask_and_alpha_come_before_the_network(network):
    image, truth = busy_scene()
    alpha = np.zeros(truth.shape, np.uint8)
    alpha[10:20, 10:20] = 255
    np.testing.assert_array_equal(foreground(np.dstack([image, alpha]), network=network), alpha / 255)
    np.testing.assert_array_equal(foreground(image, alpha, network=network), alpha / 255)


def test_a_network_that_finds_nothing_is_an_error(network):
    with pytest.raises(InputError, match=r"red\.onnx: finds nothing"):
        foreground(np.full((100, 100, 3), 120, np.uint8), subject="grey.png", network=network)


def test_a_file_that_is_no_network_is_refused_in_one_line(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "u2net.onnx"
    path.write_text("no network")
    with pytest.raises(InputError, match=r"u2net\.onnx: is no network of U²-Net's structure") as caught:
        foreground(busy_scene()[0], network=path)
    assert "\n" not in str(caught.value)


def test_without_onnxruntime_the_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ResourceError, match=r"gdtool\[matting\]"):
        foreground(busy_scene()[0], network="u2net.onnx")
