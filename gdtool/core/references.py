"""Find the files that a model file names. The readers open these, and the digest of a source covers these.

A .gltf names files within its own folder. An .obj, its .mtl and their textures may lie one folder higher, as in the
customary ../textures. No other file is opened; names.py checks each name.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from gdtool.core.errors import InputError
from gdtool.core.names import path_inside, relative_parts, uri_path
from gdtool.core.reading import require_regular_file

# Where a texture of an .mtl is looked for: beside the library, or as in Google Scanned Objects' layout, which is the
# last.
TEXTURE_PLACES = ("", "textures", "../textures", "../materials/textures")
OBJ_LEVELS_UP = 1  # folders above an .obj's own that its names may lead to

# Options of a texture statement in an .mtl and how many words follow each; -o, -s and -t take one to three numbers.
_OPTION_WORDS = {
    "-blendu": 1,
    "-blendv": 1,
    "-boost": 1,
    "-bm": 1,
    "-cc": 1,
    "-clamp": 1,
    "-imfchan": 1,
    "-mm": 2,
    "-texres": 1,
    "-type": 1,
    "-o": 3,
    "-s": 3,
    "-t": 3,
}


def obj_file(model: Path, name: str, subject: Path, what: str, folder: str = "") -> Path | None:
    """Return the path that a name in an .obj or .mtl stands for.

    model: the .obj. name: backslashes count as slashes, and of an absolute name only the last part is used. subject:
    the file that holds the name, and what: the thing that it names, both for messages. folder: the folder that the name
    is relative to, itself relative to the model's folder. Returns None for an empty name or ".", by which exporters
    mean no file. Raises InputError for a name that leads more than one folder above the model's, links followed.
    """
    plain = _without_quotes(name)
    if plain in ("", "."):
        return None
    return path_inside(model.parent, f"{folder}/{plain}".lstrip("/"), subject, what, levels_up=OBJ_LEVELS_UP)


def obj_texture(model: Path, name: str, subject: Path, what: str, folder: str = "") -> Path | None:
    """Return the path of the texture that a name in an .mtl stands for.

    model, name, subject, what, folder: as for obj_file(). The file is looked for in several folders (TEXTURE_PLACES);
    where none has it, the path in the first is returned. Raises InputError as obj_file() does, and for a FIFO, a device
    or a socket.
    """
    first = obj_file(model, name, subject, what, folder)
    if first is None:
        return None
    for texture_folder in TEXTURE_PLACES:
        relative = "/".join(part for part in (folder, texture_folder, _without_quotes(name)) if part)
        try:
            relative_parts(relative, subject, what, levels_up=OBJ_LEVELS_UP)
        except InputError:  # the name leads out of this place
            continue
        path = path_inside(model.parent, relative, subject, what, levels_up=OBJ_LEVELS_UP)
        if is_readable(path):
            return path
    return first


def obj_libraries(model: Path, line: str) -> Iterator[tuple[str, Path]]:
    """Yield the name and path of each library of an mtllib line: one name with spaces, or several names.

    Raises InputError.
    """
    try:
        whole = obj_file(model, line, model, "the material library")
    except InputError:
        if len(line.split()) < 2:
            raise
        whole = None
    for name in [line] if whole is not None and is_readable(whole) else line.split():
        path = obj_file(model, name, model, "the material library")
        if path is not None:
            yield name, path


def library_folder(name: str) -> str:
    """Return the folder of a library that an mtllib line names, relative to the model's."""
    return _without_quotes(name).rpartition("/")[0]


def map_name(words: list[str]) -> tuple[str, str | None]:
    """Return the file name of a texture statement, and the value of its option -imfchan (a channel) or None.

    Its other options are dropped.
    """
    channel, i = None, 0
    while i < len(words) and words[i] in _OPTION_WORDS:
        count = _OPTION_WORDS[words[i]]
        if words[i] == "-imfchan" and i + 1 < len(words):
            channel = words[i + 1]
        number_count = 0
        most = min(count, len(words) - 2 - i)
        while number_count < most and (count < 3 or _is_number(words[i + 1 + number_count])):
            number_count += 1
        i += 1 + number_count
    return " ".join(words[i:]), channel


def is_readable(path: Path) -> bool:
    """Tell whether path is a regular file; False for a folder and where nothing lies there.

    Raises InputError for a FIFO, a device or a socket.
    """
    if not path.is_file():
        if path.exists() and not path.is_dir():
            require_regular_file(path)
        return False
    return True


def referred_files(path: Path) -> list[Path]:
    """List the regular files that a .gltf or .obj names and that its reader would open.

    Never raises: the reader reports what is wrong.
    """
    try:
        if not path.is_file():
            return []
        if path.suffix.lower() == ".gltf":
            return list(_gltf_files(path))
        if path.suffix.lower() == ".obj":
            return _obj_files(path)
    except (OSError, ValueError, RecursionError, msgspec.MsgspecError):
        pass
    return []


class _Uri(msgspec.Struct):
    """Decode the URI of a buffer or an image of a .gltf."""

    uri: str | None = None


class _Uris(msgspec.Struct):
    """Decode the parts of a .gltf that name files."""

    buffers: list[_Uri] = []
    images: list[_Uri] = []


def _gltf_files(path: Path) -> Iterator[Path]:
    """Yield the files that the buffers and images of a .gltf name."""
    document = msgspec.json.decode(path.read_bytes().removeprefix(b"\xef\xbb\xbf"), type=_Uris)
    for item in (*document.buffers, *document.images):
        if item.uri is not None and item.uri[:5].lower() != "data:":
            try:
                named = uri_path(path.parent, item.uri, path, "the URI")
                if is_readable(named):
                    yield named
            except InputError:
                continue


def _obj_files(path: Path) -> list[Path]:
    """List the libraries of an .obj and the textures that they name."""
    libraries: dict[str, Path] = {}
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if "mtllib" in line and len(words := line.split(None, 1)) == 2 and words[0] == "mtllib":
                try:
                    libraries |= {
                        name: library for name, library in obj_libraries(path, words[1].strip()) if is_readable(library)
                    }
                except InputError:
                    continue
    out = list(libraries.values())
    for name, library in libraries.items():
        for line in library.read_text(encoding="utf-8", errors="replace").splitlines():
            words = line.split()
            if len(words) > 1 and words[0].lower().startswith(("map_", "bump", "norm")):
                try:
                    texture = obj_texture(path, map_name(words[1:])[0], library, "the texture", library_folder(name))
                    if texture is not None and is_readable(texture):
                        out.append(texture)
                except InputError:
                    continue
    return out


def _without_quotes(name: str) -> str:
    """Return a name without quotes and with forward slashes; of an absolute name only the last part."""
    plain = name.strip().strip('"').replace("\\", "/")
    return plain.rsplit("/", 1)[-1] if plain.startswith("/") or plain[1:3] == ":/" else plain


def _is_number(word: str) -> bool:
    """Tell whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
