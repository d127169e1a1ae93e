r"""Run every command of two versions of gdtool on the same sources and compare what they write, byte by byte.

    python -m tests.tools.compare_trees BASE [--tree PATH] [--python PATH] [--assets ASSETS] \
        [--work DIR] [--only NAME ...]

BASE is a commit, or the root of a checkout; --tree the checkout to compare with it (default: this one). Both run under
this interpreter, unless --python names another for the tree: one with other versions of the dependencies. ASSETS is a
folder of real models (its mesh/ and glb/ are read); without it their cases are left out, and the last line says so.
DIR keeps the results of BASE for the next comparison. Exits with 1 when anything differs.

What may differ: how a run went (`run` and `saved_seconds` in a manifest, seconds in reports), the version of gdtool,
and sentences, as far as compare_trees.tsv says which sentence replaces which."""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SENTENCES = Path(__file__).with_suffix(".tsv")
SECONDS = 900  # for one command, on a busy machine
# Fields of a manifest or a report that tell how a run went.
TIMES = re.compile(r"seconds|minutes|finished|peak_memory|_mb$|per_second")
TIME_LINES = re.compile(r"^\| [a-z ]*(minutes|seconds) \|.*$", re.MULTILINE)  # in a model's card
# Fields that follow from others: the files themselves are compared, and a sentence in a source's manifest enters the
# digests of all that is made from it.
NOT_COMPARED = ("run", "tool_version", "stage_version", "key", "digest", "sha256")
BUNDLED_MODEL = re.compile(r"^.*gdtool/models/")  # each tree has its own


@dataclass(frozen=True)
class Case:
    """Hold a command line, and the name of the case, which its output folder and the file with its stdout have."""

    name: str
    words: tuple[str, ...]
    needs: str = ""  # a path below ASSETS
    # Two runs of one version differ: only the figures in the manifest are compared, within VARIATION.
    varies: bool = False


# Of the figures of a case that varies. Four runs of the base spread over 8 %.
VARIATION = 0.15


