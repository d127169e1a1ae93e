"""Coarser levels of detail keep the texture coordinates of the full mesh."""

from dataclasses import replace

from gdtool.bake import lods
from gdtool.bake.lods import coarser, drift, make_levels
from gdtool.bake.target import Target, size_for
from gdtool.geometry.meshes import TriMesh
from tests.bake.shapes import torus, triangles_of, unwrapped


def target():
    vertices, quads, _ = torus(60, 30)
    faces = triangles_of(quads)
    return Target.of(TriMesh(vertices, faces), *unwrapped(vertices, faces, 256))


def test_a_level_has_the_requested_triangles_and_keeps_its_texels():
    full = target()
    same = drift(full, full)
    assert same["drift_p99"] < 2e-3
    assert same["outside"] == 0
    level, why = coarser(full, len(full.mesh.faces) // 2)
    assert why == ""
    assert abs(len(level.mesh.faces) - len(full.mesh.faces) // 2) <= 2
    # At most a quarter of a triangle's edge; hardly any of the surface reads another chart.
    drifted = drift(level, full)
    assert drifted["drift_mean"] < 0.008
    assert drifted["outside"] < 0.01
    # No chart is mirrored: that would invert its normal map.
    u, v = (level.uv[level.face_uvs[:, k]] - level.uv[level.face_uvs[:, 0]] for k in (1, 2))
    whole_u, whole_v = (full.uv[full.face_uvs[:, k]] - full.uv[full.face_uvs[:, 0]] for k in (1, 2))
    turned, whole = (
        u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0,
        whole_u[:, 0] * whole_v[:, 1] - whole_u[:, 1] * whole_v[:, 0] > 0,
    )
    assert abs(turned.mean() - whole.mean()) < 0.05


def test_size_is_the_power_of_two_that_holds_the_detail():
    full = target()
    width = 1.0 / 512 * _span(full)
    assert size_for(full, width) == 512
    assert size_for(full, width * 1.05) == size_for(full, width / 1.05) == 512  # up to a tenth coarser is fine enough
    assert size_for(full, width / 1.5) == 1024
    assert size_for(full, width * 1000) == 256
    assert size_for(full, width / 1000) == 4096


def _span(full):
    from gdtool.bake.target import texel_width

    return texel_width(full, 1)


def test_a_level_that_drifts_on_its_maps_is_left_out(monkeypatch):
    full = target()
    # A level whose texture corners belong to the opposite side.
    half, _ = coarser(full, len(full.mesh.faces) // 2)
    wrong = replace(half, mesh=TriMesh(half.mesh.vertices * (-1, 1, 1), half.mesh.faces))
    monkeypatch.setattr(
        lods, "coarser", lambda target, n: (wrong, "") if n == len(full.mesh.faces) // 2 else (half, "")
    )
    made = make_levels(full, 3)
    assert made.targets == [half]
    assert made.report["lod1_triangles"] == len(half.mesh.faces)
    assert made.report["lod1_drift_mean"] < 8e-3
    assert len(made.skipped) == 1
    assert "would drift" in made.skipped[0][1]


def test_a_level_with_too_many_triangles_is_kept_if_coarser_than_the_last(monkeypatch):
    full = target()
    count = len(full.mesh.faces)
    levels = {
        count // 2: coarser(full, count // 2)[0],
        count // 4: coarser(full, int(0.4 * count))[0],
        count // 8: coarser(full, int(0.38 * count))[0],
    }
    monkeypatch.setattr(lods, "coarser", lambda target, n: (levels[n], ""))
    made = make_levels(full, 4)
    assert made.targets == [levels[count // 2], levels[count // 4]]
    assert len(made.warnings) == 1
    assert "fewer would tear a seam" in made.warnings[0]
    assert len(made.skipped) == 1
    assert f"fewer than {len(levels[count // 8].mesh.faces)} triangles" in made.skipped[0][1]
