"""Flat charts are cut for packing: first where rectangles save most area, and past small parts along a rough rim."""

import numpy as np

from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import triangulated
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.segment.charts import Adjacency
from gdtool.unwrap.segment.straight_cuts import cut_to_pack


def plates(*cells):
    """Make plates of unit cells, one above the other, from masks (h, w); return their adjacency and flat charts."""
    points, quads, charts, vertices, faces = [], [], [], 0, 0
    for height, mask in enumerate(cells):
        h, w = mask.shape
        x, y = np.meshgrid(np.arange(w + 1.0), np.arange(h + 1.0))
        row, column = np.nonzero(mask)
        corner = row * (w + 1) + column
        corners = np.stack([corner, corner + 1, corner + w + 2, corner + w + 1], -1)
        uv = np.stack([x.ravel(), y.ravel()], -1)
        used, local = np.unique(corners, return_inverse=True)
        local = local.reshape(-1, 4)
        charts.append(Chart(faces + np.arange(len(corners)), local, uv[used], triangulated(local)[0]))
        points.append(np.concatenate([uv, np.full((len(uv), 1), float(height))], 1))
        quads.append(corners + vertices)
        vertices, faces = vertices + len(uv), faces + len(corners)
    return Adjacency(QuadMesh(np.concatenate(points), np.concatenate(quads))), charts


def ell(size, arm):
    """Make the mask of an L in a square of `size` cells, with arms `arm` cells wide."""
    mask = np.zeros((size, size), bool)
    mask[:arm], mask[:, :arm] = True, True
    return mask


def test_the_chart_whose_rectangle_is_emptiest_is_cut_first():
    adjacency, charts = plates(ell(10, 4), ell(30, 6), np.ones((12, 12), bool))
    first = next(cut_to_pack(adjacency, charts, [4]))
    sizes = sorted(len(chart[0]) for chart in first)
    assert len(first) == 4
    assert {ell(10, 4).sum(), 144} <= set(sizes)
    parts = [chart for chart in first if len(chart[0]) not in (ell(10, 4).sum(), 144)]
    # The two arms of the large L: they fill their rectangles.
    assert all(np.prod(np.ptp(chart[2], 0)) < 1.2 * len(chart[0]) for chart in parts)


def test_small_parts_along_a_rough_rim_do_not_prevent_a_cut():
    """An L whose inner rims are combs: a line along them cuts off each tooth."""
    mask = ell(40, 8)
    mask[8, 9::2], mask[9::2, 8] = True, True
    adjacency, (chart,) = plates(mask)
    (parts,) = cut_to_pack(adjacency, [chart], [2])
    assert len(parts) == 2
    assert min(len(part[0]) for part in parts) > 0.3 * mask.sum()
    assert sorted(np.concatenate([part[0] for part in parts])) == list(range(mask.sum()))
