"""Writes reference.json: tufted Laplacians by robust_laplacian 1.1.0 on meshes made up here.

    pip install numpy scipy robust_laplacian==1.1.0
    python tests/it/spectra/reference.py tests/it/spectra/reference.json

For each mesh: vertices, faces, mass, W f for the four functions f_j(v) = cos((j + 1) (v + 1)), and the first
eigenvalues. No mesh is symmetric: where four points lie on a circle, Delaunay triangulations are not unique.
"""

import json
import sys

import numpy as np
import robust_laplacian
import scipy.linalg

MOLLIFY = 1e-6
N_EIGENVALUES = 20


def sheet(nx, ny, height):
    """An open, wavy sheet whose columns crowd together: obtuse triangles, and slivers."""
    rng = np.random.default_rng(7)
    u, v = np.meshgrid(np.arange(nx + 1) / nx, np.arange(ny + 1) / ny, indexing="ij")
    vertices = np.stack([u**3, v, height * np.sin(5 * u + 2 * v)], -1).reshape(-1, 3)
    vertices += 0.02 * rng.normal(size=vertices.shape) * [0.1, 1, 1]
    at = np.arange(nx * (ny + 1)).reshape(nx, ny + 1)[:, :-1].ravel()
    lower = np.stack([at, at + ny + 1, at + ny + 2], 1)
    upper = np.stack([at, at + ny + 2, at + 1], 1)
    return vertices, np.concatenate([lower, upper])


def lump(seed, n):
    """The hull of random points, squashed."""
    from scipy.spatial import ConvexHull

    points = np.random.default_rng(seed).normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    faces = ConvexHull(points).simplices
    a, b, c = points[faces].swapaxes(0, 1)
    inward = (np.cross(b - a, c - a) * (a + b + c)).sum(1) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return points * [1, 0.3, 1.7], faces


def fins(n):
    """A lump with a fin of two triangles on each of some edges: three faces at an edge."""
    vertices, faces = lump(3, n)
    rng = np.random.default_rng(4)
    for face in faces[:: len(faces) // 6]:
        a, b = vertices[face[:2]]
        tip = 1.6 * (a + b) / 2 + 0.1 * rng.normal(size=3)
        side = tip + 0.3 * rng.normal(size=3)
        k = len(vertices)
        vertices = np.concatenate([vertices, [tip, side]])
        faces = np.concatenate([faces, [[face[0], face[1], k], [face[1], k + 1, k]]])
    return vertices, faces


def main():
    meshes = {"sheet": sheet(12, 6, 0.2), "lump": lump(5, 80), "fins": fins(60)}
    result = {}
    for name, (vertices, faces) in meshes.items():
        # What is written is exactly what was computed from.
        vertices = np.array([[float(f"{x:.9g}") for x in v] for v in vertices])
        stiffness, mass = robust_laplacian.mesh_laplacian(vertices, faces, MOLLIFY)
        n = len(vertices)
        functions = np.cos(np.outer(np.arange(1, n + 1), np.arange(1, 5)))
        values = scipy.linalg.eigh(stiffness.toarray(), mass.toarray(), eigvals_only=True)
        result[name] = {
            "vertices": vertices.tolist(),
            "faces": faces.tolist(),
            "mass": mass.diagonal().tolist(),
            "stiffness_times_functions": (stiffness @ functions).tolist(),
            "eigenvalues": values[:N_EIGENVALUES].tolist(),
        }
    with open(sys.argv[1], "w") as f:
        f.write("{\n")
        lines = [f'"{mesh}": ' + "{\n" + ",\n".join(f'"{k}": {json.dumps(x)}' for k, x in m.items()) + "\n}" for mesh, m in result.items()]
        f.write(",\n".join(lines) + "\n}\n")


main()
