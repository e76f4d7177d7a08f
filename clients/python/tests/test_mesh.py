"""Meshes from arrays, files and objects, and what is refused."""

from __future__ import annotations

import pickle
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import potpourri3d
import pytest
import trimesh
from shapes import icosphere, lumpy, renumbered, sphere

import coseg
from coseg.geometry import Geodesics, Mesh

CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""


def test_arrays_are_taken_as_they_are() -> None:
    vertices, faces = icosphere(1)
    faces = faces.astype(np.uint32)
    mesh = Mesh(vertices, faces)
    assert np.shares_memory(mesh.vertices, vertices) and np.shares_memory(mesh.faces, faces)
    assert (mesh.n_vertices, mesh.n_faces, mesh.n_polygons) == (42, 80, 80)
    with pytest.raises(ValueError, match="read-only"):
        mesh.vertices[0] = 0
    # Other types and layouts are converted; the values are the same.
    other = Mesh(np.asfortranarray(vertices.astype(np.float32)), faces.astype(np.int16).tolist())
    assert np.allclose(other.vertices, vertices, atol=1e-6)
    assert np.array_equal(other.faces, faces)
    again = pickle.loads(pickle.dumps(mesh))
    assert np.array_equal(again.vertices, vertices)


def test_area_and_topology() -> None:
    mesh = sphere(4)
    assert mesh.area == pytest.approx(4 * np.pi, rel=5e-3)
    assert (mesh.n_components, mesh.n_boundary_edges, mesh.n_nonmanifold_edges) == (1, 0, 0)
    vertices, faces = icosphere(0)
    # Two spheres, one with a hole, a fin on an edge of it, and a vertex that no face uses.
    twice = np.concatenate([vertices, vertices + 5, [[9.0, 9, 9], [0, 0, 9]]])
    fin = [[faces[0][0], faces[0][1], 24]]
    mesh = Mesh(twice, np.concatenate([faces, faces[1:] + 12, fin]))
    assert (mesh.n_components, mesh.n_isolated_vertices) == (2, 1)
    assert (mesh.n_boundary_edges, mesh.n_nonmanifold_edges) == (3 + 2, 1)
    assert repr(mesh) == ("Mesh(26 vertices, 40 faces, 2 components, 1 isolated vertices, 5 boundary edges)")


def test_polygons_are_triangulated() -> None:
    square = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]]
    mesh = Mesh(square, [[0, 1, 2, 3], [1, 4, 2]])
    assert (mesh.n_faces, mesh.n_polygons) == (3, 2)
    assert mesh.polygon_of_face.tolist() == [0, 0, 1]
    assert mesh.area == pytest.approx(1.5)
    # A dart: the diagonal from the first corner would lie outside.
    dart = [[0.0, 0, 0], [1, 1, 0], [0, 3, 0], [-1, 1, 0]]
    dart[0] = [0, 2, 0]
    assert Mesh(dart, np.array([[1, 2, 3, 0]])).area == pytest.approx(1.0)


def objects() -> dict[str, Any]:
    vertices, faces = icosphere(1)
    padded = np.insert(faces, 0, 3, axis=1).reshape(-1)
    return {
        "trimesh": trimesh.Trimesh(vertices, faces, process=False),
        "meshio": meshio.Mesh(vertices, [("triangle", faces)]),
        # As open3d.geometry.TriangleMesh and pyvista.PolyData show themselves.
        "open3d": SimpleNamespace(vertices=vertices.tolist(), triangles=faces.tolist()),
        "pyvista": SimpleNamespace(points=vertices, faces=padded),
        "tuple": (vertices, faces),
    }


@pytest.mark.parametrize("name", ["trimesh", "meshio", "open3d", "pyvista", "tuple"])
def test_objects_of_other_packages(name: str) -> None:
    mesh = Mesh(objects()[name])
    vertices, faces = icosphere(1)
    assert np.array_equal(mesh.vertices, vertices) and np.array_equal(mesh.faces, faces)


def test_real_pyvista() -> None:
    pyvista = pytest.importorskip("pyvista")
    mesh = Mesh(pyvista.Cube())
    assert (mesh.n_polygons, mesh.n_faces) == (6, 12)
    assert mesh.area == pytest.approx(6.0)


def test_mixed_cells_of_meshio() -> None:
    points = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]]
    cells = [("quad", [[0, 1, 2, 3]]), ("triangle", [[1, 4, 2]])]
    assert Mesh(meshio.Mesh(points, cells)).polygon_of_face.tolist() == [0, 0, 1]
    with pytest.raises(coseg.GeometryError, match="'line'"):
        Mesh(meshio.Mesh(points, [("line", [[0, 1]])]))


