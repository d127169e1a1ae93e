"""benchmarks/train: models beside guesses without one, on views whose figures are known."""

import copy
import functools
import tarfile
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.common.resumable_rows import KeyedRows
from benchmarks.train import authored, quality
from benchmarks.train.baselines import read_training_objects
from benchmarks.train.corpus import unpacked
from benchmarks.train.figures import figures, on_shared_pixels
from benchmarks.train.inflate import Picture, distance_to_outline, inflated_views
from benchmarks.train.makers import Held, model_maker, of_size, picture_of
from benchmarks.train.quality_report import mean_and_error, summary, write_report
from benchmarks.train.surfaces import chosen
from gdtool.assets.scene import Material, Scene, Texture
from gdtool.cameras import rig
from gdtool.core.folder import open_folder
from gdtool.folders.views import Views, write_views
from tests.stages.bake_folders import finish, fresh

SIZE = 64


def disc(radius=20, color=(0.2, 0.4, 0.8), size=SIZE):
    """A picture of a disc, its radius in pixels."""
    x = np.arange(size) + 0.5 - size / 2
    mask = (np.hypot(x[:, None], x[None]) < radius).astype(np.float32)
    return Picture(mask[..., None] * np.float32(color), mask, rig("six", size)[0])


def ball(radius=20, color=(0.2, 0.4, 0.8), roughness=0.5):
    """Views of an inflated disc; a test may change them."""
    return copy.deepcopy(_ball(radius, color, roughness))


@functools.lru_cache
def _ball(radius, color, roughness):
    return inflated_views(disc(radius, color), rig("six", SIZE), roughness)


def write_ball(path, **settings):
    out = fresh(path)
    write_views(out, ball(**settings))
    finish(path, "views", out.content, {})
    return open_folder(path, ("views",))


def test_a_disc_inflates_to_a_ball():
    views, radius = ball(), 20 * rig("six", SIZE)[0].pixel_size
    area = (views.mask > 0.5).sum((1, 2))
    np.testing.assert_allclose(area, area[0], rtol=0.04)
    nearest = [depth[mask > 0.99].min() for depth, mask in zip(views.images["depth"], views.mask, strict=True)]
    np.testing.assert_allclose(nearest, 2 - radius, atol=0.02)


def test_the_inflated_front_is_the_picture():
    views, picture = ball(), disc()
    np.testing.assert_array_equal(views.mask[0], picture.mask)
    np.testing.assert_array_equal(views.images["color"][0], picture.color)