def cases() -> list[Case]:
    """List all commands, in an order in which each finds what it reads."""
    found: list[Case] = []

    def add(name: str, line: str, needs: str = "", varies: bool = False) -> None:
        found.append(Case(name, tuple(line.split()), needs, varies))

    # render-dataset: generated objects, a solid without materials, an open mesh, a broken one, real models
    add("views", "render-dataset procedural:3 --size 128")
    add(
        "views_turned",
        "render-dataset procedural:12 --size 96 --rig turntable --views 3 --fov 40 --elevation 20 --light mid --turn "
        "45",
    )
    add(
        "views_solid",
        "render-dataset sources/torus.obj --size 96 --domains color,normal,depth,closed_form --brdf paper",
    )
    add("views_open", "render-dataset sources/bowl.ply --size 64 --rig sphere --views 2 --no-normalize")
    add("views_broken", "render-dataset sources/broken.obj --size 64 --rig wonder3d")
    add("views_textured", "render-dataset assets/glb/BoxTextured.glb --size 96", "glb/BoxTextured.glb")
    add("views_real", "render-dataset assets/mesh/odedstein/spot/spot.obj --size 128", "mesh/odedstein/spot/spot.obj")
    add(
        "objects",
        "render-dataset procedural:20..22 --size 64 --samples 4 --condition-views 2 --domains "
        "color,normal,depth,albedo,roughness,metallic",
    )
    # import-views: a plain folder, one of Wonder3D's, NeRF's
    add("views_plain", "import-views sources/plain --format plain")
    add("views_wonder3d", "import-views sources/wonder3d")
    add("views_nerf", "import-views sources/nerf")
    # train and sample-views
    add("model", "train objects --preset tiny --steps 4 --held-out 1 --size 32 --seed 3")
    add("model_grown", "train objects --preset tiny --start model --steps 2 --held-out 1 --size 32 --seed 4")
    add("model_ablated", "train objects --preset tiny --steps 2 --held-out 1 --size 32 --ablation one_way")
    add("sampled_tiny", "sample-views sources/picture.png --model model --steps 2 --seed 1")
    add("sampled", "sample-views sources/picture.png")
    add(
        "sampled_masked",
        "sample-views sources/opaque.png --mask sources/mask.png --steps 2 --guidance 2 --scheduler dpm --no-mirror",
    )
    add(
        "sampled_cut", "sample-views sources/opaque.png --no-crop --steps 1 --precision bfloat16 --domains color,normal"
    )
    # reconstruct: whole views, disturbed ones, silhouettes alone, the paper's method
    add("surface", "reconstruct views --resolution 64")
    add("surface_sampled", "reconstruct sampled --resolution 64")
    add("surface_plain", "reconstruct views_plain --resolution 64")
    add(
        "surface_silhouette", "reconstruct views_turned --resolution 48 --ignore depth,normal,albedo,roughness,metallic"
    )
    add("surface_color", "reconstruct views --resolution 64 --ignore albedo,roughness,metallic")
    add("surface_paper", "reconstruct views --method paper --steps 40", varies=True)
    # remesh: solids, an open mesh, a broken one, a reconstructed surface, real models
    for name, options in {
        "cube.obj": "",
        "torus.obj": "--symmetry auto",
        "bowl.ply": "",
        "broken.obj": "",
        "gear.obj": "--max-deviation 0.005",
        "blob.stl": "--triangles 1500",
    }.items():
        add(f"mesh_{name.split('.')[0]}", f"remesh sources/{name} --faces 2000 {options}")
    add("mesh", "remesh surface --faces 4000")
    add("mesh_split", "remesh sources/gear.obj --faces 1500 --engine split --no-restore-creases")
    for name in ("odedstein/spot/spot.obj", "odedstein/wingnut/wingnut.obj", "trimesh/fandisk.obj"):
        add(f"mesh_real_{Path(name).stem}", f"remesh assets/mesh/{name} --faces 4000", f"mesh/{name}")
    # unwrap
    for name in ("cube", "torus", "bowl", "broken", "gear", "blob"):
        add(f"atlas_{name}", f"unwrap mesh_{name} --size 512" + (" --symmetry x" if name == "torus" else ""))
    add("atlas", "unwrap mesh --size 1024")
    add("atlas_redone", "unwrap sources/textured.obj --redo --size 512")
    add("atlas_kept", "unwrap sources/textured.obj")
    add("atlas_real_spot", "unwrap mesh_real_spot", "mesh/odedstein/spot/spot.obj")
    # bake
    add("asset", "bake atlas --size 512 --lods 3 --height --confidence")
    add("asset_cube", "bake atlas_cube --size 128 --normal-map on --normal-convention directx --bits 16")
    add("asset_torus", "bake atlas_torus --size 128 --no-ao --source-frame")
    add("asset_bowl", "bake atlas_bowl --size 128 --model sources/bowl.ply")
    add("asset_real_spot", "bake atlas_real_spot --size 512", "mesh/odedstein/spot/spot.obj")
    # relight
    add("renders", "relight asset --env bright --views 2 --size 128 --samples 16")
    add("renders_prefiltered", "relight asset --env random:4 --size 128 --light prefiltered")
    add("renders_sg", "relight asset --env dark --size 128 --light sg --brdf paper --fov 0")
    add("renders_model", "relight sources/bowl.ply --size 96 --target-psnr 30")
    add("renders_glb", "relight assets/glb/BoxTextured.glb --size 96 --samples 8", "glb/BoxTextured.glb")
    # evaluate and validate
    for name, reference in {
        "surface": "procedural:3",
        "mesh": "surface",
        "asset": "procedural:3",
        "sampled": "views",
        "mesh_gear": "sources/gear.obj",
    }.items():
        add(f"figures_of_{name}", f"evaluate {name} --reference {reference} --samples 20000 --json")
    add("checked", "validate views objects model sampled surface mesh atlas asset asset/asset.glb renders")
    add("checked_broken", "validate sources/plain sources/broken.obj")
    return found


# ---------------------------------------------------------------------------------------------------------------
# sources


