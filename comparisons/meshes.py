"""Synthetic meshes for benchmarks: arrays of vertices (n, 3) and faces (m, 3), and OFF files.

Three surfaces, each at about as many vertices as are asked for, the same in every run:

bumpy   a subdivided icosphere with bumps: regular connectivity, good triangles
hull    the hull of random directions with the same bumps: irregular connectivity, thin triangles
man     an implicit body with limbs, by surface nets: what scans and modelling tools give
"""

import numpy as np


def icosphere(frequency):
    """Unit icosphere whose edges are divided `frequency` times: 10 f^2 + 2 vertices."""
    golden = (1 + 5**0.5) / 2
    corners = np.array(
        [[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]]
        + [[0, -1, golden], [0, 1, golden], [0, -1, -golden], [0, 1, -golden]]
        + [[golden, 0, -1], [golden, 0, 1], [-golden, 0, -1], [-golden, 0, 1]]
    )
    triangles = np.array(
        [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4]]
        + [[11, 10, 2], [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8]]
        + [[3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]
    )
    grid = [(i, j) for i in range(frequency + 1) for j in range(frequency + 1 - i)]
    index = {ij: at for at, ij in enumerate(grid)}
    small = []
    for i, j in grid:
        if i + j < frequency:
            small.append([index[i, j], index[i + 1, j], index[i, j + 1]])
        if i + j < frequency - 1:
            small.append([index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]])
    weights = np.array([[frequency - i - j, i, j] for i, j in grid]) / frequency
    points = np.einsum("gc,tcx->tgx", weights, corners[triangles]).reshape(-1, 3)
    points /= np.linalg.norm(points, axis=1)[:, None]
    faces = (np.array(small)[None] + len(grid) * np.arange(20)[:, None, None]).reshape(-1, 3)
    # Points on the edges of the icosahedron were made by each of its triangles.
    _, first, same = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[first], same.ravel()[faces]


def bumps(directions, seed=3, height=0.35):
    """Moves points of the unit sphere along their directions, and stretches the whole."""
    rng = np.random.default_rng(seed)
    wave = sum(
        np.cos(directions @ (2.2 * rng.normal(size=3)) + rng.uniform(0, 2 * np.pi)) for _ in range(24)
    )
    return directions * (1 + height * np.tanh(wave / 24**0.5))[:, None] * [1, 0.7, 1.6]


def bumpy(n_vertices):
    points, faces = icosphere(max(1, round(((n_vertices - 2) / 10) ** 0.5)))
    return bumps(points), faces


def hull(n_vertices):
    from scipy.spatial import ConvexHull

    points = np.random.default_rng(1).normal(size=(n_vertices, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    faces = ConvexHull(points).simplices
    a, b, c = points[faces].swapaxes(0, 1)
    inward = (np.cross(b - a, c - a) * (a + b + c)).sum(1) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return bumps(points), faces


# From, to, radius: trunk, head, legs, arms, neck.
BONES = [
    ((0, 0, -0.05), (0, 0, 0.5), 0.19),
    ((0, 0, 0.7), (0, 0.02, 0.85), 0.13),
    ((-0.12, 0, -0.05), (-0.22, 0.03, -0.95), 0.085),
    ((0.12, 0, -0.05), (0.26, -0.03, -0.95), 0.085),
    ((0.15, 0, 0.5), (0.85, 0.08, 0.62), 0.065),
    ((-0.15, 0, 0.5), (-0.8, -0.06, 0.2), 0.065),
    ((0, 0, 0.5), (0, 0, 0.75), 0.08),
]
LOW, HIGH = np.array([-1.05, -0.4, -1.15]), np.array([1.05, 0.4, 1.15])


def man(n_vertices):
    # The number of vertices grows with the square of the resolution: one trial tells the factor.
    trial = 40
    found = len(surface_nets(trial)[0])
    return surface_nets(round(trial * (n_vertices / found) ** 0.5))


def surface_nets(cells):
    """The body where the smooth minimum of distances to its bones is 0, with `cells` cells a unit.

    A vertex for each cell that the surface crosses, at the mean of the crossings of its edges; a
    quadrangle, cut in two, around each edge of the grid that it crosses (Gibson 1998).
    """
    shape = np.ceil((HIGH - LOW) * cells).astype(int) + 1
    x, y, z = (LOW[i] + np.arange(shape[i]) / cells for i in range(3))
    field = np.zeros(shape)
    for start, end, radius in BONES:
        a, d = np.array(start, float), np.subtract(end, start).astype(float)
        to = [x[:, None, None] - a[0], y[None, :, None] - a[1], z[None, None, :] - a[2]]
        along = np.clip(sum(t * s for t, s in zip(to, d)) / (d @ d), 0, 1)
        square = sum((t - along * s) ** 2 for t, s in zip(to, d))
        field += np.exp(-25 * (np.sqrt(square) - radius))
    field = -np.log(field + 1e-300) / 25

    inside = field < 0
    sums = np.zeros((*(shape - 1), 3))
    counts = np.zeros(shape - 1, int)
    crossings = []
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        ends = tuple(slice(0, s - t) for s, t in zip(shape, step))
        others = tuple(slice(t, s) for s, t in zip(shape, step))
        at = np.argwhere(inside[ends] != inside[others])
        f0, f1 = field[tuple(at.T)], field[tuple((at + step).T)]
        point = LOW + (at + np.outer(f0 / (f0 - f1), step)) / cells
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        around = [at - u - v, at - v, at, at - u]
        for cell in around:
            np.add.at(sums, tuple(cell.T), point)
            np.add.at(counts, tuple(cell.T), 1)
        crossings.append((around, f0 < 0))
    used = counts > 0
    index = np.cumsum(used).reshape(used.shape) - 1
    faces = []
    for around, outward in crossings:
        a, b, c, d = (index[tuple(cell.T)] for cell in around)
        b, d = np.where(outward, b, d), np.where(outward, d, b)
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    return sums[used] / counts[used][:, None], np.concatenate(faces)


SHAPES = {"bumpy": bumpy, "hull": hull, "man": man}


def write_off(path, vertices, faces):
    with open(path, "w") as f:
        f.write(f"OFF\n{len(vertices)} {len(faces)} 0\n")
        np.savetxt(f, vertices, "%.12g")
        np.savetxt(f, np.insert(faces, 0, 3, axis=1), "%d")
