"""Run gdtool sample-views on several pictures and on given views, with a tiny untrained model of the volume kind."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from gdtool.core.folder import open_folder
from gdtool.core.kinds import ModelContent
from gdtool.core.manifest import MANIFEST, Manifest, encode, list_files
from gdtool.diffusion.checkpoint.weights import save_model
from gdtool.diffusion.network.model import Model
from gdtool.folders.views import read_views
from gdtool.images.io import read_image, write_png
from tests.diffusion.test_shape import MODEL, random_model


@pytest.fixture(scope="module")
def volume_model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volume") / "model"
    folder.mkdir()
    save_model(lambda name: folder / name, MODEL, random_model().state_dict())
    content = ModelContent(preset="volume", image_size=32, domains=MODEL.domains, parameters=1, steps=1)
    manifest = Manifest(
        kind="model", name="volume", stage="train", tool_version="0", content=content, files=list_files(folder)
    )
    (folder / MANIFEST).write_bytes(encode(manifest))
    return folder


@pytest.fixture(scope="module")
def true_views(tmp_path_factory):
    """Render an asymmetric object: its views folder."""
    place = tmp_path_factory.mktemp("truth")
    (place / "wedge.obj").write_text(WEDGE)
    options = ["--size", "64", "--samples", "2", "--threads", "1", "-o", "views"]
    subprocess.run([sys.executable, "-m", "gdtool", "render-dataset", "wedge.obj", *options], cwd=place, check=True)
    return place / "views"


# A wedge that is thick at its lower front and thin everywhere else, and longer to the left than to the right.
WEDGE = """v -0.5 -0.3 0.4
v 0.3 -0.3 0.4
v 0.3 -0.3 -0.4
v -0.5 -0.3 -0.4
v -0.5 0.3 -0.4
v 0.3 0.3 -0.4
f 4 3 2 1
f 3 4 5 6
f 1 2 6 5
f 1 5 4
f 2 3 6
"""


def sample(gdtool, *arguments):
    return gdtool("sample-views", *arguments, "--threads", 1)


def test_a_given_left_side_is_the_one_of_the_folders_left_view(gdtool_here, volume_model, true_views, tmp_path):
    front, left = (true_views / f"color/{name}.png" for name in ("front", "left"))
    done = sample(gdtool_here, "--front", front, "--left", left, "--model", volume_model, "-o", tmp_path / "made")
    assert done.returncode == 0, done.stderr
    truth, made = (read_views(open_folder(path, ("views",))) for path in (true_views, tmp_path / "made"))
    k = made.names.index("right")  # not given: bounded by the left silhouette, seen from behind
    small = truth.mask[truth.names.index("right")].reshape(32, 2, 32, 2).mean((1, 3))
    grown = np.zeros((34, 34))
    for y in range(3):
        for x in range(3):
            grown[y : y + 32, x : x + 32] = np.maximum(grown[y : y + 32, x : x + 32], small)
    inside = made.mask[k] > 0.5
    assert inside.any()
    # Where the given silhouette leaves the front's top row no space, the object is drawn beyond it.
    own_side, other_side = ((side[inside] > 0).mean() for side in (grown[1:33, 1:33], grown[1:33, 1:33][:, ::-1]))
    assert own_side > 0.8
    assert own_side > other_side + 0.2


def test_given_pictures_are_the_colors_of_their_views(gdtool_here, volume_model, true_views, tmp_path):
    pictures = {name: true_views / f"color/{name}.png" for name in ("front", "back", "right")}
    flags = [argument for name, path in pictures.items() for argument in (f"--{name}", path)]
    done = sample(gdtool_here, *flags, "--model", volume_model, "-o", tmp_path / "made")
    assert done.returncode == 0, done.stderr
    made = read_views(open_folder(tmp_path / "made", ("views",)))
    truth = read_views(open_folder(true_views, ("views",)))
    for name in ("back", "right"):
        k, j = made.names.index(name), truth.names.index(name)
        small = truth.mask[j].reshape(32, 2, 32, 2).mean((1, 3))
        assert np.abs(made.mask[k] - small).mean() < 0.03, name
    heights = [np.ptp(np.nonzero(mask.max(1) > 0.5)[0]) for mask in made.mask]
    assert max(heights) - min(heights) <= 2


def test_given_geometry_is_written_as_it_is(gdtool_here, volume_model, true_views, tmp_path):
    done = gdtool_here(
        "render-dataset", true_views.parent / "wedge.obj", "--size", 32, "--samples", 2, "--domains", "normal,depth",
        "-o", tmp_path / "shape",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    y, x = np.mgrid[:80, :80]
    alpha = ((np.abs(x - 40) < 30) & (np.abs(y - 40) < 20)).astype(float)
    write_png(tmp_path / "photo.png", np.stack([0.8 * alpha, 0.3 * alpha, x / 80 * alpha, alpha], -1))
    done = sample(
        gdtool_here,
        tmp_path / "photo.png",
        "--given",
        tmp_path / "shape",
        "--model",
        volume_model,
        "-o",
        tmp_path / "made",
    )
    assert done.returncode == 0, done.stderr
    made, given = (open_folder(tmp_path / name, ("views",)) for name in ("made", "shape"))
    own, truth = read_views(made), read_views(given)
    for domain in ("normal", "depth"):
        np.testing.assert_allclose(own.images[domain], truth.images[domain], atol=2e-4, err_msg=domain)
    np.testing.assert_allclose(own.mask, truth.mask, atol=1e-6)
    assert made.content.source_from_world == given.content.source_from_world
    assert own.images["albedo"].max() > 0


def test_a_picture_of_one_side_alone_is_enough(gdtool_here, volume_model, true_views, tmp_path):
    done = sample(
        gdtool_here, "--left", true_views / "color/left.png", "--model", volume_model, "-o", tmp_path / "made"
    )
    assert done.returncode == 0, done.stderr
    record = json.loads((tmp_path / "made" / MANIFEST).read_text())
    assert record["content"]["picture"] == ""
    assert not (tmp_path / "made/picture.png").exists()
    assert read_image(tmp_path / "made/color/left.png")[..., 3].max() == 255


def test_two_pictures_of_one_view_are_refused(gdtool_here, volume_model, true_views):
    front = true_views / "color/front.png"
    done = sample(gdtool_here, front, "--front", front, "--model", volume_model)
    assert done.returncode == 2
    assert "--front: is what the source shows" in done.stderr


def test_other_seeds_give_other_shapes_and_zero_the_best_guess(gdtool_here, volume_model, true_views, tmp_path):
    front = true_views / "color/front.png"
    masks = {}
    for seed in (0, 1, 2):
        done = sample(gdtool_here, front, "--seed", seed, "--model", volume_model, "-o", tmp_path / f"seed{seed}")
        assert done.returncode == 0, done.stderr
        masks[seed] = read_views(open_folder(tmp_path / f"seed{seed}", ("views",))).images["depth"]
    assert not np.array_equal(masks[1], masks[2])
    assert not np.array_equal(masks[0], masks[1])


def test_a_model_of_one_picture_refuses_others(gdtool_here, true_views, tmp_path_factory):
    from gdtool.diffusion.config import PRESETS

    folder = tmp_path_factory.mktemp("tiny") / "model"
    folder.mkdir()
    torch.manual_seed(0)
    config = PRESETS["tiny"][0]
    save_model(lambda name: folder / name, config, Model(config).state_dict())
    content = ModelContent(preset="tiny", image_size=32, domains=config.domains, parameters=1, steps=1)
    manifest = Manifest(
        kind="model", name="tiny", stage="train", tool_version="0", content=content, files=list_files(folder)
    )
    (folder / MANIFEST).write_bytes(encode(manifest))
    front, back = (true_views / f"color/{name}.png" for name in ("front", "back"))
    done = sample(gdtool_here, front, "--back", back, "--model", folder)
    assert done.returncode == 2
    assert "takes one picture of the front alone" in done.stderr
