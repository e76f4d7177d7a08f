"""A ``.gltf`` with buffers in files beside it becomes one binary file (GLB).

A buffer is followed only within the folder of the file, by a relative path, and only if positions or
indices are in it. Textures and whatever else the file names stay where they are.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote_to_bytes

from coseg.errors import BadMesh

#: Extensions of views that name buffers themselves.
_COMPRESSIONS = ("EXT_meshopt_compression", "KHR_meshopt_compression")


def read_mesh(path: Path) -> bytes:
    """What is sent for the file at ``path``. Raises :class:`BadMesh` or :class:`OSError`."""
    data = path.read_bytes()
    if path.suffix.lower() not in (".gltf", ".glb") or data.startswith(b"glTF"):
        return data
    try:
        root = json.loads(data.decode("utf-8-sig"))
        needed = _needed(root)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        # The daemon says what is wrong with it.
        return data
    buffers = root.get("buffers", [])
    uris = {i: buffers[i]["uri"] for i in needed if "uri" in buffers[i]}
    external = {i: uri for i, uri in uris.items() if uri[:5].lower() != "data:"}
    return _pack(root, external, path) if external else data


def _needed(root: dict[str, Any]) -> set[int]:
    """The buffers that positions and indices are in."""

    def views() -> Iterator[int]:
        for mesh in root.get("meshes", []):
            for primitive in mesh.get("primitives", []):
                of = (primitive.get("attributes", {}).get("POSITION"), primitive.get("indices"))
                for accessor in (root["accessors"][i] for i in of if i is not None):
                    sparse = accessor.get("sparse", {})
                    for part in (accessor, sparse.get("indices", {}), sparse.get("values", {})):
                        if "bufferView" in part:
                            yield part["bufferView"]

    def holder(view: dict[str, Any]) -> dict[str, Any]:
        extensions: dict[str, Any] = view.get("extensions", {})
        return next((extensions[name] for name in _COMPRESSIONS if name in extensions), view)

    return {holder(root["bufferViews"][i])["buffer"] for i in views()}


def _pack(root: dict[str, Any], external: dict[int, str], path: Path) -> bytes:
    binary = bytearray()
    rest: list[dict[str, Any]] = [{}]
    # For each buffer its new index, and where it begins there.
    moved: list[tuple[int, int]] = []
    for index, buffer in enumerate(root["buffers"]):
        if index in external:
            moved.append((0, len(binary)))
            binary += _file(index, buffer, external[index], path)
            binary += bytes(-len(binary) % 4)
        else:
            moved.append((len(rest), 0))
            rest.append(buffer)
    rest[0] = {"byteLength": len(binary)}
    root["buffers"] = rest
    for view in root["bufferViews"]:
        extensions = view.get("extensions", {})
        for part in (view, *(extensions[name] for name in _COMPRESSIONS if name in extensions)):
            part["buffer"], begin = moved[part["buffer"]]
            if begin:
                part["byteOffset"] = part.get("byteOffset", 0) + begin
    text = json.dumps(root, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    if length >= 1 << 32:
        raise BadMesh(f"{path}: with its buffers it is larger than the 4 GiB that a GLB can have")
    header = struct.pack("<4sIII4s", b"glTF", 2, length, len(text), b"JSON")
    return header + text + struct.pack("<I4s", len(binary), b"BIN\0") + bytes(binary)


def _file(index: int, buffer: dict[str, Any], uri: str, mesh: Path) -> bytes:
    """The bytes of a buffer in a file beside the mesh."""

    def fault(why: str) -> BadMesh:
        return BadMesh(f'{mesh}: buffer {index} is in "{uri}", {why}')

    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", uri):
        raise fault("and only files beside the mesh are read: download it")
    try:
        decoded = unquote_to_bytes(uri).decode()
    except UnicodeDecodeError:
        raise fault("which is not valid UTF-8") from None
    relative = PurePosixPath(decoded)
    outside = relative.is_absolute() or ".." in relative.parts or re.search(r"[\\\0]", decoded)
    if not decoded or outside:
        raise fault("but must be in the folder of the file, by a relative path")
    whole = mesh.parent / relative
    try:
        real, folder = whole.resolve(strict=True), mesh.parent.resolve(strict=True)
        if not real.is_relative_to(folder):
            raise fault("which is a link that leads out of the folder of the file")
        if not real.is_file():
            raise fault("which is not a regular file")
        length = int(buffer["byteLength"])
        with real.open("rb") as file:
            data = file.read(length)
    except FileNotFoundError:
        raise fault("but the folder of the file has no file of that name") from None
    except (OSError, RuntimeError) as e:
        raise fault(f"which cannot be read: {e}") from None
    if len(data) < length:
        raise fault(f"which has {len(data)} bytes, but the buffer declares {length}")
    return data
