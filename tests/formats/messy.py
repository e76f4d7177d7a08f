"""Adds every messy file to a real daemon and writes what became of each as a table.

    python3 tests/formats/messy.py COSEG FOLDER [OUT]

FOLDER has meshes as they are found in the wild, in any number of folders; OUT is the document (default: stdout). A second
table has files that were spoilt here, one for each way, with what the daemon says. Fails where a file is neither
labelled nor refused with a reason, or where a spoilt one is labelled. Needs nothing but Python.
"""

from __future__ import annotations

import json
import os
import re
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: Counts of a report, and how a modeller would say them.
SAID = {
    "n_welded_vertices": "vertices at one place welded: {}",
    "n_isolated_vertices": "vertices that no face uses: {}",
    "n_degenerate_triangles": "triangles without area: {}",
    "n_duplicate_triangles": "triangles there twice: {}",
    "n_flipped_triangles": "triangles turned over: {}",
    "n_nonmanifold_edges": "edges with more than two faces: {}",
    "n_boundary_edges": "border edges: {}",
    "n_concave_polygons": "concave polygons: {}",
    "n_nonplanar_polygons": "polygons that are not planar: {}",
    "n_nonsimple_polygons": "polygons that cross themselves or have no area: {}",
    "n_tolerated_statements": "statements that programs differ about: {}",
    "n_unread_statements": "other statements, not read: {}",
    "n_inner_walls": "inner walls left to those around them: {}",
}
CUBE_OFF = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"


