"""Descriptions are those of the daemon, and pictures show what they are told to."""

from __future__ import annotations

import importlib.util
import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
from conftest import BINARY, environment
from shapes import lumpy, sphere

import coseg


def test_descriptions_are_those_of_the_daemon(meshes: list[Path], tmp_path: Path) -> None:
    from safetensors.numpy import load_file

    path = meshes[0]
    out = tmp_path / "full.safetensors"
    command = [BINARY, "describe", str(path), "--full", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True, env=environment())
    theirs = load_file(out)
    mesh = coseg.read_mesh(path)
    d = mesh.describe(working_faces=10_000)
    shared = [name for name in theirs if hasattr(d, name)]
    assert {"eigenvalues", "faces"} <= set(shared)
    assert d.hks.shape == (len(d.vertices), 100) and d.face_descriptors.shape[1] == 92
    assert d.face_map.shape == d.polygon_area.shape == (mesh.n_polygons,)
    assert d.polygon_area.sum() == pytest.approx(1.0, abs=1e-4)
    assert d.report["n_polygons"] == mesh.n_polygons
    assert d.area == pytest.approx(mesh.area, rel=1e-3)


def test_descriptions_are_stored_alike(chairs: coseg.Collection, meshes: list[Path]) -> None:
    name = meshes[0].stem
    kept = chairs.spectrum(name, eigenvectors=True, resolution="proxy")
    own = coseg.read_mesh(meshes[0]).describe()
    assert np.array_equal(kept.eigenvalues, own.eigenvalues)
    assert kept.eigenvectors is not None
    assert np.array_equal(kept.eigenvectors, own.eigenvectors)
    assert np.array_equal(chairs.hks(name, resolution="proxy"), own.hks)


def test_parts_of_one_shape() -> None:
    mesh = coseg.Mesh(*lumpy(4))
    parts = mesh.segment(3)
    assert parts.shape == (mesh.n_polygons,) and set(parts) == {0, 1, 2}
    assert np.array_equal(parts, mesh.describe().segment(3))
    with pytest.raises(coseg.GeometryError, match="0 parts"):
        mesh.segment(0)


def pixels(png: bytes) -> np.ndarray:
    """Of a PNG of our own kind: one chunk of data, no filters."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", png[16:24])
    length = struct.unpack(">I", png[33:37])[0]
    assert png[37:41] == b"IDAT"
    rows = np.frombuffer(zlib.decompress(png[41 : 41 + length]), np.uint8)
    return rows.reshape(height, 1 + 3 * width)[:, 1:].reshape(height, width, 3)


def test_pictures_show_the_mesh_and_its_values(tmp_path: Path) -> None:
    mesh = sphere(3)
    shown = mesh.picture(size=(80, 60))
    seen = pixels(shown.png)
    assert seen.shape == (60, 80, 3)
    assert (seen[0, 0] == 255).all() and (seen[30, 40] < 255).any()
    # A disc of 92 % of the height.
    share = (seen < 255).any(axis=2).mean() * 4800 / (np.pi * (0.46 * 60) ** 2)
    assert share == pytest.approx(1.0, abs=0.03)
    # Left is one label and right another, by the vertices as by the faces.
    side = (mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0).astype(int)
    halves = pixels(mesh.picture(side, size=(80, 60), up="+y").png).astype(int)
    left, right = halves[30, 20], halves[30, 60]
    assert np.abs(left - right).max() > 60
    numbers = pixels(mesh.picture(mesh.vertices[:, 1], size=(80, 60)).png).astype(int)
    assert numbers[6, 40, 0] > 1.5 * numbers[54, 40, 0]  # yellow above, violet below
    with pytest.raises(coseg.GeometryError, match="values have shape"):
        mesh.picture(np.zeros(5))
    shown.save(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == shown._repr_png_()
    assert repr(mesh.plot(backend="png")) == "Picture(480 x 480)"
    with pytest.raises(coseg.GeometryError, match="backend"):
        mesh.plot(backend="paper")


def test_plots_open_a_window_where_there_can_be_one(monkeypatch: pytest.MonkeyPatch) -> None:
    window = MagicMock()
    monkeypatch.setitem(sys.modules, "polyscope", window)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: window)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    mesh = sphere(1)
    if sys.platform == "linux":
        assert repr(mesh.plot()) == "Picture(480 x 480)" and not window.show.called
    monkeypatch.setenv("DISPLAY", ":7")
    assert mesh.plot(mesh.vertices[:, 0]) is window.show.return_value
    _, kept = window.register_surface_mesh.call_args.args[1:]
    assert np.array_equal(kept, mesh.faces)


def test_notebooks_show_html() -> None:
    mesh = coseg.Mesh(*lumpy(2))
    s = mesh.spectrum(40)
    for shown in (mesh, s, coseg.functional_map(s, s), mesh.laplacian(), mesh.describe()):
        html = shown._repr_html_()
        assert html.startswith('<div><img src="data:image/png;base64,iVBOR')
        assert len(html) < 200_000
    assert json.dumps(mesh._repr_html_())
