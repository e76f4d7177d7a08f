"""Meshes of polygons with any number of corners, given as counts and vertices of their corners."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coseg.types import Encoded

Ints = NDArray[np.int64]


def as_off(vertices: NDArray[Any], counts: Ints, corners: Ints) -> Encoded:
    """Object File Format text of a mesh: ``counts`` (n,) of corners, ``corners`` their vertices."""
    lines = ["OFF", f"{len(vertices)} {len(counts)} 0"]
    lines += [" ".join(map(repr, row)) for row in vertices.tolist()]
    rings = np.split(corners, np.cumsum(counts)[:-1])
    lines += [" ".join(map(str, [len(ring), *ring.tolist()])) for ring in rings]
    return Encoded("off", ("\n".join(lines) + "\n").encode())


def backwards(counts: Ints, corners: Ints) -> Ints:
    """The corners with each polygon in the other sense, for meshes that a transform has mirrored."""
    ends = np.cumsum(counts)
    offsets = np.arange(len(corners)) - np.repeat(ends - counts, counts)
    turned: Ints = corners[np.repeat(ends - 1, counts) - offsets]
    return turned
