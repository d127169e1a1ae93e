"""Handle native packages that do not load: say what to install, and never go on with a worse result."""

import sys

import numpy as np
import pytest

from gdtool.bake import lods
from gdtool.bake.reproject import Nearest
from gdtool.core import child
from gdtool.core.errors import ResourceError
from gdtool.core.native import imported, imported_if_installed
from gdtool.geometry import repair, simplify
from gdtool.geometry.distance import _fcpw_search, closest_points, winding_number
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.rays import RayCaster
from gdtool.images.cutout import both_frames
from gdtool.remesh.engines.adapters import run_instant_meshes, run_quadriflow
from gdtool.remesh.fallback import pair_and_split
from gdtool.remesh.pipeline import remesh
from gdtool.remesh.task import Request
from gdtool.unwrap.parameterize import flatten
from gdtool.unwrap.segment import charts
from tests.faults.files import quad_cube
from tests.geometry.solids import sphere

NO_LIBRARY = "libGL.so.1: cannot open shared object file: No such file or directory"
TRIANGLE = np.eye(3), np.array([[0, 1, 2]])


@pytest.fixture
def broken(tmp_path, monkeypatch):
    """Return put(module, text), which makes imports of a module raise ImportError(text), in children too."""

    def put(module, text=NO_LIBRARY):
        """Put a package in the import path that raises when it is imported."""
        package = tmp_path / "broken" / module
        package.mkdir(parents=True)
        (package / "__init__.py").write_text(f"raise ImportError({text!r})\n")
        monkeypatch.syspath_prepend(tmp_path / "broken")
        for name in [name for name in sys.modules if name.split(".")[0] == module]:
            monkeypatch.delitem(sys.modules, name)

    yield put
    child.end_waiting()  # they have read the broken package


USES = {
    "igl": [
        lambda: closest_points(np.zeros((1, 3)), TriMesh(*TRIANGLE)),
        lambda: winding_number(np.zeros((1, 3)), TriMesh(*TRIANGLE)),
        lambda: Nearest(TriMesh(*TRIANGLE)),
        lambda: repair._split_nonmanifold(TriMesh(*TRIANGLE)),
        lambda: pair_and_split.quads_from_input(TriMesh(*TRIANGLE), 16, 1.0),
        lambda: flatten._conformal(TriMesh(*TRIANGLE), np.array([0, 1, 2])),
    ],
    "fcpw": [lambda: _fcpw_search(TriMesh(*TRIANGLE))],
    "embreex": [lambda: RayCaster(TriMesh(*TRIANGLE))],
    "fast_simplification": [lambda: simplify.collapse(TriMesh(*TRIANGLE), 1, 5.0)],
    "pymeshlab": [
        lambda: simplify.collapse_keeping_topology(TriMesh(*TRIANGLE), 1),
        lambda: pair_and_split.isotropic_triangles(TriMesh(*TRIANGLE), 10, 30.0),
        lambda: lods.collapse_textured(TriMesh(*TRIANGLE), np.zeros((1, 3, 2)), 1, "."),
    ],
    "pynanoinstantmeshes": [lambda: run_instant_meshes(TriMesh(*TRIANGLE), 100, 30.0)],
    "xatlas": [lambda: charts.run_xatlas(TriMesh(*TRIANGLE), 2.0)],
    "cv2": [lambda: both_frames(np.zeros((40, 40, 3)))],
}


@pytest.mark.parametrize("module", USES)
def test_a_missing_shared_library_names_the_system_package_to_install(broken, module):
    broken(module)
    for use in USES[module]:
        with pytest.raises(
            ResourceError, match=f"^libGL.so.1: is not installed, and {module} needs it; apt install libgl1$"
        ):
            use()


def test_a_missing_library_of_unknown_package_is_named(broken):
    broken("igl", "libodd.so.7: cannot open shared object file: No such file or directory")
    with pytest.raises(
        ResourceError,
        match="^libodd.so.7: is not installed, and igl needs it; install the system package that holds libodd.so.7$",
    ):
        imported("igl")


def test_a_missing_python_package_names_the_command_to_install_it():
    with pytest.raises(ResourceError, match="^no_such_package: is not installed; pip install no_such_package$"):
        imported("no_such_package.part")
    assert imported_if_installed("no_such_package.part") is None


def test_a_package_that_fails_to_load_is_not_reported_as_missing(broken):
    broken("fcpw", "numpy.core.multiarray failed to import\nmore lines")
    with pytest.raises(
        ResourceError,
        match=r"^fcpw: cannot be loaded \(numpy.core.multiarray failed to import\); "
        r"pip install --force-reinstall fcpw$",
    ):
        imported_if_installed("fcpw")


def test_quadriflow_without_its_package_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyQuadriFlow", None)  # as where it is not installed
    with pytest.raises(ResourceError, match=r"pip install 'gdtool\[quadriflow\]'"):
        run_quadriflow(TriMesh(*TRIANGLE), 100, 30.0)


@pytest.mark.parametrize(
    "module, engine", [("pymeshlab", "split"), ("pynanoinstantmeshes", "auto"), ("fast_simplification", "auto")]
)
def test_remesh_does_not_fall_back_when_a_library_is_missing(broken, module, engine):
    broken(module)
    with pytest.raises(ResourceError, match=f"libGL.so.1: is not installed, and {module} needs it"):
        remesh(TriMesh(*sphere(24)), Request(quads=3000, engine=engine))


def test_remesh_exits_5_when_a_library_is_missing(broken, gdtool_here, tmp_path):
    broken("pymeshlab")
    quad_cube(tmp_path / "cube.obj", 20)
    done = gdtool_here("remesh", "cube.obj", "--faces", 1000, "--engine", "split", "-o", "out")
    assert done.returncode == 5, done.stderr
    assert "apt install libgl1" in done.stderr, done.stderr
    assert not (tmp_path / "out").exists()
