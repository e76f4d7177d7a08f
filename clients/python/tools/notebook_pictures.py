"""Runs examples/geometry.ipynb and writes its pictures into docs/images, as docs/python.md shows them.

``python tools/notebook_pictures.py COSEG`` makes the meshes with that binary; needs nbclient and
ipykernel.
"""

import base64
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbclient
import nbformat

HERE = Path(__file__).resolve().parent
NOTEBOOK = HERE.parent / "examples" / "geometry.ipynb"
IMAGES = HERE.parents[2] / "docs" / "images"
#: The cells with a picture for the page, by id, and what the files are called.
PICTURES = {
    "c5": "python-hks.png",
    "c13": "python-geodesics.png",
    "c16": "python-description.png",
    "c7": "python-map.png",
}


def animals(binary: str, folder: Path) -> None:
    """Writes cat.off and lion.off: two quadrupeds, at least."""
    command = [binary, "synth", "animal", "--count", "2", "--faces", "3000", "--out", str(folder)]
    subprocess.run(command, check=True, capture_output=True)
    for name, mesh in zip(("cat", "lion"), sorted(folder.glob("*.off")), strict=True):
        mesh.rename(folder / f"{name}.off")


def picture(cell: Any) -> bytes:
    """The PNG of the first picture that a cell shows."""
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        if "image/png" in data:
            return base64.b64decode(data["image/png"])
        if found := re.search(r"base64,([^\"]+)", data.get("text/html", "")):
            return base64.b64decode(found[1])
    raise SystemExit(f"cell {cell['id']} shows no picture")


def main() -> None:
    """Writes the pictures."""
    with tempfile.TemporaryDirectory() as folder:
        animals(str(Path(sys.argv[1]).resolve()), Path(folder))
        notebook = nbformat.read(NOTEBOOK, as_version=4)
        nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}}).execute()
    for cell in notebook.cells:
        if name := PICTURES.get(cell["id"]):
            (IMAGES / name).write_bytes(picture(cell))
            print(f"docs/images/{name}")


if __name__ == "__main__":
    main()
