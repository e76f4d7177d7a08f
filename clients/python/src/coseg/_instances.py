"""Labels of polygons become part instances, by the rule of ``coseg export``: the connected pieces of each
label, where a piece that is small beside the largest one of its label counts with the nearest that is not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Reals = NDArray[np.float64]

#: A piece with less than this share of the area of its label's largest piece is no instance of its own.
MIN_SHARE = 0.02
#: A label in more pieces than this is one instance: its mesh does not connect what belongs together.
MAX_INSTANCES = 256
#: Distances that are held at a time.
BLOCK = 1 << 22


def instance_numbers(vertices: Reals, counts: Ints, corners: Ints, labels: Ints) -> Ints:
    """(n,) the number of each polygon's part instance among those of its label, from 1.

    ``vertices`` are (v, 3), ``counts`` (n,) the corners of each polygon, ``corners`` their vertices.
    """
    piece = _pieces(vertices, counts, corners, labels)
    owner = np.repeat(np.arange(len(counts)), counts)
    area = _areas(vertices, counts, corners, owner)
    numbers = np.ones(len(counts), np.int64)
    for label in np.unique(labels):
        faces = np.flatnonzero(labels == label)
        # Pieces by their first polygons, since a piece is named after it.
        names, local = np.unique(piece[faces], return_inverse=True)
        if len(names) > MAX_INSTANCES:
            continue
        areas = np.bincount(local, area[faces])
        into = np.arange(len(names))
        small = areas < MIN_SHARE * areas.max()
        if small.any() and not small.all():
            piece_of = np.full(len(counts), -1)
            piece_of[faces] = local
            at = piece_of[owner]
            of_label = at >= 0
            into[small] = _nearest(vertices[corners[of_label]], at[of_label], small)
        # Instances in the order of their first polygons.
        joined = into[local]
        _, first, of_face = np.unique(joined, return_index=True, return_inverse=True)
        numbers[faces] = (np.argsort(np.argsort(first)) + 1)[of_face]
    return numbers


def _pieces(vertices: Reals, counts: Ints, corners: Ints, labels: Ints) -> Ints:
    """The first polygon of those that each polygon is connected to, through edges and equal labels."""
    # Adding zero makes -0 and 0 one.
    _, welded = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    ring = welded.reshape(-1)[corners]
    owner = np.repeat(np.arange(len(counts)), counts)
    ends = np.cumsum(counts)
    following = np.arange(1, len(corners) + 1)
    following[ends - 1] = ends - counts
    other = ring[following]
    keys = np.stack([np.minimum(ring, other), np.maximum(ring, other), labels[owner]])
    order = np.lexsort(keys)
    same = (np.diff(keys[:, order]) == 0).all(axis=0)
    a, b = owner[order][:-1][same], owner[order][1:][same]
    root = np.arange(len(counts))
    while True:
        low = np.minimum(root[a], root[b])
        new = root.copy()
        np.minimum.at(new, root[a], low)
        np.minimum.at(new, root[b], low)
        while not np.array_equal(new, new[new]):
            new = new[new]
        if np.array_equal(new, root):
            return root
        root = new


def _areas(vertices: Reals, counts: Ints, corners: Ints, owner: Ints) -> Reals:
    """Areas of polygons: half the lengths of their Newell normals."""
    ends = np.cumsum(counts)
    starts = ends - counts
    local = vertices[corners] - vertices[corners[starts]][owner]
    following = np.arange(1, len(corners) + 1)
    following[ends - 1] = starts
    parts = np.cross(local, local[following])
    normals = np.stack([np.bincount(owner, parts[:, i], len(counts)) for i in range(3)])
    areas: Reals = 0.5 * np.sqrt((normals**2).sum(axis=0))
    return areas


def _nearest(points: Reals, piece: Ints, small: NDArray[np.bool_]) -> Ints:
    """For each small piece the large one with the point nearest to the mean of its own points."""
    n = np.bincount(piece, minlength=len(small))
    sums = [np.bincount(piece, points[:, i], len(small)) for i in range(3)]
    centres = (np.stack(sums) / n).T[small]
    is_target = ~small[piece]
    targets, of_target = points[is_target], piece[is_target]
    found = np.empty(len(centres), np.int64)
    step = max(1, BLOCK // len(targets))
    for i in range(0, len(centres), step):
        gaps = ((centres[i : i + step, None] - targets) ** 2).sum(axis=2)
        found[i : i + step] = of_target[gaps.argmin(axis=1)]
    return found
