"""Views folders in .tar files, read one object at a time: training data that travels as a few large files.

Two namings: plain, as `tar cf shard-0.tar cat.asset/views dog.asset/views` makes it; and WebDataset's, where the files
of an object share a key and stand together: KEY.manifest.json, KEY.color.front.png for color/front.png, and so on.
"""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder, open_folder

MANIFEST = "manifest.json"


def placed(member: str) -> tuple[str, str]:
    """A member's object and its path inside the object's views folder."""
    path = PurePosixPath(member)
    key, _, extension = path.name.partition(".")
    if "." in extension:  # WebDataset: KEY.manifest.json, KEY.color.front.png
        return str(path.with_name(key)), "/".join(extension.split(".")[:-1]) + path.suffix
    # plain: pictures lie one folder deeper than the manifest, whose neighbours are known
    root = path.parent if path.suffix not in (".png", ".exr") or path.stem == "contact_sheet" else path.parent.parent
    return str(root), str(path.relative_to(root))


def object_count(archive: Path) -> int:
    """How many views folders a .tar holds; reads its headers only. Raises InputError."""
    try:
        with tarfile.open(archive) as tar:
            count = sum(placed(member.name)[1] == MANIFEST for member in tar if member.isfile())
    except (tarfile.TarError, EOFError, OSError) as error:
        raise InputError(archive, f"is not a whole tar file ({error})") from None
    if not count:
        raise InputError(archive, "holds no views folder", "pack what render-dataset writes")
    return count


def views_of(archive: Path, workspace: Path) -> Iterator[Folder]:
    """The views folders of a .tar in their order, each unpacked under workspace and removed again.

    An object's members must stand together, as tar and WebDataset write them. Raises InputError.
    """
    with tarfile.open(archive) as tar:
        root = Path(tempfile.mkdtemp(dir=workspace, prefix="unpacked-"))
        try:
            current = None
            for member in tar:
                if not member.isfile():
                    continue
                name, relative = placed(member.name)
                if name != current:
                    if current is not None:
                        yield _opened(archive, root, current)
                    shutil.rmtree(root)
                    root.mkdir()
                    current = name
                if ".." in PurePosixPath(relative).parts or PurePosixPath(relative).is_absolute():
                    raise InputError(archive, f"holds {member.name}, which points outside")
                target = root / _safe(name) / "views" / relative
                target.parent.mkdir(parents=True, exist_ok=True)
                with tar.extractfile(member) as source, open(target, "wb") as out:
                    shutil.copyfileobj(source, out)
            if current is not None:
                yield _opened(archive, root, current)
        finally:
            shutil.rmtree(root, ignore_errors=True)


def _safe(name: str) -> str:
    return name.replace("/", "_").replace("..", "_")


def _opened(archive: Path, root: Path, name: str) -> Folder:
    folder = root / _safe(name) / "views"
    if not (folder / MANIFEST).is_file():
        raise InputError(archive, f"has {name} in pieces, or without its manifest", "pack each views folder as one")
    return open_folder(folder, ("views",), "train", check=False)
