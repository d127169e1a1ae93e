"""Run gdtool render-dataset on small generated meshes."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gdtool.core.folder import open_folder
from gdtool.folders.records import read_cameras
from gdtool.folders.views import read_views

FAST = ("--size", "32", "--samples", "4", "--light-samples", "4")

# A box 0.4 x 1.2 x 0.8 away from the origin; quads wound outward.
BOX = """
v 3.0 1.0 2.0
v 3.4 1.0 2.0
v 3.4 2.2 2.0
v 3.0 2.2 2.0
v 3.0 1.0 2.8
v 3.4 1.0 2.8
v 3.4 2.2 2.8
v 3.0 2.2 2.8
f 5 6 7 8
f 2 1 4 3
f 6 2 3 7
f 1 5 8 4
f 8 7 3 4
f 1 2 6 5
"""


@pytest.fixture
def box(tmp_path):
    (tmp_path / "box.obj").write_text(BOX)
    return tmp_path / "box.obj"


@pytest.fixture
def gdtool(gdtool_here):
    """Run commands within this process, except in tests that ask for the command itself."""
    return gdtool_here


def command(*arguments) -> list[str]:
    return [sys.executable, "-m", "gdtool", "render-dataset", *map(str, arguments)]


def manifest(path) -> dict:
    return json.loads((path / "manifest.json").read_text())


def test_writes_a_folder_that_validates_with_all_it_should_hold(gdtool, box, tmp_path):
    done = gdtool("render-dataset", box, *FAST, "--condition-views", "3")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "box.asset/views\n"
    path = tmp_path / "box.asset" / "views"
    assert gdtool("validate", path).returncode == 0
    content = manifest(path)["content"]
    assert content["conditions"] == 3
    assert content["light"]
    assert content["environment"].startswith("random:")
    saved = {s["what"]: s.get("saved_seconds") for s in manifest(path)["skipped"]}
    assert set(saved) >= {"base color lookups", "alpha tests"}
    assert all(saved[what] > 0 for what in ("rays", "normal lookups", "shadow rays of convex objects", "shadow rays"))
    assert len(read_cameras(path / "condition.json")) == 3
    assert len(list((path / "condition").glob("*.png"))) == 3
    views = read_views(open_folder(path))
    assert set(views.images) == {"color", "normal", "depth", "albedo", "roughness", "metallic", "closed_form"}
    # The box, normalised: its front face spans 1/3 x 1 and lies 1/3 in front of the centre.
    matrix = np.array(content["source_from_world"]).reshape(4, 4)
    assert matrix[0, 0] == pytest.approx(1.2)
    assert np.allclose(matrix[:3, 3], (3.2, 1.6, 2.4))
    front = views.mask[0].sum() * views.cameras[0].pixel_size ** 2
    assert front == pytest.approx(1 / 3, rel=0.1)
    assert np.allclose(views.images["normal"][0, 16, 16], (0, 0, 1), atol=1e-4)
    assert np.allclose(views.images["normal"][2, 16, 16], (1, 0, 0), atol=1e-4)
    assert views.images["depth"][0, 16, 16] == pytest.approx(2 - 1 / 3, abs=1e-5)
    assert (views.images["color"][views.mask > 0] > 0).any()


def test_turned_objects_look_as_from_a_turned_camera(gdtool, box, tmp_path):
    """source_from_world records each turn, and smooth normals turn with the object."""
    ball = trimesh.creation.icosphere(2)
    ball.apply_scale((1.0, 1.5, 0.5))
    ball.vertex_normals  # noqa: B018 - written with the file
    ball.export("ball.glb")
    for model in (box, "ball.glb"):
        name = str(model).split("/")[-1].split(".")[0]
        assert gdtool("render-dataset", model, *FAST, "--turn", "180", "-o", f"{name}-turned").returncode == 0
        views = read_views(open_folder(tmp_path / f"{name}-turned"))
        matrix = np.array(manifest(tmp_path / f"{name}-turned")["content"]["source_from_world"]).reshape(4, 4)
        rotation = matrix[:3, :3] / np.linalg.norm(matrix[:3, 0])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(rotation[1], (0, 1, 0), atol=1e-12)
        assert abs(rotation[0, 2]) > 0.1
        # The same object, turned by hand.
        mesh = trimesh.load(str(model), force="mesh", process=False)
        mesh.apply_transform(np.linalg.inv(matrix))
        if name == "box":
            mesh.unmerge_vertices()  # flat, as it is there
        mesh.vertex_normals  # noqa: B018
        mesh.export(f"{name}-by-hand.glb")
        assert (
            gdtool(
                "render-dataset",
                f"{name}-by-hand.glb",
                *FAST,
                "--no-normalize",
                "--domains",
                "normal,depth",
                "-o",
                f"{name}-hand",
            ).returncode
            == 0
        )
        hand = read_views(open_folder(tmp_path / f"{name}-hand"))
        both = (views.mask > 0.99) & (hand.mask > 0.99)
        assert both.sum() > 0.9 * (views.mask > 0.99).sum() > 300
        np.testing.assert_allclose(views.images["depth"][both], hand.images["depth"][both], atol=2e-3)
        degrees = np.degrees(
            np.arccos(np.clip((views.images["normal"][both] * hand.images["normal"][both]).sum(-1), -1, 1))
        )
        assert np.median(degrees) < 0.5
    # Another seed, another angle; what is rendered through its cameras stands as it does.
    assert gdtool("render-dataset", box, *FAST, "--turn", "180", "--seed", "1", "-o", "other").returncode == 0
    assert (
        manifest(tmp_path / "other")["content"]["source_from_world"]
        != manifest(tmp_path / "box-turned")["content"]["source_from_world"]
    )
    assert gdtool("render-dataset", "ball.glb", *FAST, "--cameras", "ball-turned", "-o", "again").returncode == 0
    first, second_run = (read_views(open_folder(tmp_path / name)) for name in ("ball-turned", "again"))
    np.testing.assert_array_equal(first.images["normal"], second_run.images["normal"])
    assert (
        gdtool("render-dataset", "ball.glb", *FAST, "--cameras", "ball-turned", "--turn", "5", "-o", "no").returncode
        == 2
    )


def test_second_run_is_up_to_date_and_same_seed_means_same_files(gdtool, box, tmp_path):
    assert gdtool("render-dataset", box, *FAST).returncode == 0
    second_run = gdtool("render-dataset", box, *FAST)
    assert second_run.returncode == 0
    assert "up to date" in second_run.stderr
    assert gdtool("render-dataset", box, *FAST, "-o", "other").returncode == 0
    files = {p.relative_to(tmp_path / "other") for p in (tmp_path / "other").rglob("*") if p.is_file()} - {
        *map(type(box), ["manifest.json"])
    }
    assert len(files) > 40
    for file in files:
        one, two = ((tmp_path / root / file).read_bytes() for root in ("box.asset/views", "other"))
        assert hashlib.sha256(one).digest() == hashlib.sha256(two).digest(), file


def test_bad_inputs_exit_3_with_one_line(gdtool, tmp_path):
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    (tmp_path / "text.glb").write_text("not a model")
    for name in ("empty.obj", "text.glb", "missing.glb"):
        done = gdtool("render-dataset", name, *FAST)
        assert done.returncode == 3
        assert name.split(".")[0] in done.stderr
        assert "Traceback" not in done.stderr
        assert done.stdout == ""
        assert not (tmp_path / name.replace(name[-4:], ".asset") / "views").exists()


def test_pipes_stream_and_one_bad_source_among_many(gdtool, box, tmp_path):
    # Without color no light is made, and that is said.
    done = subprocess.run(
        command("-o", "data", *FAST, "--domains", "normal,depth"),
        input=f"{box}\nmissing.obj\nprocedural:3\n",
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert "missing.obj" in done.stderr
    assert done.stdout.splitlines() == ["data/box.asset/views", "data/procedural-000003.asset/views"]
    assert manifest(tmp_path / "data/procedural-000003.asset/views")["content"]["model"]
    assert (tmp_path / "data/procedural-000003.asset/views/source.glb").is_file()
    assert "light" in {s["what"] for s in manifest(tmp_path / "data/box.asset/views")["skipped"]}
    assert read_views(open_folder(tmp_path / "data/box.asset/views")).light is None
    assert gdtool("render-dataset", *FAST).returncode == 2


def test_cameras_of_other_views_are_used_with_their_frame(gdtool, box, tmp_path):
    assert gdtool("render-dataset", box, *FAST, "--rig", "turntable", "--views", "3", "--fov", "40").returncode == 0
    views = tmp_path / "box.asset" / "views"
    # The same source again: the same pixels. Its normalised copy as another file: left where it is.
    second_run = gdtool("render-dataset", box, "--cameras", views, *FAST, "-o", "again")
    assert second_run.returncode == 0, second_run.stderr
    matrix = np.array(manifest(views)["content"]["source_from_world"]).reshape(4, 4)
    lines = []
    for line in BOX.strip().splitlines():
        if line.startswith("v "):
            point = (np.array([float(x) for x in line.split()[1:]]) - matrix[:3, 3]) / matrix[0, 0]
            # 5 % smaller, as a reconstruction may be: it must not be scaled up again
            line = "v " + " ".join(f"{0.95 * x:.6f}" for x in point)
        lines.append(line)
    (tmp_path / "copy.obj").write_text("\n".join(lines))
    assert (
        gdtool(
            "render-dataset", "copy.obj", "--cameras", views, *FAST, "--domains", "normal", "-o", "copied"
        ).returncode
        == 0
    )
    first, same, copied = (read_views(open_folder(tmp_path / p)) for p in ("box.asset/views", "again", "copied"))
    assert [c.name for c in same.cameras] == ["000", "001", "002"]
    assert same.cameras[0].projection == "perspective"
    for domain in first.images:
        assert np.array_equal(first.images[domain], same.images[domain]), domain
    assert copied.mask.sum() == pytest.approx(first.mask.sum() * 0.95**2, rel=0.05)


def test_named_lights_rigs_and_filter(gdtool, box, tmp_path):
    assert gdtool("render-dataset", box, *FAST, "--light", "bright", "--rig", "sphere", "--views", "2").returncode == 0
    content = manifest(tmp_path / "box.asset/views")["content"]
    assert content["environment"] == "bright"
    assert len(content["views"]) == 2
    dropped = gdtool("render-dataset", box, *FAST, "--filter", "complete-pbr", "-o", "kept")
    assert dropped.returncode == 3
    assert "complete" in dropped.stderr
    assert not (tmp_path / "kept").exists()
    assert gdtool("render-dataset", box, *FAST, "--domains", "colour").returncode == 2
    assert gdtool("render-dataset", box, *FAST, "--light", "none.hdr").returncode == 3


def test_shards_share_the_sources_and_the_index(gdtool, box, tmp_path):
    for name in "abcde":
        (tmp_path / f"{name}.obj").write_text(BOX if name != "c" else "v 0 0 0\n")
    sources = [tmp_path / f"{name}.obj" for name in "abcde"]
    fast = (*FAST, "--domains", "normal", "-o", "data")
    first = gdtool("render-dataset", *sources, *fast, "--shard", "1/2")
    # Bad files are reported and the rest goes on.
    assert first.returncode == 1
    assert "c.obj" in first.stderr
    assert first.stdout.splitlines() == ["data/a.asset/views", "data/e.asset/views"]
    second = gdtool("render-dataset", *sources, *fast, "--shard", "2/2")
    assert second.returncode == 0
    assert second.stdout.splitlines() == ["data/b.asset/views", "data/d.asset/views"]
    listed = [one["path"] for one in manifest(tmp_path / "data")["content"]["objects"]]
    assert listed == [f"{name}.asset/views" for name in "abde"]
    for wrong in ("0/2", "3/2", "2", "a/b"):
        assert gdtool("render-dataset", *sources, *fast, "--shard", wrong).returncode == 2


def test_a_killed_run_goes_on(gdtool, box, tmp_path):
    """Killed while it renders the second of three: the first is kept, no half-written folder is left or listed."""
    for name in "abc":
        (tmp_path / f"{name}.obj").write_text(BOX)
    arguments = (*(tmp_path / f"{name}.obj" for name in "abc"), *FAST, "--domains", "normal", "-o", "data")
    process = subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout.readline() == b"data/a.asset/views\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    before = (tmp_path / "data/a.asset/views/manifest.json").read_bytes()
    second_run = gdtool("render-dataset", *arguments)
    assert second_run.returncode == 0, second_run.stderr
    assert "a.asset/views: up to date" in second_run.stderr, second_run.stderr
    assert (tmp_path / "data/a.asset/views/manifest.json").read_bytes() == before
    assert [one["path"] for one in manifest(tmp_path / "data")["content"]["objects"]] == [
        f"{name}.asset/views" for name in "abc"
    ]
    assert not list((tmp_path / "data").rglob(".*"))
    assert gdtool("validate", tmp_path / "data").returncode == 0


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_objects(monkeypatch):
    """Resident memory after twelve rounds over five objects is that after four."""
    from gdtool.core import log
    from gdtool.core.runner import Settings, run_all
    from gdtool.stages.render_dataset import STAGE, Options

    monkeypatch.setattr(log, "level", log.QUIET)
    options = Options(size=32, samples=4, domains=("normal", "albedo"))

    def rounds(count: int) -> float:
        for _ in range(count):
            results = list(
                run_all(
                    STAGE,
                    ("procedural:0..4",),
                    options,
                    {},
                    Settings(output=Path("data"), several=True, force=True, threads=2),
                )
            )
            assert [r.status for r in results] == ["done"] * 5
        with Path("/proc/self/statm").open() as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    settled = rounds(4)
    assert rounds(8) < settled + 20


def test_either_reflection_model(gdtool, box, tmp_path):
    """closed_form and color follow --brdf; unlit images do not."""
    views = {}
    for brdf in ("gltf", "paper"):
        assert (
            gdtool(
                "render-dataset",
                box,
                *FAST,
                "--light",
                "mid",
                "--brdf",
                brdf,
                "--domains",
                "color,closed_form,normal",
                "-o",
                brdf,
            ).returncode
            == 0
        )
        assert manifest(tmp_path / brdf)["options"]["brdf"] == brdf
        views[brdf] = read_views(open_folder(tmp_path / brdf))
    one, two = (views[brdf].images for brdf in ("gltf", "paper"))
    assert np.array_equal(one["normal"], two["normal"])
    for domain in ("color", "closed_form"):
        difference = np.abs(one[domain] - two[domain])[views["gltf"].mask > 0]
        assert difference.max() > 1e-3, domain
        assert difference.mean() < 0.1, domain


def test_a_missing_ray_or_cluster_is_reported(gdtool, box, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    done = gdtool("render-dataset", box, *FAST, "--ray", "local")
    assert done.returncode == 5
    assert "gdtool[ray]" in done.stderr
    assert done.stdout == ""
