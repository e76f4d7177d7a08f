"""Shapes that are known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import coseg


def icosphere(rounds: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A unit sphere of 20 · 4^rounds triangles."""
    g = (1 + 5**0.5) / 2
    corners: list[tuple[float, float, float]] = [
        (-1, g, 0),
        (1, g, 0),
        (-1, -g, 0),
        (1, -g, 0),
        (0, -1, g),
        (0, 1, g),
    ]
    corners += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    vertices = [np.array(c, dtype=float) for c in corners]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4)]
    faces += [(11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8)]
    faces += [(3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    for _ in range(rounds):
        middles: dict[tuple[int, int], int] = {}

        def middle(a: int, b: int, of: dict[tuple[int, int], int] = middles) -> int:
            key = (min(a, b), max(a, b))
            if key not in of:
                of[key] = len(vertices)
                vertices.append((vertices[a] + vertices[b]) / 2)
            return of[key]

        finer = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = finer
    points = np.array(vertices)
    return points / np.linalg.norm(points, axis=1)[:, None], np.array(faces)


def lumpy(rounds: int = 3, stretch: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A sphere with three lumps: it has no symmetry."""
    vertices, faces = icosphere(rounds)
    lumps = [((0.0, 0.0, 1.0), 0.8), ((1.0, 0.0, 0.2), 0.5), ((-0.9, 0.3, 0.0), 0.4)]
    grown = np.ones(len(vertices))
    for place, height in lumps:
        grown += height * np.exp(-6 * ((vertices - place) ** 2).sum(axis=1))
    vertices = vertices * grown[:, None]
    vertices[:, 2] *= stretch
    return vertices, faces


def renumbered(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], seed: int = 1
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """The same mesh with its vertices in another order, and for each new vertex its old one."""
    old = np.random.default_rng(seed).permutation(len(vertices))
    new = np.empty_like(old)
    new[old] = np.arange(len(old))
    return vertices[old], new[faces], old


def sphere(rounds: int = 3) -> coseg.Mesh:
    """A unit sphere."""
    return coseg.Mesh(*icosphere(rounds))
