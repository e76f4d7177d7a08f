"""A ``.gltf`` with its buffers beside it goes out as one file, or not at all."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_sync import read_off

import coseg
from coseg._wire import FrameWriter, shape_input


def scene(vertices: np.ndarray, faces: np.ndarray, positions: str, indices: str) -> dict[str, Any]:
    """Positions and indices in buffers of their own, with another between that nothing needs."""
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "_HEAT": 2}, "indices": 1}]}],
        "images": [{"uri": "nowhere.png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3 * len(faces), "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 1, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 12 * len(vertices)},
            {"buffer": 2, "byteOffset": 4, "byteLength": 12 * len(faces)},
            {"buffer": 1, "byteLength": 4},
        ],
        "buffers": [
            {"byteLength": 12 * len(vertices), "uri": positions},
            {"byteLength": 4, "uri": "missing.bin"},
            {"byteLength": 4 + 12 * len(faces), "uri": indices},
        ],
    }


def written(folder: Path, mesh: Path, **uris: str) -> Path:
    vertices, faces = read_off(mesh)
    (folder / "data").mkdir(exist_ok=True)
    (folder / "data" / "a b.bin").write_bytes(vertices.astype("<f4").tobytes())
    (folder / "i.bin").write_bytes(bytes(4) + faces.astype("<u4").tobytes())
    names = {"positions": "data/a%20b.bin", "indices": "./i.bin", **uris}
    path = folder / "chair.gltf"
    path.write_text("\ufeff" + json.dumps(scene(vertices, faces, **names)), encoding="utf-8")
    return path


def test_it_gets_the_labels_that_its_triangles_get(
    chairs: coseg.Collection, meshes: list[Path], tmp_path: Path
) -> None:
    collection = chairs.library.collection("gltf", parts=4, up="+y")
    vertices, faces = read_off(meshes[0])
    assert collection.add("arrays", (vertices.astype(np.float32), faces)).outcome == "added"
    path = written(tmp_path, meshes[0])
    results = list(collection.add_many([path, tmp_path / "i.bin"]))
    assert [r.outcome for r in results] == ["added", "failed"]
    original = collection.original("chair")
    assert original.format == "gltf" and original.data.startswith(b"glTF")
    (length,) = struct.unpack("<I", original.data[8:12])
    assert length == len(original.data)
    # What is not needed stays as it is.
    assert b"nowhere.png" in original.data and b"missing.bin" in original.data
    assert len(collection.labels("chair")) == len(faces)
    assert (collection.labels("chair") == collection.labels("arrays")).mean() > 0.98
    collection.delete()


@pytest.mark.parametrize(
    ("uri", "part"),
    [
        ("gone.bin", "the folder of the file has no file of that name"),
        ("../secret.bin", "must be in the folder of the file"),
        ("%2e%2e/secret.bin", "must be in the folder of the file"),
        ("data/..%2F..%2Fsecret.bin", "must be in the folder of the file"),
        ("..%5Csecret.bin", "must be in the folder of the file"),
        ("/etc/hostname", "must be in the folder of the file"),
        ("", "must be in the folder of the file"),
        ("https://example.com/a.bin", "only files beside the mesh are read"),
        ("file:///etc/hostname", "only files beside the mesh are read"),
        ("link.bin", "a link that leads out of the folder"),
        ("data", "not a regular file"),
        ("short.bin", "has 3 bytes, but the buffer declares"),
    ],
)
def test_a_buffer_elsewhere_is_refused_by_its_name(
    meshes: list[Path], tmp_path: Path, uri: str, part: str
) -> None:
    (tmp_path / "secret.bin").write_bytes(bytes(1 << 20))
    folder = tmp_path / "mesh"
    folder.mkdir()
    (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
    (folder / "short.bin").write_bytes(b"123")
    path = written(folder, meshes[0], positions=uri)
    with pytest.raises(coseg.BadMesh, match="buffer 0 is in ") as caught:
        shape_input("a", path, False, FrameWriter())
    assert part in str(caught.value)


def test_what_needs_no_other_file_is_sent_as_it_is(meshes: list[Path], tmp_path: Path) -> None:
    data = "data:application/octet-stream;base64,AAAA"
    for path in [written(tmp_path, meshes[0], positions=data, indices=data), tmp_path / "bad.gltf"]:
        if not path.exists():
            path.write_bytes(b'{"meshes": 7')
        writer = FrameWriter()
        shape_input("a", path, False, writer)
        assert bytes(writer.frames[0]) == path.read_bytes()
