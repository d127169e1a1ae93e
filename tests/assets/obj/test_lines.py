"""Parse OBJ files: lines of a kind parsed together give the arrays of lines parsed one by one."""

from pathlib import Path

import numpy as np
import pytest

from gdtool.assets.obj import lines as obj_lines

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
FULL = SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\n"


def same(a: obj_lines.ObjLines, b: obj_lines.ObjLines) -> bool:
    """Tell whether two results are equal, types included."""
    arrays = ("vertices", "colors", "uvs", "normals", "corners", "sizes", "groups")
    return all(
        np.array_equal(getattr(a, name), getattr(b, name)) and getattr(a, name).dtype == getattr(b, name).dtype
        for name in arrays
    ) and (a.names, a.libraries) == (b.names, b.libraries)


@pytest.mark.parametrize(
    "text",
    [
        SQUARE + "f 1 2 3 4\nf 1 2 3\n",
        SQUARE.replace("\n", "\r\n") + "f 1 2 3\r\n",
        SQUARE + "f -4 -3 -2\nv 2 2 2\nf -1 1 2",
        FULL + "f 1/1/1 2/2/1 3/3/1\nf 1/-1/-1 2/-2/-1 3/-3/-1 4/1/1\n",
        FULL + "f 1/1 2/2 3/3\n",
        FULL + "f 1//1 2//1 3//1\n",
        "# by hand\no one\n"
        + SQUARE
        + "g a b\ns off\nmtllib a b.mtl\nusemtl red paint\nf 1 2 3\n\nusemtl blue\n\n"
        + "l 1 2\nf 2 3 4\nusemtl red paint\nf 1 2 4\n",
        "v 1e-3 -2.5E+4 +.5 1 0 0.25\nv 1 2 3\t0 0 1\nv 4 5 6 1 1 1 \nf 1 2 3\n",
        "v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 1\nvt 0 0 0\nf 1/1 2/1 3/1\n",
        "v 0.1 0.12345678901234567 1e-320\nv nan 0 0\nv inf 0 -0\nf 1 2 3\n",
        SQUARE + "f 1 2 3 4 1 2\n",
    ],
)
def test_uniform_lines_parsed_together_equal_lines_parsed_one_by_one(text):
    together = obj_lines.parse_uniform(text.encode())
    singly = obj_lines.parse_each(text, Path("x.obj"))
    nan = np.isnan(singly.vertices)
    assert together is not None
    assert np.array_equal(np.isnan(together.vertices), nan)
    for lines in (together, singly):
        lines.vertices[nan] = 0  # NaN is not equal to itself
    assert same(together, singly)
    assert np.array_equal(np.signbit(together.vertices), np.signbit(singly.vertices))


@pytest.mark.parametrize(
    "text",
    [
        SQUARE + "f 1 2 \\\n3\n",
        SQUARE + " f 1 2 3\n",
        SQUARE + "f\t1 2 3\n",
        SQUARE.replace("\n", "\r") + "f 1 2 3\r",
        "v 0 0 0 1 1 1\n" + SQUARE + "f 1 2 3\n",
        FULL + "vt 0.5\nf 1/1 2/2 3/4\n",
        FULL + "f 1/1 2 3/3\n",
        FULL + "f 1/1/ 2//1 3//1\n",
        FULL + "f 1/ 2/ 3/\n",
        SQUARE + "v 1_0 0 0\nf 1 2 3\n",
    ],
)
def test_lines_of_different_form_are_parsed_one_by_one(text, tmp_path):
    assert obj_lines.parse_uniform(text.encode()) is None
    (tmp_path / "x.obj").write_bytes(text.encode())
    assert same(obj_lines.read_lines(tmp_path / "x.obj"), obj_lines.parse_each(text, tmp_path / "x.obj"))


@pytest.mark.parametrize(
    "text",
    [
        "v 0 0\n",
        "v 0 0 x\n",
        SQUARE + "f 1 2\n",
        SQUARE + "f 0 1 2\n",
        SQUARE + "f -9 1 2\n",
        SQUARE + "f 1.5 2 3\n",
        "v\n",
        SQUARE + "f /1 2 3\n",
        "mtllib\n" + SQUARE,
        "vt\n",
        "f\n",
        SQUARE + "f 99999999999999999999 1 2\n",
    ],
)
def test_malformed_lines_are_left_to_the_parser_that_names_them(text):
    assert obj_lines.parse_uniform(text.encode()) is None


def test_both_parsers_agree_on_random_files():
    rng = np.random.default_rng(5)
    uniform = 0
    for _ in range(200):
        points = rng.integers(3, 9)
        lines = [
            " ".join(["v", *(f"{x:.{rng.integers(1, 17)}g}" for x in rng.normal(0, 10.0 ** rng.integers(-9, 9), 3))])
            for _ in range(points)
        ]
        form = rng.choice(["{0}", "{0}/{1}", "{0}//{1}", "{0}/{1}/{1}"])
        lines += ["vt 0.25 0.75", "vn 0 1 0"] * 2
        lines += [
            "f "
            + " ".join(
                form.format(rng.choice([-1, 1]) * rng.integers(1, points + 1), rng.choice([-2, -1, 1, 2]))
                for _ in range(rng.integers(3, 6))
            )
            for _ in range(rng.integers(1, 6))
        ]
        lines[-1:-1] = ["usemtl m" + str(rng.integers(3))]
        if rng.random() < 0.2:
            lines.insert(
                int(rng.integers(len(lines))),
                str(rng.choice(["", "# c", " ", "v 1 2", "f 1 2", "f 1 2 3", "vn 1 0 0 "])),
            )
        text = "\n".join(lines)
        together = obj_lines.parse_uniform(text.encode())
        if together is not None:
            uniform += 1
            assert same(together, obj_lines.parse_each(text, Path("x.obj"))), text
    assert uniform > 100  # most files are uniform
