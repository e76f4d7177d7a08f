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
from conftest import BINARY, ROOT, Daemon

import coseg

NOTEBOOK = Path(__file__).parent.parent / "examples" / "tour.ipynb"
#: Documents whose Python is executed, top to bottom, as one program each.
DOCUMENTS = ["README.md", "clients/python/README.md", "docs/clients.md"]


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
