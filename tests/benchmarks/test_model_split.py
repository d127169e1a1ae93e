"""Which objects of a corpus are trained on, kept for choosing designs, or dropped."""

from pathlib import Path

import numpy as np

from benchmarks.train.shapes import CELLS, best_overlaps, occupancy
from benchmarks.train.split import family, is_dev, pack_of, parts, read_split

LIST = Path(__file__).parents[2] / "benchmarks" / "train" / "split.tsv"
BOX = """v 0 0 0\nv {x} 0 0\nv {x} {y} 0\nv 0 {y} 0\nv 0 0 {z}\nv {x} 0 {z}\nv {x} {y} {z}\nv 0 {y} {z}
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 2 3 7\nf 2 7 6\nf 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8\n"""


def _box(folder, name, x, y, z):
    path = folder / f"{name}.obj"
    path.write_text(BOX.format(x=x, y=y, z=z))
    return occupancy(path)


def _cells(packed):
    return np.unpackbits(packed).reshape((CELLS,) * 3)


def test_sizes_numbers_colours_and_letters_do_not_make_a_family():
    assert (
        family("kit__pack__wall-windowB-small.glb") == family("kit__pack__wallWindow2.glb") == "kit__pack/wall window"
    )


def test_series_of_bricks_are_one_family():
    assert family("k__brick-kit__square-hq-brick-2x4.glb") == family("k__brick-kit__square-lq-brick-1x8.glb")


def test_a_name_of_a_colour_alone_keeps_it():
    assert family("q__crops__Orange-3.glb") == "q__crops/orange"


def test_another_pack_is_another_family():
    assert family("k__nature__tree.glb") != family("k__town__tree.glb")


def test_a_box_fills_its_share_of_the_cells(tmp_path):
    assert _cells(_box(tmp_path, "a", 48, 23, 11)).mean() == 1 / 8


def test_cells_follow_the_axes(tmp_path):
    cells = _cells(_box(tmp_path, "a", 48, 23, 11))
    assert [int(cells.any(tuple({0, 1, 2} - {axis})).sum()) for axis in range(3)] == [CELLS, CELLS // 2, CELLS // 4]


def test_a_sheet_without_thickness_has_cells(tmp_path):
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n")
    assert _cells(occupancy(path)).any(2).all()


def test_a_turned_and_scaled_copy_overlaps_wholly(tmp_path):
    copy = best_overlaps([_box(tmp_path, "a", 4, 2, 1)], [_box(tmp_path, "b", 10, 20, 40)])
    assert copy[0, 0] == 1


def test_another_box_overlaps_by_its_share(tmp_path):
    other = best_overlaps([_box(tmp_path, "a", 4, 4, 4)], [_box(tmp_path, "b", 48, 23, 48)])
    assert other[0, 0] == 0.5


def test_parts(tmp_path):
    cube, plank, slab = _box(tmp_path, "a", 1, 1, 1), _box(tmp_path, "b", 8, 1, 1), _box(tmp_path, "c", 8, 8, 1)
    cells = {"k__p__crate.glb": cube, "k__p__crate2.glb": slab, "k__q__dice.glb": cube, "k__q__plank.glb": plank}
    found = parts({name: name == "k__p__crate.glb" for name in cells}, cells)
    last = "dev" if is_dev("k__q/plank") else "train"
    assert list(found.values()) == ["validation", "dropped:family", "dropped:shape", last]


def test_the_list_keeps_validations_families_out_of_training():
    split = read_split(LIST)
    families = {family(name) for name, part in split.items() if part == "validation"}
    assert not [name for name, part in split.items() if part in ("train", "dev") and family(name) in families]


def test_the_list_keeps_dev_families_out_of_training():
    split = read_split(LIST)
    assert not {family(n) for n, part in split.items() if part == "dev"} & {
        family(n) for n, part in split.items() if part == "train"
    }


def test_a_pack_is_what_stands_before_the_name():
    assert pack_of("kenney__nature-kit__tree-a.glb") == "kenney__nature-kit"
