"""The reconstruction benchmark's own arithmetic: the disturbance, the peers, the tables."""

from argparse import Namespace

import numpy as np
import pytest

from benchmarks.reconstruct import (
    peers,
    perturbation,
)
from benchmarks.reconstruct import report as reconstruct_report
from benchmarks.reconstruct import sweep as reconstruct
from gdtool.folders.views import Views
from tests.fields.shapes import sphere, views_of


@pytest.fixture(scope="module")
def ball():
    cameras, images, mask = views_of(sphere, 64, 1)
    return Views(cameras, images, mask)


def test_the_disturbance_has_the_size_it_says(ball):
    how = perturbation.Perturbation(seed=3)
    found, again = perturbation.perturbed(ball, how), perturbation.perturbed(ball, how)
    other = perturbation.perturbed(ball, perturbation.Perturbation(seed=4))
    inner = (ball.mask > 0.99) & (found.mask > 0.99)
    change = (found.images["depth"] - ball.images["depth"])[inner]
    assert 0.005 < change.std() < 0.03
    angle = np.degrees(np.arccos(np.clip((found.images["normal"] * ball.images["normal"]).sum(-1)[inner], -1, 1)))
    assert 3 < np.sqrt((angle**2).mean()) < 7
    assert np.allclose(np.linalg.norm(found.images["normal"][inner], axis=-1), 1, atol=1e-4)
    assert (found.images["depth"] == again.images["depth"]).all()
    assert (found.images["depth"] != other.images["depth"]).any()
    for k in range(6):  # a pixel more or less on both sides
        assert abs((found.mask[k, 32] > 0.5).sum() - (ball.mask[k, 32] > 0.5).sum()) == 2
    assert (found.images["depth"][found.mask > 0.5] > 0.5).all()  # a grown mask's new pixels have values


@pytest.mark.parametrize("name", ["carved hull", "hull", "capped Poisson", "Poisson"])
def test_peers_find_a_ball(ball, name):
    method = peers.available().get(name)
    if method is None:
        pytest.skip("its package is not installed")
    vertices, faces = method(ball, 48 if "hull" in name else 5)
    radius = np.linalg.norm(vertices[np.abs(vertices[:, 1]) < 0.3], axis=1)  # tops and bottoms are not seen
    assert np.abs(np.median(radius) - 0.5) < (0.03 if name == "hull" else 0.01)
    corners = vertices[faces]
    assert np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0  # outward


def test_report_names_what_is_missed_and_who_is_better(tmp_path):
    records = [
        {
            "model": "cat",
            "source": "cat.glb",
            "method": m,
            "case": c,
            "distance": d,
            "iou": 0.99,
            "seconds": 3.0,
            "watertight": True,
        }
        for m, c, d in (
            (reconstruct.OURS, "clean", 5e-4),
            (reconstruct.OURS, "perturbed 0 0.125", 9e-3),
            ("carved hull", "clean", 6e-4),
            ("carved hull", "perturbed 0 0.125", 4e-3),
        )
    ]
    text = reconstruct.markdown(records, Namespace(size=64, seeds=1, wavelengths=[0.125]), "")
    assert "clean: median distance 0.0005, wanted ≤ 0.0007: holds" in text
    assert "perturbed: median distance 0.009, wanted ≤ 0.0022: **missed**" in text
    assert text.count("| yes |") == 1
    assert text.count("| NO |") == 1
    reconstruct.plot(records, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000


def rows_of(**figures):
    return [
        {"model": "cat", "source": "cat.glb", "case": "clean", "watertight": True, "iou": 0.99, **row}
        for row in figures["rows"]
    ]


def test_a_budget_is_held_against_the_peers_that_were_done_by_then():
    rows = rows_of(
        rows=[
            {"method": "gdtool", "distance": 1e-3, "seconds": 6.0},
            {"method": "gdtool 5 s", "distance": 2e-3, "seconds": 4.0},
            {"method": "gdtool 10 s", "distance": 2e-3, "seconds": 8.0},
            {"method": "carved hull", "distance": 3e-3, "seconds": 1.0},
            {"method": "slow peer", "distance": 1.5e-3, "seconds": 9.0},
        ]
    )
    text = reconstruct_report.by_budget(rows)
    first, second = (next(line for line in text.splitlines() if f"clean, {b} s" in line) for b in (5, 10))
    assert "carved hull" in first
    assert "| yes |" in first
    assert "slow peer" in second
    assert "| NO |" in second


def test_skips_say_what_they_save():
    rows = rows_of(
        rows=[
            {
                "method": "gdtool",
                "distance": 1e-3,
                "skips": [{"what": "band", "done": 3.0, "skipped": 1.0, "change": 0.0}],
            }
        ]
    )
    assert "| band | 3 | 1 | 2 | 0 | 1 |" in reconstruct_report.by_skip(rows)


def test_rows_that_were_measured_are_not_measured_again(tmp_path):
    given = Namespace(output=tmp_path, size=64, options=[], fresh=False)
    bench = reconstruct.Bench(given)
    bench.records.append({"model": "cat", "source": "cat.glb", "case": "clean", "method": "gdtool", "distance": 1e-3})
    bench.records.append({"model": "dog", "source": "dog.glb", "case": "clean", "method": "gdtool", "failed": "killed"})
    bench.save()
    again = reconstruct.Bench(given)
    assert not again.has("dog", "clean", "gdtool")
    assert again.has("cat", "clean", "gdtool")
    assert not again.has("cat", "clean", "carved hull")
    # Of other views.
    assert not reconstruct.Bench(Namespace(output=tmp_path, size=128, options=[], fresh=False)).records
    again.save(complete=True)
    assert not reconstruct.Bench(given).records


def test_normals_of_a_result_beside_what_the_views_show(ball):
    vertices, faces = peers.carved_hull(ball, 64)
    assert reconstruct.normals_beside(vertices, faces, ball) < 15
    assert reconstruct.normals_beside(vertices, faces[:, ::-1], ball) > 150
