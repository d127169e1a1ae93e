"""Publish a dataset of analytic spheres by the runner, as render-dataset would."""

from __future__ import annotations

from pathlib import Path

import msgspec

from gdtool.core.runner import Settings, run_all
from gdtool.core.stage import Stage
from gdtool.folders.views import write_views
from tests.diffusion.spheres import sphere_views


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    size: int = 32
    domains: tuple[str, ...] = ("color", "normal", "depth", "albedo", "roughness", "metallic")


def run(inputs, options, out):
    write_views(out, sphere_views(int(inputs.main.split(":")[1]), options.size, options.domains))


SPHERES = Stage(
    name="render-dataset", version=1, reads=("model-file",), writes="views", Options=Options, run=run, dataset=True
)


def write_spheres(root: Path, count: int = 3, **options) -> Path:
    """Write root/procedural-*.asset/views of count spheres, and the index root/manifest.json."""
    results = list(
        run_all(SPHERES, (f"procedural:0..{count - 1}",), Options(**options), {}, Settings(output=root, several=True))
    )
    assert len(results) == count
    assert all(result.status == "done" for result in results)
    return root