def test_files_keep_their_vertices_and_polygons(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    mesh = coseg.read_mesh(tmp_path / "cube.obj")
    assert (mesh.n_vertices, mesh.n_polygons, mesh.n_faces) == (8, 6, 12)
    assert mesh.vertices[6].tolist() == [1, 1, 1]
    # What an STL repeats for each triangle is one vertex.
    cube = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    cube.export(tmp_path / "cube.stl")
    welded = coseg.read_mesh(tmp_path / "cube.stl")
    assert (welded.n_vertices, welded.n_faces, welded.n_boundary_edges) == (8, 12, 0)


def test_cleaning_says_what_it_did() -> None:
    vertices, faces = icosphere(1)
    # Each triangle its own corners, one of them twice, one without area, one vertex unused.
    loose = np.concatenate([vertices[faces].reshape(-1, 3), [[7.0, 7, 7]]])
    soup = np.concatenate([np.arange(240).reshape(-1, 3), [[0, 1, 2], [3, 3, 4]]])
    given = Mesh(loose, soup)
    cleaned = given.clean()
    assert (cleaned.mesh.n_vertices, cleaned.mesh.n_faces) == (42, 80)
    assert cleaned.report["n_degenerate_triangles"] == 1
    assert cleaned.report["n_duplicate_triangles"] == 1
    assert cleaned.vertex_map[-1] == -1
    kept = cleaned.vertex_map >= 0
    # In the units and the place of the input, to the bit.
    assert np.array_equal(cleaned.mesh.vertices[cleaned.vertex_map[kept]], loose[kept])
    assert len(cleaned.face_map) == 82


def test_refusals_say_where(tmp_path: Path) -> None:
    vertices, faces = icosphere(0)
    with pytest.raises(coseg.GeometryError, match="faces name 12, but there are 12 vertices"):
        Mesh(vertices, faces + 1)
    with pytest.raises(coseg.GeometryError, match=r"\(12, 2\)"):
        Mesh(vertices[:, :2], faces)
    with pytest.raises(coseg.GeometryError, match="read_mesh"):
        Mesh("cat.off")
    with pytest.raises(coseg.GeometryError, match="dict has no vertices"):
        Mesh({})
    with pytest.raises(coseg.GeometryError, match="integers"):
        Mesh(vertices, faces.astype(float))
    bad = tmp_path / "bad.off"
    bad.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 x 0\n3 0 1 2\n")
    with pytest.raises(coseg.ParseError, match='"x" is not a number') as raised:
        coseg.read_mesh(bad)
    assert (raised.value.kind, raised.value.line) == ("NotANumber", 5)
    assert isinstance(raised.value, ValueError) and isinstance(raised.value, coseg.CosegError)
    again = pickle.loads(pickle.dumps(raised.value))
    assert (type(again), again.line, str(again)) == (coseg.ParseError, 5, str(raised.value))
    with pytest.raises(coseg.LaplacianError, match="vertex 12 belongs to no face") as unused:
        Mesh(np.concatenate([vertices, [[0.0, 0, 9]]]), faces).laplacian()
    assert unused.value.vertex == 12
    with pytest.raises(coseg.CleanError):
        Mesh(np.zeros((3, 3)), [[0, 1, 2]]).clean()
    with pytest.raises(FileNotFoundError):
        coseg.read_mesh(tmp_path / "none.off")
    with pytest.raises(coseg.GeometryError, match="extensions"):
        (tmp_path / "a.step").write_text("")
        coseg.read_mesh(tmp_path / "a.step")


def test_distances_along_edges() -> None:
    mesh = sphere(3)
    found = mesh.edge_distances([0, 3])
    assert found.shape == (2, mesh.n_vertices)
    assert found[0, 0] == 0 and found[0, 3] == found[1, 0]
    assert np.pi < found[0, 3] < 1.2 * np.pi
    apart = Mesh(np.concatenate([mesh.vertices, mesh.vertices + 5]), _both(mesh))
    assert np.isinf(apart.edge_distances(0)[0, -1])
    assert np.isfinite(apart.edge_distances(0, bridges=True)).all()
    with pytest.raises(coseg.GeometryError, match="sources name 642"):
        mesh.edge_distances([642])


def _both(mesh: Mesh) -> Any:
    return np.concatenate([mesh.faces, mesh.faces + mesh.n_vertices])


def test_geodesics_on_a_sphere_are_angles() -> None:
    mesh = sphere(4)
    sources = [0, 11, 700]
    exact = np.arccos(np.clip(mesh.vertices[sources] @ mesh.vertices.T, -1, 1))
    found = mesh.geodesics(sources)
    assert found.shape == (3, mesh.n_vertices)
    assert (found[[0, 1, 2], sources] == 0).all() and found.min() >= 0
    assert np.abs(found - exact).mean() < 0.01 * np.pi
    along = mesh.geodesics(sources, method="edges")
    assert np.array_equal(along, mesh.edge_distances(sources))
    assert np.abs(found - exact).mean() < 0.5 * np.abs(along - exact).mean()
    # In the unit of the coordinates; one vertex is a list of one; the same from a prepared solver.
    large = Mesh(1000 * mesh.vertices, mesh.faces)
    assert np.allclose(large.geodesics(11)[0], 1000 * found[1], rtol=1e-9, atol=1e-6)
    solver = Geodesics(mesh)
    assert np.array_equal(solver.distances(sources), found)
    assert repr(solver) == "Geodesics(2562 vertices, heat, time 1)"
    assert mesh.geodesics([]).shape == (0, mesh.n_vertices)


def test_geodesics_on_a_plane_are_straight() -> None:
    n = 60
    x, y = (a.reshape(-1) for a in np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0)))
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    halves = np.array([[0, 1, n + 2], [0, n + 2, n + 1]])
    faces = np.concatenate([corner + half for half in halves])
    plane = Mesh(np.stack([x, y, np.zeros_like(x)], axis=1), faces)
    for source in (0, n // 2 * (n + 2)):
        exact = np.hypot(x - x[source], y - y[source])
        found = plane.geodesics(source)[0]
        assert np.abs(found - exact).mean() < 0.01 * exact.max()
        assert np.abs(found - exact).max() < 0.03 * exact.max()


def test_geodesics_depend_on_no_order_and_no_unit() -> None:
    vertices, faces = lumpy(3)
    found = Mesh(vertices, faces).geodesics(5)[0]
    points, corners, old = renumbered(vertices, faces)
    other = Mesh(points, corners).geodesics(np.flatnonzero(old == 5))[0]
    assert np.allclose(other, found[old], atol=1e-9)
    assert np.allclose(Mesh(vertices, faces[:, ::-1]).geodesics(5)[0], found, atol=1e-9)
    assert np.allclose(Mesh(1000 * vertices, faces).geodesics(5)[0] / 1000, found, atol=1e-9)


def test_geodesics_agree_with_another_implementation() -> None:
    vertices, faces = lumpy(4)
    solver = potpourri3d.MeshHeatMethodDistanceSolver(vertices, faces)
    theirs = solver.compute_distance(5)
    ours = Mesh(vertices, faces).geodesics(5)[0]
    # The same method; mean edges and mollification differ in details.
    assert np.abs(ours - theirs).max() < 0.01 * theirs.max()


def test_geodesics_of_what_has_none() -> None:
    mesh = sphere(2)
    apart = Mesh(np.concatenate([mesh.vertices, mesh.vertices + 5]), _both(mesh))
    far = apart.geodesics(0)[0]
    assert np.isinf(far[mesh.n_vertices :]).all() and np.isfinite(far[: mesh.n_vertices]).all()
    with pytest.raises(coseg.GeometryError, match="sources name 162, but there are 162 vertices"):
        mesh.geodesics([0, 162])
    with pytest.raises(coseg.GeometryError, match="integers"):
        mesh.geodesics(0.5)
    with pytest.raises(coseg.GeometryError, match='method is \'exact\', but must be "heat" or "edges"'):
        mesh.geodesics(0, method="exact")  # type: ignore[arg-type]
    for time in (0.0, -1.0, float("nan")):
        with pytest.raises(coseg.GeometryError, match="must be positive and finite") as raised:
            mesh.geodesics(0, time=time)
        assert raised.value.kind == "Time"
    with pytest.raises(coseg.LaplacianError, match="vertex 162 belongs to no face"):
        Mesh(np.concatenate([mesh.vertices, [[0.0, 0, 9]]]), mesh.faces).geodesics(0)
    # A ribbon of 3,000 squares: what a double holds of heat ends after a thousand.
    n = 3000
    at = np.arange(n + 1.0)
    ribbon = np.stack([np.tile(at, 2), np.repeat([0.0, 1.0], n + 1), np.zeros(2 * n + 2)], axis=1)
    first, halves = np.arange(n)[:, None], np.array([[0, 1, n + 2], [0, n + 2, n + 1]])
    long = Mesh(ribbon, np.concatenate([first + half for half in halves]))
    with pytest.raises(coseg.GeometryError, match="give a time of 4 or more") as cold:
        long.geodesics(0)
    assert (cold.value.kind, cold.value.vertex is not None) == ("OutOfReach", True)
    assert long.geodesics(0, time=16.0)[0, n] == pytest.approx(n, rel=0.01)