def write_sources(folder: Path, site: Path) -> None:
    """Write what the cases read: meshes made here, and pictures of views that the base renders."""
    import numpy as np
    import OpenImageIO as oiio
    import trimesh

    rng = np.random.default_rng(0)
    folder.mkdir()

    def write(name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
        trimesh.Trimesh(vertices, faces, process=False).export(folder / name)

    cube = trimesh.creation.box((1, 1, 1)).subdivide().subdivide()
    write("cube.obj", cube.vertices, cube.faces)
    torus = trimesh.creation.torus(0.5, 0.2, 48, 24)
    write("torus.obj", torus.vertices, torus.faces)
    ball = trimesh.creation.icosphere(4)
    write(
        "blob.stl",
        ball.vertices * (1 + 0.2 * np.sin(4 * ball.vertices) + 0.01 * rng.standard_normal(ball.vertices.shape)),
        ball.faces,
    )
    bowl = ball.faces[ball.vertices[ball.faces][:, :, 1].max(1) < 0.3]
    colored = trimesh.Trimesh(ball.vertices, bowl, process=False)
    colored.visual.vertex_colors = (np.clip(ball.vertices * 0.5 + 0.5, 0, 1) * 255).astype(np.uint8)
    colored.export(folder / "bowl.ply")
    angle = np.linspace(0, 2 * np.pi, 97)[:-1]
    outline = np.stack([np.cos(angle), np.sin(angle)], 1) * (0.8 + 0.2 * (np.sin(12 * angle) > 0))[:, None]
    around = np.arange(96)
    rim = np.concatenate([np.insert(outline, 2, height, 1) for height in (-0.2, 0.2)] + [[[0, 0, -0.2], [0, 0, 0.2]]])
    further = (around + 1) % 96
    sides = np.concatenate(
        [np.stack([around, further, further + 96], 1), np.stack([around, further + 96, around + 96], 1)]
    )
    caps = np.concatenate(
        [np.stack([np.full(96, 192), further, around], 1), np.stack([np.full(96, 193), around + 96, further + 96], 1)]
    )
    write("gear.obj", rim, np.concatenate([sides, caps]))
    # Broken: doubled and turned faces, a hole, three faces at one edge, a loose vertex, a sliver, two solids through
    # each other.
    other = ball.vertices * 0.4 + (0.5, 0.1, 0.0)
    vertices = np.concatenate([cube.vertices, other, [[3, 3, 3], [0, 0, 2], [0, 0, 2 + 1e-9]]])
    faces = np.concatenate(
        [
            cube.faces[5:],
            cube.faces[:20][:, ::-1],
            ball.faces + len(cube.vertices),
            [[0, 1, len(vertices) - 2]],
            [[len(vertices) - 2, len(vertices) - 1, 4]],
        ]
    )
    write("broken.obj", vertices, faces)
    (folder / "textured.obj").write_text(
        "".join(f"v {x} {y} 0\n" for y in range(5) for x in range(5))
        + "".join(f"vt {x / 4} {y / 4}\n" for y in range(5) for x in range(5))
        + "".join(
            "f " + " ".join(f"{k}/{k}" for k in (i, i + 1, i + 6, i + 5)) + "\n"
            for y in range(4)
            for i in range(5 * y + 1, 5 * y + 5)
        )
    )

    shutil.copy(ROOT / "examples" / "demo.png", folder / "picture.png")
    picture = oiio.ImageBuf(str(folder / "picture.png")).get_pixels(oiio.FLOAT)
    write_picture(folder / "mask.png", picture[..., 3:])
    paper = np.concatenate([picture[..., :3] * picture[..., 3:] + 0.8 * (1 - picture[..., 3:])], -1)
    write_picture(folder / "opaque.png", paper)

    with tempfile.TemporaryDirectory() as made:
        gdtool(site, Path(made), ("render-dataset", "procedural:5", "--rig", "wonder3d", "--size", "96", "-o", "views"))
        views = Path(made, "views")
        disturbed(views, folder / "plain", rng)
        names = json.loads((views / "manifest.json").read_text())["content"]["views"]
        (folder / "wonder3d").mkdir()
        for name in names:
            color = oiio.ImageBuf(str(views / "color" / f"{name}.png")).get_pixels(oiio.FLOAT)
            write_picture(folder / "wonder3d" / f"rgb_000_{name}.png", color)
            normal = oiio.ImageBuf(str(next(views.glob(f"normal/{name}.*")))).get_pixels(oiio.FLOAT)[..., :3]
            write_picture(
                folder / "wonder3d" / f"normals_000_{name}.png",
                np.concatenate([normal * 0.5 + 0.5, color[..., 3:]], -1),
            )
        nerf(views, folder / "nerf", names)


def write_picture(path: Path, pixels) -> None:
    """Write float pixels (h, w, c) in 0..1 as PNG of 8 bits."""
    import numpy as np
    import OpenImageIO as oiio

    image = np.ascontiguousarray((np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8))
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], "uint8")
    spec["oiio:UnassociatedAlpha"] = 1
    output = oiio.ImageOutput.create(str(path))
    output.open(str(path), spec)
    output.write_image(image)
    output.close()


