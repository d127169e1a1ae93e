"""Read views folders from .tar files, one object at a time: training data that travels as a few large files.

Members may be named in two ways. Plain names are those that `tar cf shard-0.tar cat.asset/views dog.asset/views`
writes. In WebDataset's naming the files of an object share a key and follow each other: KEY.manifest.json,
KEY.color.front.png for color/front.png, and so on.
"""

from __future__ import annotations

import lzma
import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from gdtool.core.errors import InputError, ResourceError, from_os_error
from gdtool.core.folder import Folder, open_folder
from gdtool.core.names import CURE, name_fault, path_inside, quoted, relative_parts
from gdtool.core.reading import require_regular_file

MANIFEST = "manifest.json"

MAX_MEMBERS = 1 << 24  # of an archive: some 300,000 objects of 50 files
MAX_OBJECT_MEMBERS = 20_000  # of one views folder: 1000 views of seven pictures each fit twice
MAX_OBJECT_BYTES = 16 << 30  # unpacked, of one views folder: what lies on the disk at a time
# Of a compressed archive, unpacked over packed: PNG and EXR are packed already, and padding with zeros gives some 20
# for the smallest pictures.
MAX_RATIO = 200
MIN_JUDGED_BYTES = 64 << 20  # unpacked; smaller archives may have any ratio
MAX_HEADER_BYTES = 1 << 20  # of an extended header (long names, PAX records), which is read whole

_PACK = "pack it again with tar, plain or compressed"
_EXTENDED = (
    tarfile.GNUTYPE_LONGNAME,
    tarfile.GNUTYPE_LONGLINK,
    tarfile.XHDTYPE,
    tarfile.XGLTYPE,
    tarfile.SOLARIS_XHDTYPE,
)
_BLOCK = 1 << 20  # bytes copied at a time


def split_member_name(member: str) -> tuple[str, str]:
    """Split a member's name into the name of its object and the path inside that object's views folder."""
    path = PurePosixPath(member)
    key, _, extension = path.name.partition(".")
    if "." in extension:  # WebDataset: KEY.manifest.json, KEY.color.front.png
        return str(path.with_name(key)), "/".join(extension.split(".")[:-1]) + path.suffix
    # plain: pictures are one folder deeper than the manifest, except for the contact sheet
    root = path.parent if path.suffix not in (".png", ".exr") or path.stem == "contact_sheet" else path.parent.parent
    return str(root), str(path.relative_to(root))


def object_count(archive: Path) -> int:
    """Count the views folders in a .tar by reading its headers.

    Raises InputError unless it is a whole tar whose names stay inside the folder that it is unpacked to. Raises
    ResourceError for more than MAX_MEMBERS members, or for an archive that would unpack to more than MAX_RATIO times
    its size.
    """
    with _open_tar(archive) as tar:
        count = sum(split_member_name(member.name)[1] == MANIFEST for member in _members(archive, tar))
    if not count:
        raise InputError(archive, "holds no views folder", "pack what render-dataset writes")
    return count


def unpack_views(archive: Path, workspace: Path) -> Iterator[Folder]:
    """Unpack the views folders of a .tar under workspace, one after another; each is removed before the next.

    An object's members must follow each other, as tar and WebDataset write them. Each header is checked before its
    content is unpacked. Raises InputError and ResourceError as object_count(), and OutputError where workspace cannot
    be written.
    """
    root = Path(tempfile.mkdtemp(dir=workspace, prefix="unpacked-"))
    try:
        with _open_tar(archive) as tar:
            current = None
            for member in _members(archive, tar):
                name, relative = split_member_name(member.name)
                if name != current:
                    if current is not None:
                        yield _open_object(archive, root, current)
                    shutil.rmtree(root)
                    root.mkdir()
                    current, count, size = name, 0, 0
                count, size = count + 1, size + member.size
                if count > MAX_OBJECT_MEMBERS or size > MAX_OBJECT_BYTES:
                    raise ResourceError(
                        archive,
                        f"would unpack more than {MAX_OBJECT_MEMBERS:,} files or {MAX_OBJECT_BYTES >> 30} GiB "
                        f"for {quoted(name)}",
                        "render fewer or smaller views of one object",
                    )
                target = path_inside(
                    _object_folder(root, name, archive), relative, archive, "member", byte_escapes=True
                )
                _unpack(archive, tar, member, target)
            if current is not None:
                yield _open_object(archive, root, current)
    finally:
        shutil.rmtree(root, ignore_errors=True)


class _LongHeader(Exception):
    """Report an extended header that claims more than MAX_HEADER_BYTES.

    It does not derive from tarfile's errors: on those, tarfile goes on and tries another format.
    """


