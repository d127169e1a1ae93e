"""The benchmarks' own arithmetic, their tables and the options they use; the runs themselves are `make bench`."""

import importlib
import json
import resource
import sys
from pathlib import Path

import pytest

from benchmarks.common import measure
from benchmarks.pipeline import roundtrip
from benchmarks.pipeline import sweep as pipeline

STAND_IN = """#!{python}
import json, sys, time
if sys.argv[1] == "bad":
    sys.exit(print("gdtool: cat.png: is a dog", file=sys.stderr) or 3)
if sys.argv[1] == "late":
    time.sleep(60)
ballast = bytearray(80_000_000)
time.sleep(0.2)
print(json.dumps({{"arguments": sys.argv[1:], "kind": "asset"}}))
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    script = tmp_path / "gdtool"
    script.write_text(STAND_IN.format(python=sys.executable))
    script.chmod(0o755)
    monkeypatch.setattr(measure, "command", lambda: str(script))


def test_a_command_is_timed_and_weighed(stand_in):
    cost = measure.gdtool("remesh", "x", "--faces", "5")
    assert json.loads(cost.stdout)["arguments"] == ["remesh", "x", "--faces", "5"]
    # The kernel counts what a process was before it became the command: here all of pytest.
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    assert 0.2 <= cost.seconds < 20
    assert 80 < cost.peak_mb < 400 + own


def test_what_fails_says_why(stand_in):
    with pytest.raises(measure.Failed, match="bad exited with 3: gdtool: cat.png: is a dog"):
        measure.gdtool("bad")
    with pytest.raises(measure.Failed, match="late exited with -9 after 1 s"):
        measure.gdtool("late", limit_seconds=1)


def test_evaluate_asks_for_json(stand_in):
    assert measure.evaluate(Path("a"), "--samples", "9")["arguments"] == [
        "evaluate",
        "a",
        "--json",
        "--quiet",
        "--samples",
        "9",
    ]


def record(way, quality, seconds, distance, **more):
    stages = {
        "reconstruct": {"seconds": seconds, "peak_mb": 100.0, "surface_distance": distance},
        "whole": {"seconds": 2 * seconds, "peak_mb": 200.0, "surface_distance": distance, "albedo_psnr_masked": 25.0},
    }
    return {"way": way, "quality": quality, "source": f"procedural:{seconds}", "stages": stages, **more}


RECORDS = [
    record("model", "fast", 1.0, 0.004),
    record("model", "fast", 3.0, 0.002),
    record("model", "fast", 2.0, 0.010),
    record("model", "fine", 9.0, 0.001),
    {"way": "image", "quality": "fast", "source": "x", "stages": {}, "failed": "bake exited with 1: no"},
]


def test_summary_is_the_median_over_sources():
    rows = {(row["way"], row["quality"], row["stage"]): row for row in pipeline.summary(RECORDS)}
    assert rows["model", "fast", "reconstruct"]["seconds"] == 2.0
    assert rows["model", "fast", "whole"]["surface_distance"] == 0.004
    assert rows["model", "fast", "whole"]["sources"] == 3
    assert ("image", "fast", "whole") not in rows


def test_the_report_holds_figures_failures_and_sources():
    text = pipeline.markdown(RECORDS)
    assert "| whole | 4 | 200 | 4 | 25 |" in text
    assert "- image, fast, x: bake exited with 1: no" in text
    assert "procedural:1.0, procedural:3.0" in text


def test_the_plot_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    pipeline.plot(RECORDS, tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG"


def test_roundtrip_counts_what_passes():
    good = {"seen_distance": 0.003, "surface_distance": 0.01, "albedo_psnr_masked": 23.0, "watertight": True}
    records = [
        {"model": name, "seconds": 1.0, "peak_mb": 2.0, "asset": asset}
        for name, asset in (
            ("a", good),
            ("b", good | {"seen_distance": 0.005}),
            ("c", good | {"albedo_psnr_masked": 21.0}),
            ("d", good | {"watertight": False}),
        )
    ]
    records.append({"model": "e", "seconds": 0.0, "peak_mb": 0.0, "failed": "remesh exited with 1"})
    assert [roundtrip.passes(r) for r in records] == [True, False, False, False, False]
    assert (
        "Of 5 models: 3 within 0.004 seen and 0.015 whole, 3 closed, 3 with albedo ≥ 22 dB, 1 all of it."
        in roundtrip.report(records)
    )


def test_roundtrip_takes_models_with_metallic_roughness_textures(tmp_path):
    from gdtool.assets.gltf.write import write_glb
    from gdtool.assets.procedural import generate

    textured = next(
        scene for scene in map(generate, range(50)) if any(m.metallic_roughness_texture for m in scene.materials)
    )
    plain = next(
        scene for scene in map(generate, range(200)) if not any(m.metallic_roughness_texture for m in scene.materials)
    )
    write_glb(tmp_path / "a.glb", textured)
    write_glb(tmp_path / "b.glb", plain)
    (tmp_path / "c.glb").write_bytes(b"no model")
    assert [path.name for path in roundtrip.models_under([tmp_path], False)] == ["a.glb"]
    assert len(roundtrip.models_under([tmp_path], True)) == 3


@pytest.mark.parametrize(
    "stage",
    sorted({name for options in pipeline.QUALITIES.values() for name in options} | {s for s, _ in roundtrip.STAGES}),
)
def test_the_options_exist(stage):
    command = importlib.import_module("gdtool.commands." + stage.replace("-", "_")).command
    known = {flag for param in command.params for flag in param.opts}
    used = [options.get(stage, []) for options in pipeline.QUALITIES.values()] + [
        options for name, options in roundtrip.STAGES if name == stage
    ]
    assert {flag for options in used for flag in options if flag.startswith("--")} <= known