def test_color_is_carried_behind_mirrored_and_sideways():
    picture = disc()
    color = picture.color.copy()
    color[:, SIZE // 2 :] = picture.mask[:, SIZE // 2 :, None] * np.float32((0.9, 0.1, 0.1))
    views = inflated_views(Picture(color, picture.mask, picture.camera), rig("six", SIZE))
    by_name = dict(zip(views.names, views.images["color"], strict=True))
    middle = SIZE // 2
    assert by_name["back"][middle, middle - 5] == pytest.approx((0.9, 0.1, 0.1))
    assert by_name["right"][middle, middle - 5] == pytest.approx((0.9, 0.1, 0.1), abs=1e-5)
    assert by_name["left"][middle, middle - 5] == pytest.approx((0.2, 0.4, 0.8), abs=1e-5)


def test_distance_to_the_outline_of_a_pixel_is_half_of_it():
    inside = np.zeros((3, 3), bool)
    inside[1, 1] = True
    expected = np.zeros((7, 7))
    expected[3, 3] = 0.5
    np.testing.assert_array_equal(distance_to_outline(inside), expected)


def test_a_part_at_the_frame_ends_there():
    assert distance_to_outline(np.ones((4, 4), bool)).max() == 2


def test_the_truth_has_no_error():
    found = figures(ball(), ball())
    assert found["silhouette_overlap"] == found["side_overlap"] == 1
    assert found["color_psnr_frame"] == found["albedo_psnr_foreground"] == found["color_psnr_six"] == 100
    assert found["normal_degrees"] == found["depth_error"] == found["roughness_error"] == 0


def test_figures_are_of_the_unseen_views():
    truth, result = ball(), ball()
    result.mask[truth.names.index("front")] = 0
    result.mask[truth.names.index("right")] = 0
    found = figures(result, truth)
    assert found["silhouette_overlap"] == pytest.approx(0.8)
    assert found["side_overlap"] == pytest.approx(0.5)


def test_roughness_is_measured_on_the_truth():
    assert figures(ball(roughness=0.75), ball())["roughness_error"] == pytest.approx(0.25)


def test_shared_pixels_are_those_of_all_results():
    truth, whole, half = ball(), ball(), ball()
    half.mask[:, :, : SIZE // 2] = 0
    whole.images["depth"][:, :, : SIZE // 2] += 1
    assert figures(whole, truth)["depth_error"] > 0.4
    assert [found["depth_error_shared"] for found in on_shared_pixels([whole, half], truth)] == [0, 0]


@pytest.fixture
def training(tmp_path, monkeypatch):
    """Two training objects: a small rough blue ball and a large smooth red one."""
    monkeypatch.setattr("benchmarks.train.baselines.is_authored", lambda folder: True)
    folders = [
        write_ball(tmp_path / "a.asset" / "views", radius=12, roughness=0.8),
        write_ball(tmp_path / "b.asset" / "views", radius=22, color=(0.8, 0.1, 0.1), roughness=0.2),
    ]
    return read_training_objects(folders, tmp_path), folders


def test_the_nearest_training_object_is_found_by_its_picture(training):
    nearest = training[0].nearest(picture_of(ball(radius=21, color=(0.7, 0.2, 0.1))))
    np.testing.assert_allclose(nearest.mask, ball(radius=22).mask, atol=1 / 255)


def test_constants_are_medians_and_means_of_the_foreground(training):
    # The red ball has three times the pixels: its roughness is the median.
    assert training[0].roughness == pytest.approx(0.2, abs=0.01)
    assert training[0].color[0] > 0.7


def test_medians_are_those_of_authored_objects(training, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.train.baselines.is_authored", lambda folder: folder == training[1][0])
    assert read_training_objects(training[1], tmp_path / "only small").roughness == pytest.approx(0.8, abs=0.01)
    monkeypatch.setattr("benchmarks.train.baselines.is_authored", lambda folder: False)
    assert read_training_objects(training[1], tmp_path / "none").roughness == 0.5


def test_constant_views_have_the_pictures_silhouette_and_face_the_camera(training):
    views = training[0].constant_views(disc(), rig("six", SIZE))
    assert all((mask == disc().mask).all() for mask in views.mask)
    np.testing.assert_allclose(views.images["normal"][2, SIZE // 2, SIZE // 2], rig("six", SIZE)[2].backward, atol=1e-6)


def test_the_mean_object_is_the_mean_of_the_masks(training):
    mean = training[0].mean_views(rig("six", SIZE)).mask
    np.testing.assert_allclose(mean, (ball(radius=12).mask + ball(radius=22).mask) / 2, atol=0.01)


def test_training_objects_are_read_once(training, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.train.baselines.read_views", None)
    again = read_training_objects(training[1], tmp_path)
    np.testing.assert_array_equal(again.pictures, training[0].pictures)


def test_views_of_another_size_and_order_are_brought_to_the_truths():
    own = ball()
    order = [5, 4, 3, 2, 1, 0]
    turned = Views([own.cameras[k] for k in order], {d: x[order] for d, x in own.images.items()}, own.mask[order])
    small = Views(rig("six", SIZE // 2), {}, np.zeros((6, SIZE // 2, SIZE // 2), np.float32))
    found = of_size(turned, small)
    assert found.names == small.names
    assert found.mask.shape == small.mask.shape
    assert found.mask[0].sum() == pytest.approx(own.mask[0].sum() / 4)


@dataclass
class FakeMaker:
    """Makes balls of a radius."""

    name: str
    radius: int
    has_shape: bool = True
    made: list = field(default_factory=list)

    @property
    def key(self):
        return self.name

    def views(self, held, truth):
        self.made.append(held.name)
        return ball(self.radius)

    def cost(self, held):
        return {"cpu_seconds": 1.0}


@pytest.fixture
def bench(tmp_path, monkeypatch):
    monkeypatch.setattr("gdtool.images.perceptual.missing", lambda: {"lpips_alex": "", "lpips_vgg": "", "flip": ""})
    monkeypatch.setattr(quality, "is_authored", lambda folder: "a.asset" in str(folder.path))
    makers = [FakeMaker("true", 20), FakeMaker("small", 10)]
    objects = [Held("balls", write_ball(tmp_path / f"{name}.asset" / "views")) for name in "ab"]
    measured = quality.Bench(makers, KeyedRows(tmp_path / "rows.jsonl"))
    for held in objects:
        measured.measure(held)
    return SimpleNamespace(bench=measured, objects=objects, makers=makers, path=tmp_path)


def test_a_later_run_measures_only_what_is_new(bench):
    makers = [FakeMaker("true", 20), FakeMaker("small", 10), FakeMaker("large", 30, has_shape=False)]
    later = quality.Bench(makers, KeyedRows(bench.path / "rows.jsonl"))
    later.measure(bench.objects[0])
    assert [maker.made for maker in makers] == [[], [], ["a"]]


def test_another_model_is_measured_on_shared_pixels_again(bench):
    makers = [FakeMaker("true", 20), FakeMaker("small", 10), FakeMaker("large", 30)]
    later = quality.Bench(makers, KeyedRows(bench.path / "rows.jsonl"))
    later.measure(bench.objects[0])
    assert [maker.made for maker in makers] == [["a"], ["a"], ["a"]]


def test_roughness_counts_only_where_it_is_authored(bench):
    found = [bench.bench.figures_of(held, bench.makers[0]) for held in bench.objects]
    assert ["roughness_error" in one for one in found] == [True, False]


def test_a_summary_has_the_difference_to_the_first_way(bench):
    found = summary(bench.bench, bench.objects)
    overlap = {way: found[way]["silhouette_overlap"] for way in found}
    assert overlap["true"]["mean"] == pytest.approx(1, abs=0.01)
    assert overlap["small"]["more"] == pytest.approx(overlap["small"]["mean"] - overlap["true"]["mean"])
    assert "more" not in overlap["true"]


def test_a_report_has_a_table_for_each_set(bench, tmp_path):
    text = write_report(bench.bench, {"balls": bench.objects, "balls, a": bench.objects[:1]}, {"balls"}, tmp_path, "m")
    assert "## Balls: 2 objects (roughness on 1)" in text
    assert "| silhouette overlap | 0.995 ± 0.000 | 0.245 ± 0.000 |" in text
    assert "More than true, on the same objects:" in text
    assert (tmp_path / "m.md").read_text() == text


def test_a_mean_has_its_standard_error():
    assert mean_and_error([1, 2, 6]) == (3, pytest.approx(np.std([1, 2, 6], ddof=1) / 3**0.5))
    assert np.isnan(mean_and_error([1])[1])


@pytest.mark.parametrize(("share", "expected"), [(0.6, True), (0.4, False)])
def test_authored_needs_a_texture_on_half_of_the_area(share, expected, monkeypatch):
    vertices = np.array([[0, 0, 0], [share, 0, 0], [0, 1, 0], [0, 0, 1], [1 - share, 0, 1], [0, 1, 1]], float)
    texture = Texture(np.zeros((2, 2, 3), np.uint8))
    scene = Scene(
        vertices,
        np.array([[0, 1, 2], [3, 4, 5]], np.int32),
        (Material(metallic_roughness_texture=texture), Material(roughness=0.3)),
        np.array([0, 1], np.int32),
    )
    monkeypatch.setattr(authored, "find_truth", lambda folder: "model.glb")
    monkeypatch.setattr(authored, "load_model", lambda source: scene)
    assert authored.is_authored(None) == expected


def test_generated_objects_are_authored(monkeypatch):
    monkeypatch.setattr(authored, "find_truth", lambda folder: "procedural:7")
    assert authored.is_authored(None)


def test_a_row_that_a_killed_run_left_unfinished_is_measured_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    KeyedRows(path).add({"key": "a", "value": 1})
    with path.open("a") as file:
        file.write('{"key": "b", "val')
    KeyedRows(path).add({"key": "b", "value": 2})
    assert KeyedRows(path).rows == {"a": {"key": "a", "value": 1}, "b": {"key": "b", "value": 2}}


def test_a_model_is_named_with_options(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "benchmarks.train.makers.open_folder", lambda *_: SimpleNamespace(manifest=SimpleNamespace(files=()))
    )
    made = model_maker("new one=out/new --steps 4", tmp_path)
    assert (made.name, str(made.model), made.options) == ("new one", "out/new", ("--steps", "4"))
    assert model_maker("out/new", tmp_path).name == "new"
    assert made.key != model_maker("out/new", tmp_path).key


def test_more_objects_for_surfaces_keep_those_that_were_measured():
    objects = [SimpleNamespace(name=str(number)) for number in range(10)]
    assert chosen(objects, 5)[:3] == chosen(objects, 3)
    assert len(chosen(objects, 20)) == 10


def test_a_part_of_a_corpus_is_unpacked(tmp_path):
    (tmp_path / "SOURCES.tsv").write_text("archive\tobject\tsplit\nkit\ta.glb\tvalidation\nkit\tb.glb\ttrain\n")
    for name in ("a.glb", "b.glb"):
        (tmp_path / name).write_text(name)
    with tarfile.open(tmp_path / "kit.tar.xz", "w:xz") as tar:
        for name in ("a.glb", "b.glb"):
            tar.add(tmp_path / name, name)
    (path,) = unpacked(tmp_path, "validation", tmp_path / "out")
    assert path == tmp_path / "out" / "kit" / "a.glb"
    assert path.read_text() == "a.glb"