def disturbed(views: Path, folder: Path, rng) -> None:
    """Write a plain folder of the views' pictures and cameras, the colors with noise and each multiplied by a random
    gain.
    """
    import OpenImageIO as oiio

    folder.mkdir()
    shutil.copy(views / "cameras.json", folder)
    for domain in ("color", "albedo", "normal", "depth"):
        (folder / domain).mkdir()
        for path in sorted((views / domain).iterdir()):
            if path.suffix != ".png":
                shutil.copy(path, folder / domain)
                continue
            pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
            pixels[..., :3] = pixels[..., :3] * rng.uniform(0.95, 1.05, 3) + 0.02 * rng.standard_normal(
                pixels[..., :3].shape
            )
            write_picture(folder / domain / path.name, pixels)
    shutil.copytree(views / "mask", folder / "mask")


def nerf(views: Path, folder: Path, names: list[str]) -> None:
    """Write a folder with transforms.json; orthographic pictures stand in for perspective ones."""
    import numpy as np

    folder.mkdir()
    frames = []
    for k, name in enumerate(names):
        shutil.copy(views / "color" / f"{name}.png", folder)
        turn = np.pi / 3 * k
        pose = np.eye(4)
        pose[:3, :3] = np.stack([[np.cos(turn), np.sin(turn), 0], [0, 0, 1], [np.sin(turn), -np.cos(turn), 0]], 1)
        pose[:3, 3] = 3 * pose[:3, 2]
        frames.append({"file_path": f"{name}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.4, "frames": frames}))


# ---------------------------------------------------------------------------------------------------------------
# running


def importable(tree: Path, folder: Path) -> Path:
    """Make a folder from which Python imports the gdtool of a checkout.

    It is laid out as gdtool is installed: with commands/ and schemas/ inside.
    """
    package = folder / "gdtool"
    shutil.rmtree(folder, ignore_errors=True)
    package.mkdir(parents=True)
    for path in (*(tree / "gdtool").iterdir(), tree / "commands", tree / "schemas"):
        if path.name != "__pycache__":
            (package / path.name).symlink_to(path)
    return folder


def gdtool(
    site: Path, folder: Path, words: tuple[str, ...], python: str = sys.executable
) -> subprocess.CompletedProcess:
    """Run the gdtool that is imported from a folder, in another."""
    env = {**os.environ, "PYTHONPATH": str(site), "COLUMNS": "80"}
    return subprocess.run(
        [python, "-m", "gdtool", *words], cwd=folder, env=env, capture_output=True, text=True, timeout=SECONDS
    )


def run_all(site: Path, folder: Path, chosen: list[Case], python: str) -> None:
    """Run the cases in a folder that holds the sources; cases whose results are there already are not run again."""
    for number, case in enumerate(chosen):
        told = folder / f"{case.name}.stdout"
        if told.exists():
            continue
        words = case.words if case.words[0] in ("evaluate", "validate") else (*case.words, "-o", case.name)
        done = gdtool(site, folder, words, python)
        (folder / f"{case.name}.stderr").write_text(done.stderr)
        told.write_text(f"exit code {done.returncode}\n{done.stdout}")
        print(
            f"{folder.name} {number + 1}/{len(chosen)} {case.name}: exit code {done.returncode}",
            file=sys.stderr,
            flush=True,
        )


# -------------------------------------------------------------------------------------------------------------
# comparing


class Sentences:
    """Replace sentences by others, from a table of two columns; {} stands for the part that varies."""

    def __init__(self, path: Path):
        self._rules: list[tuple[re.Pattern[str], str]] = []
        for line in path.read_text().splitlines() if path.exists() else []:
            if line and not line.startswith("#"):
                old, new = line.split("\t")
                self._rules.append((re.compile(re.escape(old).replace(re.escape("{}"), "(.+?)")), new))
        self.used = 0

    def translated(self, text: str) -> str:
        """Return the text with every old sentence replaced by the new one."""
        for old, new in self._rules:

            def filled(match: re.Match[str], new: str = new) -> str:
                self.used += 1
                parts = iter(match.groups())
                return re.sub(r"\{\}", lambda _: next(parts), new)

            text = old.sub(filled, text)
        return text


class Comparison:
    """Collect the differences between two folders of results."""

    def __init__(self, base: Path, tree: Path, sentences: Sentences):
        self.base, self.tree, self.sentences = base, tree, sentences
        self.differences: list[str] = []

    def case(self, case: Case) -> None:
        """Compare what one case wrote."""
        name = case.name
        files = sorted(
            {path.relative_to(root) for root in (self.base, self.tree) for path in self._files(root, name)}, key=str
        )
        for relative in files:
            before, after = self.base / relative, self.tree / relative
            if case.varies and relative.name == "manifest.json" and before.exists() and after.exists():
                self._figures(
                    str(relative), *(json.loads(path.read_text())["content"]["report"] for path in (before, after))
                )
            elif case.varies and before.exists() and after.exists():
                continue
            elif not before.exists() or not after.exists():
                self.differences.append(f"{relative}: only in {'the tree' if after.exists() else 'the base'}")
            elif before.name == "manifest.json" or before.name == f"{name}.stdout":
                self._text(relative, before.read_text(), after.read_text())
            elif before.read_bytes() != after.read_bytes() and not self._same_text(before, after):
                self.differences.append(f"{relative}: {self._how_far(before, after)}")

    def _files(self, root: Path, name: str) -> Iterator[Path]:
        yield from (path for path in (root / name).rglob("*") if path.is_file())
        yield root / f"{name}.stdout"

    def _same_text(self, before: Path, after: Path) -> bool:
        """Tell whether two text files are equal but for replaced sentences and for columns or lines of times."""
        if before.suffix == ".csv":
            return _without_times(before) == _without_times(after)
        if before.suffix not in (".md", ".txt"):
            return False
        old, new = self.sentences.translated(before.read_text()), after.read_text()
        return TIME_LINES.sub("", old) == TIME_LINES.sub("", new)

    def _text(self, relative: Path, old: str, new: str) -> None:
        try:
            head_old, _, old_json = old.partition("\n") if relative.suffix == ".stdout" else ("", "", old)
            head_new, _, new_json = new.partition("\n") if relative.suffix == ".stdout" else ("", "", new)
            before, after = json.loads(old_json), json.loads(new_json)
        except ValueError:
            if self.sentences.translated(old) != new:
                self.differences.append(f"{relative}: text differs")
            return
        if head_old != head_new:
            self.differences.append(f"{relative}: {head_old} became {head_new}")
        self._fields(str(relative), self._plain(before), self._plain(after))

    def _plain(self, value):
        """Return a parsed JSON with its sentences replaced, without entries on the run and the version."""
        if isinstance(value, dict):
            return {
                key: self._plain(item)
                for key, item in value.items()
                if key not in NOT_COMPARED and not TIMES.search(key)
            }
        if isinstance(value, list):
            return [self._plain(item) for item in value]
        return (
            BUNDLED_MODEL.sub("gdtool/models/", self.sentences.translated(value)) if isinstance(value, str) else value
        )

    def _fields(self, place: str, old, new) -> None:
        if isinstance(old, dict) and isinstance(new, dict):
            for key in sorted(old.keys() | new.keys()):
                self._fields(f"{place} {key}", old.get(key), new.get(key))
        elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
            for k, pair in enumerate(zip(old, new, strict=True)):
                self._fields(f"{place}[{k}]", *pair)
        elif old != new:
            self.differences.append(f"{place}: {json.dumps(old)[:300]} became {json.dumps(new)[:300]}")

    def _figures(self, place: str, old: dict, new: dict) -> None:
        for key in sorted(old.keys() | new.keys()):
            if not TIMES.search(key) and abs(old.get(key, 0) - new.get(key, 0)) > VARIATION * abs(old.get(key, 0)):
                self.differences.append(f"{place} {key}: {old.get(key)} became {new.get(key)}")

    def _how_far(self, before: Path, after: Path) -> str:
        """Say how much two files differ: in values where they are pictures, in bytes elsewhere."""
        import numpy as np

        if before.suffix in (".png", ".exr", ".hdr"):
            import OpenImageIO as oiio

            one, other = (oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT) for path in (before, after))
            if one.shape != other.shape:
                return f"pixels {one.shape} became {other.shape}"
            apart = np.abs(one - other)
            return f"pixels differ by {apart.max():.3g} at most, {(apart > 0).mean():.2%} of them"
        one, other = (np.frombuffer(path.read_bytes(), np.uint8) for path in (before, after))
        shared = min(len(one), len(other))
        return f"{len(one)} bytes became {len(other)}, {int((one[:shared] != other[:shared]).sum())} differ"


def _without_times(path: Path) -> list[list[str]]:
    """Return the cells of a .csv file without its columns of times."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    kept = [k for k, name in enumerate(rows[0]) if not re.search("minutes|seconds", name)]
    return [[row[k] for k in kept] for row in rows]


def checkout(base: str, folder: Path) -> Path:
    """Return the root of the base: the path itself where it is a folder, else a checkout of the commit below folder."""
    if Path(base).is_dir():
        return Path(base).resolve()
    commit = subprocess.run(
        ["git", "rev-parse", base], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    root = folder / f"base-{commit[:12]}"
    if not root.exists():
        partial = root.with_suffix(".partial")
        partial.mkdir(parents=True)
        archive = subprocess.run(["git", "archive", commit], cwd=ROOT, capture_output=True, check=True).stdout
        subprocess.run(["tar", "-x"], cwd=partial, input=archive, check=True)
        partial.rename(root)
    return root


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("base")
    parser.add_argument("--tree", type=Path, default=ROOT)
    parser.add_argument("--python", default=sys.executable, help="interpreter of the tree's runs")
    parser.add_argument("--assets", type=Path)
    parser.add_argument("--work", type=Path)
    parser.add_argument(
        "--only", nargs="+", help="beginnings of names of cases to compare; what they read is run as well"
    )
    options = parser.parse_args()
    work = options.work or Path(tempfile.mkdtemp(prefix="compare-"))
    work.mkdir(parents=True, exist_ok=True)
    base = checkout(options.base, work)
    sites = importable(base, work / "base.site"), importable(options.tree.resolve(), work / "tree.site")
    before, after = work / f"{base.name}.results", work / "tree.results"
    shutil.rmtree(after, ignore_errors=True)
    chosen = [case for case in cases() if not case.needs or options.assets and (options.assets / case.needs).exists()]
    left_out = len(cases()) - len(chosen)
    if not (before / "sources").exists():
        shutil.rmtree(before, ignore_errors=True)
        before.mkdir()
        write_sources(before / "sources.partial", sites[0])
        (before / "sources.partial").rename(before / "sources")
    after.mkdir()
    shutil.copytree(before / "sources", after / "sources", symlinks=True)
    for folder in (before, after):
        if options.assets and not (folder / "assets").exists():
            copied = [case.needs for case in chosen if case.needs]
            for needed in copied:
                for path in sorted(
                    (options.assets / needed).parent.iterdir() if "mesh/" in needed else [options.assets / needed]
                ):
                    if path.is_file():
                        (folder / "assets" / needed).parent.mkdir(parents=True, exist_ok=True)
                        shutil.copy(path, (folder / "assets" / needed).parent)
    if options.only:
        chosen = _with_what_they_read(chosen, options.only)
    run_all(sites[0], before, chosen, sys.executable)
    run_all(sites[1], after, chosen, options.python)
    comparison = Comparison(before, after, Sentences(SENTENCES))
    for case in chosen:
        comparison.case(case)
    for difference in comparison.differences:
        print(difference)
    without = f"; {left_out} cases left out, which need --assets" if left_out else ""
    print(f"{len(chosen)} cases, {len(comparison.differences)} differences{without}")
    return 1 if comparison.differences else 0


def _with_what_they_read(all_cases: list[Case], beginnings: list[str]) -> list[Case]:
    """Return the cases whose names begin with one of `beginnings`, and those whose results they read, in order."""
    by_name = {case.name: case for case in all_cases}
    wanted = {name for name in by_name if name.startswith(tuple(beginnings))}
    while (
        more := {word.split("/")[0] for name in wanted for word in by_name[name].words if word.split("/")[0] in by_name}
        - wanted
    ):
        wanted |= more
    return [case for case in all_cases if case.name in wanted]


if __name__ == "__main__":
    sys.exit(main())
