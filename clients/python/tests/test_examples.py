"""The notebook and the snippets of the documents run as they stand."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import nbclient
import nbformat
import pytest
from conftest import BINARY, ROOT, Daemon, environment

import coseg

EXAMPLES = Path(__file__).parent.parent / "examples"
NOTEBOOK = EXAMPLES / "tour.ipynb"
#: Documents whose Python is executed, top to bottom, as one program each.
DOCUMENTS = ["README.md", "clients/python/README.md", "docs/clients.md"]
#: The same without a daemon, on two animals; the peers that they name are installed for that.
PAGES = {
    "docs/python.md": "assert at_lion.shape == (lion.n_vertices, 100) and len(labels) == lion.n_faces",
    "docs/from-pyfm.md": "assert theirs.shape == ours.shape == (lion.n_vertices, 3)",
    "docs/from-lapy.md": "import numpy as np; assert np.allclose(theirs, ours, rtol=1e-6)",
    "docs/from-robust-laplacian.md": "assert np.allclose(theirs, ours, rtol=1e-4, atol=1e-8); "
    "assert np.allclose(same_matrices, theirs, rtol=1e-6, atol=1e-8)",
}


def on_path(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSEG_ENDPOINT", daemon.endpoint)
    monkeypatch.setenv("PATH", f"{Path(BINARY).resolve().parent}{os.pathsep}{os.environ['PATH']}")


def test_the_notebook_runs(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    on_path(daemon, monkeypatch)
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=120).execute()
    text = str(notebook)
    assert "int32" in text and "coseg.v1" in text
    assert all(not cell.get("outputs") for cell in nbformat.read(NOTEBOOK, as_version=4).cells)


@pytest.fixture(scope="session")
def animals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cat.off and lion.off: two quadrupeds, at least."""
    folder = tmp_path_factory.mktemp("animals")
    command = [BINARY, "synth", "animal", "--count", "2", "--faces", "3000", "--out", str(folder)]
    subprocess.run(command, check=True, capture_output=True, env=environment())
    for name, mesh in zip(("cat", "lion"), sorted(folder.glob("*.off")), strict=True):
        mesh.rename(folder / f"{name}.off")
    return folder


def test_the_notebook_without_a_daemon_runs(animals: Path) -> None:
    notebook = nbformat.read(EXAMPLES / "geometry.ipynb", as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": animals}}).execute()
    shown = [
        o for cell in notebook.cells for o in cell.get("outputs", []) if "text/html" in o.get("data", {})
    ]
    assert len(shown) == 5 and all("data:image/png" in o.data["text/html"] for o in shown)


@pytest.mark.parametrize("page", PAGES)
def test_pages_run(page: str, animals: Path, tmp_path: Path) -> None:
    for mesh in animals.glob("*.off"):
        (tmp_path / mesh.name).write_bytes(mesh.read_bytes())
    (tmp_path / "page.py").write_text(f"{snippets(page)}\n{PAGES[page]}\n")
    done = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def snippets(document: str) -> str:
    """What a document shows in blocks marked as Python, together."""
    text = (ROOT / document).read_text()
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


@pytest.mark.parametrize("document", DOCUMENTS)
def test_snippets_run(
    document: str, daemon: Daemon, meshes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_path(daemon, monkeypatch)
    code = snippets(document)
    assert "coseg" in code, f"{document} shows no Python"
    (tmp_path / "meshes").mkdir()
    for i, mesh in enumerate(meshes[:3]):
        # The README's reader has what `coseg synth` made; the others write of shapes called 101 and so on.
        name = mesh.name if document == "README.md" else f"{101 + i}.off"
        (tmp_path / "meshes" / name).write_bytes(mesh.read_bytes())
    (tmp_path / "snippet.py").write_text(code)
    done = subprocess.run([sys.executable, "snippet.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with coseg.Library(daemon.endpoint) as lib:
        assert lib.collection("chairs").info().n_shapes >= 2
