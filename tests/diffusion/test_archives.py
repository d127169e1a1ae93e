"""Check training data in tar files, with plain names and in WebDataset's naming."""

import tarfile

import numpy as np
import pytest

from gdtool.core.errors import InputError
from gdtool.diffusion.data.archives import object_count, split_member_name, unpack_views
from gdtool.folders.views import read_views
from tests.stages.dataset import write_spheres


def pack(spheres, archive, webdataset):
    with tarfile.open(archive, "w") as tar:
        for folder in sorted(spheres.glob("*.asset/views")):
            for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                relative = path.relative_to(folder).as_posix()
                key = folder.parent.stem
                tar.add(
                    path,
                    f"train/{key}.{relative.replace('/', '.')}"
                    if webdataset
                    else f"{folder.parent.name}/views/{relative}",
                )


@pytest.mark.parametrize("webdataset", [False, True])
def test_an_archive_gives_the_folders_it_was_made_of(tmp_path, webdataset):
    spheres = write_spheres(tmp_path / "spheres", size=16)
    pack(spheres, tmp_path / "a.tar", webdataset)
    (tmp_path / "work").mkdir()
    assert object_count(tmp_path / "a.tar") == 3
    for folder, original in zip(
        unpack_views(tmp_path / "a.tar", tmp_path / "work"), sorted(spheres.glob("*.asset/views")), strict=True
    ):
        from gdtool.core.folder import open_folder

        a, b = read_views(folder), read_views(open_folder(original))
        assert all(np.array_equal(a.images[d], b.images[d]) for d in b.images)
        assert len(b.images) == 6
        assert len(list((tmp_path / "work").glob("*/*"))) == 1  # one object at a time is on the disk
    assert not list((tmp_path / "work").iterdir())


def test_training_on_an_archive_is_training_on_its_folders(gdtool, tmp_path):
    spheres = write_spheres(tmp_path / "spheres", size=16)
    pack(spheres, tmp_path / "a.tar", True)
    (tmp_path / "c.json").write_text(
        '{"model": {"channels": [8, 16], "head_width": 8, "encoder_width": 16, "image_size": 16}}'
    )
    line = ("--preset", "tiny", "--config", "c.json", "--steps", 2, "--held-out", 0, "--threads", 1)
    for source, name in (("spheres", "x"), ("a.tar", "y")):
        result = gdtool("train", source, *line, "-o", name)
        assert result.returncode == 0, result.stderr
    assert (tmp_path / "x/model.safetensors").read_bytes() == (tmp_path / "y/model.safetensors").read_bytes()


def test_member_names_of_both_kinds_are_split():
    assert split_member_name("a.asset/views/manifest.json") == ("a.asset/views", "manifest.json")
    assert split_member_name("a.asset/views/color/front.png") == ("a.asset/views", "color/front.png")
    assert split_member_name("d/000.color.front.png") == ("d/000", "color/front.png")
    assert split_member_name("d/000.manifest.json") == ("d/000", "manifest.json")


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "x.tar").write_bytes(b"no tar at all" * 100)
    with pytest.raises(InputError, match="not a whole tar"):
        object_count(tmp_path / "x.tar")
    with tarfile.open(tmp_path / "e.tar", "w"):
        pass
    with pytest.raises(InputError, match="no views folder"):
        object_count(tmp_path / "e.tar")
