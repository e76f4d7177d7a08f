"""What a notebook shows of the daemon's answers: a small picture or a table, and a line of text."""

from __future__ import annotations

import html as escaping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coseg._pixels import NOTHING, PALETTE, Picture, ramp

if TYPE_CHECKING:
    from coseg import types as t

#: Pixels of a side.
SIDE = 200
#: Rows of a table; more are counted.
ROWS = 12


def _line(text: str) -> str:
    return f"<code>{escaping.escape(text)}</code>"


def _table(head: list[str], rows: list[list[str]]) -> str:
    """Cells are HTML."""
    shown = rows[:ROWS]
    if len(rows) > ROWS:
        shown = [*shown, [f"… {len(rows) - ROWS} more", *[""] * (len(head) - 1)]]
    cells = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in row) + "</tr>" for row in shown)
    names = "".join(f"<th>{escaping.escape(name)}</th>" for name in head)
    return f"<table><thead><tr>{names}</tr></thead><tbody>{cells}</tbody></table>"


def _swatch(rgb: int) -> str:
    return f'<span style="background:#{rgb:06x};display:inline-block;width:1em;height:1em"></span>'


def _bar(share: float) -> str:
    width = max(1, round(100 * share))
    return f'<span style="background:#0072b2;display:inline-block;width:{width}px;height:0.8em"></span>'


def collection(info: t.CollectionInfo) -> str:
    """Its labels in their colours."""
    used = [label for label in info.labels if label.merged_into is None]
    rows = [
        [_swatch(label.colour_rgb), str(label.id), escaping.escape(label.name), str(label.n_shapes)]
        for label in used
    ]
    text = f"{info.name}: {info.n_shapes} shapes, {len(used)} labels, {info.n_stale} stale"
    return f"<div>{_table(['', 'label', 'name', 'shapes'], rows)}{_line(text)}</div>"


def shape(shape: t.Shape) -> str:
    """Its parts."""
    rows = [
        [str(p.label), f"{_bar(p.area_share)} {p.area_share:.1%}", f"{p.confidence:.2f}"] for p in shape.parts
    ]
    text = f"{shape.name}: {shape.n_polygons} faces, version {shape.version}, {shape.review.state}"
    return f"<div>{_table(['label', 'share of the area', 'confidence'], rows)}{_line(text)}</div>"


def labelling(labelling: t.Labelling) -> str:
    """How many faces each label has."""
    labels, counts = np.unique(labelling.labels, return_counts=True)
    n = max(1, len(labelling.labels))
    rows = [
        [str(label), f"{_bar(count / n)} {count}"]
        for label, count in zip(labels.tolist(), counts.tolist(), strict=True)
    ]
    text = f"labels of {len(labelling.labels)} faces, version {labelling.version}"
    return f"<div>{_table(['label', 'faces'], rows)}{_line(text)}</div>"


def spectrum(spectrum: t.Spectrum) -> str:
    """Its eigenvalues, from left to right."""
    values = spectrum.eigenvalues
    pixels = np.full((SIDE // 2, SIDE, 3), 255, np.uint8)
    if len(values):
        at = np.minimum(np.arange(SIDE) * len(values) // SIDE, len(values) - 1)
        heights = np.round(values[at] / max(float(values[-1]), 1e-300) * (SIDE // 2 - 1)).astype(int)
        rows = SIDE // 2 - 1 - np.arange(SIDE // 2)
        pixels[rows[:, None] <= heights[None, :]] = PALETTE[0]
    vectors = spectrum.eigenvectors
    rest = "" if vectors is None else f", eigenvectors {vectors.shape}"
    low, high = (values[0], values[-1]) if len(values) else (0.0, 0.0)
    return Picture(pixels).html(f"{len(values)} eigenvalues, {low:.4g} to {high:.4g}{rest}")


def functional_map(fmap: t.FunctionalMap) -> str:
    """The magnitudes of c_12, from white (0) to dark."""
    size = np.abs(fmap.c_12.astype(np.float64))
    rows, columns = (np.arange(SIDE) * n // SIDE for n in size.shape)
    share = np.minimum(size[rows][:, columns], 1.0)[:, :, None]
    pixels = np.round(255 * (1 - share) + np.array([8, 48, 107]) * share).astype(np.uint8)
    error = fmap.quality.expected_error
    expected = "" if error is None else f", expected error {error:.3f}"
    k2, k1 = size.shape
    text = f"{fmap.source} -> {fmap.target}: c_12 ({k2}, {k1}), {len(fmap.p2p_21)} points{expected}"
    return Picture(pixels).html(text)


def descriptors(found: t.Descriptors) -> str:
    """The working mesh with its patches; without the native module their sizes."""
    n_patches = int(found.patches.max()) + 1 if len(found.patches) else 0
    text = f"{len(found.faces)} faces, {found.face_descriptors.shape[1]} descriptors, {n_patches} patches"
    try:
        from coseg.geometry import Mesh
    except ImportError:
        counts = np.bincount(found.patches) if n_patches else np.zeros(1, np.int64)
        return _sizes(counts).html(text)
    mesh = Mesh(found.vertices.astype(np.float64), found.faces)
    return mesh.picture(found.patches.astype(np.int32), size=(SIDE, SIDE)).html(text)


def _sizes(counts: NDArray[np.int64]) -> Picture:
    at = np.minimum(np.arange(SIDE) * len(counts) // SIDE, len(counts) - 1)
    colours = ramp(counts[at].astype(np.float64)) if counts.any() else np.full((SIDE, 3), NOTHING)
    return Picture(np.broadcast_to(colours, (20, SIDE, 3)).round().astype(np.uint8))
