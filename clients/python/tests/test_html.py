"""What notebooks show of the daemon's answers."""

from __future__ import annotations

import base64
import re
import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import coseg
from coseg import types as t


def pixels(html: str) -> NDArray[np.uint8]:
    """The picture (height, width, 3) in HTML."""
    found = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert found, html[:200]
    png = base64.b64decode(found[1])
    width, height = struct.unpack(">II", png[16:24])
    start = png.index(b"IDAT")
    (length,) = struct.unpack(">I", png[start - 4 : start])
    rows = np.frombuffer(zlib.decompress(png[start + 4 : start + 4 + length]), np.uint8)
    return rows.reshape(height, 1 + 3 * width)[:, 1:].reshape(height, width, 3)


def fmap(c_12: NDArray[np.float32], name: str = "a") -> t.FunctionalMap:
    quality = t.MapQuality(0.0, 0.0, 1.0, 0.0, expected_error=0.125)
    return t.FunctionalMap(name, "b", c_12, np.zeros(7, np.uint32), quality, np.ones(7, bool))


def test_a_map_is_a_picture_of_its_magnitudes() -> None:
    html = fmap(np.diag([1, -1, 0.5]).astype(np.float32))._repr_html_()
    assert "a -&gt; b: c_12 (3, 3), 7 points, expected error 0.125" in html
    found = pixels(html)
    dark, light = found[30, 30].astype(int), found[30, 100].astype(int)
    assert found.shape == (200, 200, 3) and (light == 255).all() and (dark == [8, 48, 107]).all()
    assert (found[100, 100] == dark).all() and dark[0] < found[170, 170][0] < 255


def test_a_spectrum_is_its_curve() -> None:
    values = np.array([0.0, 1, 2, 4])
    html = t.Spectrum(values, None, None, 1.0)._repr_html_()
    assert "4 eigenvalues, 0 to 4" in html
    columns = (pixels(html)[:, :, 0] < 255).sum(axis=0)
    assert columns[0] == 1 and columns[-1] == 100 and 45 < columns[125] < 55


def test_names_of_others_are_no_markup(chairs: coseg.Collection) -> None:
    assert "&lt;b&gt;" in fmap(np.eye(2, dtype=np.float32), "<b>")._repr_html_()
    label = t.Label(1, "<script>", 0xFF8000, None, 3, 0.5, False)
    info = chairs.info()
    shown = t.CollectionInfo(**{**vars(info), "labels": (label,)})._repr_html_()
    assert "&lt;script&gt;" in shown and "<script" not in shown and "#ff8000" in shown


def test_answers_of_the_daemon(chairs: coseg.Collection, meshes: list[Path]) -> None:
    a, b = meshes[0].stem, meshes[1].stem
    info, shape = chairs.info(), chairs.shape(a)
    table = info._repr_html_()
    assert all(f"<td>{label.id}</td>" in table for label in info.labels if label.merged_into is None)
    assert f"{info.n_shapes} shapes" in table
    assert shape._repr_html_().count("<tr>") == 1 + min(len(shape.parts), 13)
    labelling = chairs.labelling(a)
    counts = dict(zip(*np.unique(labelling.labels, return_counts=True), strict=True))
    html = labelling._repr_html_()
    assert all(f"<td>{label}</td>" in html and f" {n}</td>" in html for label, n in counts.items())
    shown = pixels(chairs.descriptors(a)._repr_html_())
    assert shown.shape == (200, 200, 3) and 0.1 < (shown.min(axis=2) < 250).mean() < 0.9
    assert pixels(chairs.spectrum(a)._repr_html_()).shape == (100, 200, 3)
    assert pixels(chairs.map(a, b)._repr_html_()).shape == (200, 200, 3)