class _BoundedHeader(tarfile.TarInfo):
    """Parse the headers of a tar, and refuse extended ones of more than MAX_HEADER_BYTES."""

    def _proc_member(self, tar: tarfile.TarFile):
        """Raise _LongHeader for a large extended header, else process it."""
        if self.type in _EXTENDED and self.size > MAX_HEADER_BYTES:
            raise _LongHeader(f"has an extended header of {self.size} bytes, more than {MAX_HEADER_BYTES}")
        return super()._proc_member(tar)


@contextmanager
def _open_tar(archive: Path) -> Iterator[tarfile.TarFile]:
    """Open a tar for reading. Raises InputError where it is none."""
    require_regular_file(archive)
    try:
        file = archive.open("rb")
    except OSError as error:
        raise from_os_error(error, archive) from None
    with file:
        with _as_input_error(archive):
            tar = tarfile.open(fileobj=file, tarinfo=_BoundedHeader)  # noqa: SIM115 - closed by `with tar` below
        with tar:
            yield tar


@contextmanager
def _as_input_error(archive: Path) -> Iterator[None]:
    """Convert the errors of tarfile and of the decompressors, for bytes that are no tar, to InputError."""
    try:
        yield
    except _LongHeader as error:
        raise InputError(archive, str(error), _PACK) from None
    except (
        tarfile.TarError,
        EOFError,
        OSError,
        zlib.error,
        lzma.LZMAError,
        RecursionError,
        ValueError,
        OverflowError,
    ) as error:
        fact = " ".join(str(error).split())[:80] or type(error).__name__
        if "could not be opened successfully" in fact:  # tarfile goes on with each format's reason
            fact = "it is in no format that tarfile knows"
        raise InputError(archive, f"is not a whole tar file ({fact})", _PACK) from None


def _members(archive: Path, tar: tarfile.TarFile) -> Iterator[tarfile.TarInfo]:
    """Yield the regular files of an archive. Each header's name, kind and sizes are checked first."""
    packed, count, size = max(archive.stat().st_size, 1), 0, 0
    while True:
        with _as_input_error(archive):
            member = tar.next()
        if member is None:
            return
        tar.members.clear()  # tarfile keeps each header otherwise
        if member.issparse():
            raise InputError(
                archive, f"holds the sparse file {quoted(member.name)}", "pack it again without sparse files"
            )
        count, size = count + 1, size + member.size + tarfile.BLOCKSIZE
        if count > MAX_MEMBERS:
            raise ResourceError(archive, f"holds more than {MAX_MEMBERS:,} members", "split it into several archives")
        if size > MIN_JUDGED_BYTES and size > MAX_RATIO * packed:
            raise ResourceError(
                archive,
                f"would unpack to more than {size / 2**30:.1f} GiB, {size // packed} times its own size",
                "pack it uncompressed",
            )
        if not member.isfile():
            continue
        relative_parts(member.name, archive, "member", byte_escapes=True)
        yield member


def _unpack(archive: Path, tar: tarfile.TarFile, member: tarfile.TarInfo, target: Path) -> None:
    """Copy a member's bytes to target.

    Raises InputError for a truncated archive, OutputError where target cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        out = target.open("wb")
    except OSError as error:
        if isinstance(error, (FileExistsError, NotADirectoryError, IsADirectoryError)):
            raise InputError(archive, f"holds {quoted(member.name)} both as a file and as a folder", _PACK) from None
        raise from_os_error(error, target) from None
    with out:
        with _as_input_error(archive):
            source: BinaryIO = tar.extractfile(member)
        left = member.size
        while left:
            with _as_input_error(archive):
                block = source.read(min(left, _BLOCK))
            if not block:
                raise InputError(archive, f"is not a whole tar file (it ends within {quoted(member.name)})", _PACK)
            try:
                out.write(block)
            except OSError as error:
                raise from_os_error(error, target) from None
            left -= len(block)


def _object_folder(root: Path, name: str, archive: Path) -> Path:
    """Return the folder under root that an object is unpacked into. Its parent is named after the object."""
    safe = archive.stem if name == "." else name.replace("/", "_").replace("..", "_")
    fault = name_fault(safe, byte_escapes=True)
    if fault:
        raise InputError(archive, f"object {quoted(name)} {fault}", CURE)
    return root / safe / "views"


def _open_object(archive: Path, root: Path, name: str) -> Folder:
    """Open an unpacked views folder. Raises InputError where its manifest is missing."""
    folder = _object_folder(root, name, archive)
    if not (folder / MANIFEST).is_file():
        raise InputError(
            archive, f"has {quoted(name)} in pieces, or without its manifest", "pack each views folder as one"
        )
    return open_folder(folder, ("views",), "train", check=False)