def spoilt() -> dict[str, tuple[str, bytes]]:
    """Name and bytes of spoilt files, by what was done to them."""
    gltf = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "chair.bin", "byteLength": 36}],
    }
    draco = gltf | {"extensionsRequired": ["KHR_draco_mesh_compression"], "buffers": [{"byteLength": 36}]}
    stl = bytes(80) + struct.pack("<I", 2) + bytes(50)
    ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    ply += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 zero\n3 0 1 2\n"
    return {
        "a face names a missing vertex": ("a.off", CUBE_OFF.replace("3 1 2 3", "3 1 2 9").encode()),
        "a coordinate is not a number": ("b.off", CUBE_OFF.replace("1 0 0", "nan 0 0").encode()),
        "truncated in the middle": ("c.off", CUBE_OFF[:45].encode()),
        "no faces": ("d.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
        "all vertices on a line": ("e.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
        "a vertex is missing a coordinate": ("f.obj", b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n"),
        "a binary STL that is shorter than its header declares": ("g.stl", stl),
        "a word among the numbers of a PLY": ("h.ply", ply.encode()),
        "a glTF with its buffer in another file": ("i.gltf", json.dumps(gltf).encode()),
        "a glTF that requires Draco": ("j.gltf", json.dumps(draco).encode()),
        "a glTF node names a missing mesh": (
            "m.gltf",
            json.dumps(gltf | {"nodes": [{"mesh": 17}]}).encode(),
        ),
        "another format than the name of the file says": ("k.glb", CUBE_OFF.encode()),
        "an empty file": ("l.ply", b""),
    }


class Daemon:
    """A daemon on a temporary library."""

    def __init__(self, coseg: str, folder: Path) -> None:
        self.coseg, self.folder = coseg, folder
        own = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")}
        self.env = own | {"COSEG_ENDPOINT": f"ipc://{folder}/s", "NO_COLOR": "1"}
        command = [coseg, "serve", "--library", str(folder / "library")]
        self.process = subprocess.Popen(command, env=self.env, stderr=subprocess.DEVNULL)
        for _ in range(200):
            if subprocess.run([coseg, "stats"], env=self.env, capture_output=True, check=False).returncode == 0:
                return
            time.sleep(0.1)
        raise SystemExit("the daemon does not start")

    def run(self, *arguments: str) -> dict[str, object]:
        done = subprocess.run(
            [self.coseg, *arguments, "--json", "--timeout", "60"], env=self.env, capture_output=True, text=True, check=False
        )
        answer = done.stdout.strip().splitlines()
        return json.loads(answer[-1]) if answer else {"error": {"message": done.stderr.strip()}}

    def add(self, path: Path, name: str) -> dict[str, object]:
        """What became of one file."""
        link = self.folder / f"{name}{path.suffix.lower()}"
        link.write_bytes(path.read_bytes())
        found = self.run("add", str(link), "--collection", "all", "--parts", "4")
        link.unlink()
        shapes = found.get("shapes")
        return shapes[0] if isinstance(shapes, list) and shapes else found


def main() -> int:
    coseg, folder = str(Path(sys.argv[1]).resolve()), Path(sys.argv[2])
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".obj", ".off", ".ply", ".stl", ".glb", ".gltf"))
    faults, rows, refused = [], [], []
    with tempfile.TemporaryDirectory(prefix="messy") as work:
        daemon = Daemon(coseg, Path(work))
        try:
            for i, path in enumerate(paths):
                name = f"m{i:03}"
                became = daemon.add(path, name)
                where = str(path.relative_to(folder))
                if became.get("outcome") in ("added", "unchanged"):
                    shape = daemon.run("show", name, "--collection", "all")
                    labels = daemon.run("labels", name, "--collection", "all")["labels"]
                    report = shape["report"]
                    assert isinstance(report, dict) and isinstance(labels, list)
                    if len(labels) != shape["n_polygons"] or min(labels) < 0:
                        faults.append(f"{where}: {len(labels)} labels for {shape['n_polygons']} faces, least {min(labels)}")
                    said = [text.format(f"{report[key]:,}") for key, text in SAID.items() if report[key]]
                    if report["n_components"] > 1:
                        said.insert(0, f"{report['n_components']} pieces, joined by {report['n_bridges']} virtual edges")
                    rows.append((where, f"{shape['n_polygons']:,}", "labelled", "; ".join(said) or "clean"))
                else:
                    why = reason(became)
                    rows.append((where, "", "refused", why))
                    if not why:
                        faults.append(f"{where}: refused without a reason: {became}")
            for i, (what, (name, data)) in enumerate(spoilt().items()):
                path = Path(work) / name
                path.write_bytes(data)
                became = daemon.add(path, f"s{i:03}")
                why = reason(became)
                refused.append((what, Path(name).suffix.removeprefix("."), why))
                if became.get("outcome") in ("added", "unchanged") or not why:
                    faults.append(f"{what}: {became}")
        finally:
            daemon.process.terminate()
            daemon.process.wait()
    lines = [
        "# Messy files, one by one",
        "",
        "`python3 tests/formats/messy.py target/release/coseg FOLDER docs/messy.md` generates this page.",
        "FOLDER has unmodified files from the test models of four libraries. [formats](formats.md) lists the",
        "supported formats, the repairs and the reasons for refusal in general.",
        "",
        "| file | faces | outcome | report of cleaning |",
        "| --- | --- | --- | --- |",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
        "The following files were damaged on purpose, and each is refused with this message:",
        "",
        "| damage | format | message |",
        "| --- | --- | --- |",
        *(f"| {' | '.join(row)} |" for row in refused),
    ]
    text = "\n".join(lines) + "\n"
    if len(sys.argv) > 3:
        Path(sys.argv[3]).write_text(text)
    else:
        print(text)
    n = sum(row[2] == "labelled" for row in rows)
    print(f"{n} of {len(rows)} files labelled, {len(rows) - n} refused; {len(refused)} spoilt ones refused", file=sys.stderr)
    for fault in faults:
        print(f"FAIL {fault}", file=sys.stderr)
    return 1 if faults else 0


def reason(became: dict[str, object]) -> str:
    """What the daemon says of a shape that it refuses."""
    error = became.get("error")
    message = error.get("message", "") if isinstance(error, dict) else ""
    # The name of the file, without the folder that is another in each run.
    message = re.sub(r"^\S*/", "", str(message))
    return message.replace("|", "\\|").replace("\n", " ")


if __name__ == "__main__":
    sys.exit(main())
