"""Triangle meshes: from files, arrays and the objects of other packages."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coseg._gltf import read_mesh as read_bytes
from coseg.geometry._arrays import (
    Doubles,
    Indices,
    _native,
    argument,
    doubles,
    indices,
    read_only,
)
from coseg.geometry._progress import Progress, reporter

if TYPE_CHECKING:
    from coseg._pixels import Picture
    from coseg.geometry._description import Description
    from coseg.geometry._operators import Laplacian
    from coseg.geometry._spectrum import Spectrum


@dataclass(frozen=True)
class Cleaned:
    """A mesh that can be measured, and how it came from another one."""

    #: Welded, without degenerate or repeated faces, coherently oriented.
    mesh: Mesh
    #: For each vertex of the original its vertex here, -1 for none: (n,).
    vertex_map: NDArray[np.int64]
    #: For each face of the original its face here, or the nearest one: (m,).
    face_map: Indices
    #: What was found and done, by name; see ``CleanReport`` in docs/protocol.md.
    report: dict[str, int]


class Mesh:
    """A triangle mesh, kept as given: no vertex is moved, merged or renumbered.

    ``Mesh(vertices, faces)`` takes vertices (n, 3) and faces (m, 3); polygons, as an array (m, d)
    or as lists of any lengths, are triangulated. ``Mesh(other)`` takes an object of trimesh, pyvista,
    open3d, meshio, pyFM, or whatever has ``vertices`` or ``points``, and ``faces``, ``triangles`` or
    ``cells``. Arrays are not copied if their type allows: do not write to them afterwards.
    """

    #: Coordinates (n, 3).
    vertices: Doubles
    #: Vertices of each triangle (m, 3), counter-clockwise seen from outside.
    faces: Indices
    #: The polygon that each triangle came from (m,).
    polygon_of_face: Indices
    n_polygons: int

    def __init__(self, vertices: Any, faces: ArrayLike | Sequence[Sequence[int]] | None = None) -> None:
        if faces is None:
            vertices, faces = _parts(vertices)
        points = doubles(vertices, "vertices")
        if points.ndim != 2 or points.shape[1] != 3:
            raise argument(f"vertices have shape {points.shape}, but (n, 3) is needed")
        self.vertices = read_only(points)
        triangles, polygons, self.n_polygons = _triangles(points, faces)
        self.faces, self.polygon_of_face = read_only(triangles), read_only(polygons)

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @cached_property
    def face_areas(self) -> Doubles:
        """Areas of the triangles (m,)."""
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        areas: Doubles = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return areas

    @property
    def area(self) -> float:
        """Surface area."""
        return float(self.face_areas.sum())

    @cached_property
    def _topology(self) -> tuple[int, int, int, int]:
        return _native.topology(self.vertices, self.faces)

    @property
    def n_components(self) -> int:
        """Components, connected through shared vertices."""
        return self._topology[0]

    @property
    def n_boundary_edges(self) -> int:
        """Edges with one face: 0 for a closed surface."""
        return self._topology[1]

    @property
    def n_nonmanifold_edges(self) -> int:
        """Edges with more than two faces."""
        return self._topology[2]

    @property
    def n_isolated_vertices(self) -> int:
        """Vertices without a face."""
        return self._topology[3]

    def clean(self) -> Cleaned:
        """The mesh welded, without faces that have no area, and coherently oriented.

        Vertices at exactly equal positions become one; the others keep their coordinates.
        """
        vertices, faces, vertex_map, face_map, report = _native.clean(self.vertices, self.faces)
        return Cleaned(Mesh(vertices, faces), vertex_map, face_map, report)

    def laplacian(self, operator: str = "tufted", *, bridges: bool = False) -> Laplacian:
        """Stiffness (n, n) and mass (n,).

        ``operator`` is ``"tufted"`` (intrinsic Delaunay, robust on any mesh; Sharp and Crane 2020),
        ``"cotan"`` or ``"mesh-laplace"`` (Belkin, Sun and Wang 2008). With ``bridges`` components
        are joined by edges of a hundredth of the mean weight.
        """
        from coseg.geometry._operators import Laplacian

        return Laplacian(self, operator, *_native.laplacian(self.vertices, self.faces, operator, bridges))

    def spectrum(
        self,
        k: int = 300,
        operator: str = "tufted",
        *,
        bridges: bool = False,
        tolerance: float = 1e-8,
        threads: int | None = None,
        progress: Progress = None,
    ) -> Spectrum:
        """The ``k`` smallest eigenpairs of the Laplacian, with a proof that none is missing.

        ``k`` is at most n. Residuals are at most ``tolerance`` times the eigenvalue. ``threads`` are
        all processors by default; the result does not depend on them. See :meth:`laplacian` for
        ``operator`` and ``bridges``.
        """
        from coseg.geometry._spectrum import of_laplacian

        laplacian = self.laplacian(operator, bridges=bridges)
        return of_laplacian(laplacian, k, tolerance, threads, progress)

    def describe(
        self,
        *,
        working_faces: int = 2500,
        n_eigenpairs: int = 300,
        operator: str = "tufted",
        progress: Progress = None,
    ) -> Description:
        """Everything that the daemon computes of a shape, as arrays.

        As in the daemon, the arrays are of a proxy of about ``working_faces`` faces, and of area 1;
        ``at_polygons`` brings values back to this mesh.
        """
        from coseg.geometry._description import Description

        fields = _native.describe(
            self.vertices,
            self.faces,
            self.polygon_of_face,
            self.n_polygons,
            working_faces,
            n_eigenpairs,
            operator,
            reporter(progress),
        )
        return Description(**fields)

    def segment(self, n_parts: int, *, working_faces: int = 2500) -> NDArray[np.int32]:
        """A part for each polygon (n_polygons,), numbered from 0, of this shape alone.

        What parts have in common across shapes is what the daemon finds: :class:`coseg.Library`.
        """
        return self.describe(working_faces=working_faces).segment(n_parts)

    def edge_distances(self, sources: ArrayLike, *, bridges: bool = False) -> Doubles:
        """Shortest paths along edges from each vertex of ``sources`` (s,): (s, n).

        Infinite where there is no path. They overestimate geodesic distances by up to a fifth on
        regular meshes.
        """
        given = indices(np.atleast_1d(np.asarray(sources)), self.n_vertices, "sources", "vertices")
        return _native.edge_distances(self.vertices, self.faces, given, bridges)

    def geodesics(
        self,
        sources: ArrayLike,
        method: Literal["heat", "edges"] = "heat",
        *,
        time: float = 1.0,
        progress: Progress = None,
    ) -> Doubles:
        """Distances along the surface from each vertex of ``sources`` (s,) to all vertices: (s, n).

        In the unit of the coordinates: 0 at the source, never negative, infinite in other
        components. ``min(axis=0)`` is the distance to the nearest source. ``"heat"`` is the heat
        method (Crane, Weischedel and Wardetzky 2013) on the tufted Laplacian, within about 1 % of
        the exact distance on even meshes; it works wherever :meth:`laplacian` does. Heat flows for
        ``time`` squares of the mean edge: more is smoother, and less accurate. ``"edges"`` are
        shortest paths along edges: see :meth:`edge_distances`. :class:`coseg.geometry.Geodesics`
        keeps what the sources have in common for later calls.
        """
        from coseg.geometry._geodesics import Geodesics

        if method == "edges":
            return self.edge_distances(sources)
        if method != "heat":
            raise argument(f'method is {method!r}, but must be "heat" or "edges"')
        return Geodesics(self, time=time).distances(sources, progress=progress)

    def plot(self, values: ArrayLike | None = None, *, backend: str | None = None) -> Any:
        """Shows the mesh, coloured by ``values`` (n,), (m,) or (n_polygons,).

        ``backend`` is ``"polyscope"``, ``"pyvista"`` or ``"png"``; by default the first of these
        that is installed, or ``"png"`` where there is no screen. That one returns a :class:`Picture`.
        """
        from coseg.geometry._picture import plot

        return plot(self, values, backend)

    def picture(
        self,
        values: ArrayLike | None = None,
        *,
        size: tuple[int, int] = (320, 320),
        up: str = "+y",
    ) -> Picture:
        """A picture of (width, height) pixels, coloured by ``values``, that Jupyter shows."""
        from coseg.geometry._picture import picture

        return picture(self, values, size, up)

    def __repr__(self) -> str:
        counts = [f"{self.n_vertices} vertices", f"{self.n_faces} faces"]
        if self.n_polygons != self.n_faces:
            counts.append(f"{self.n_polygons} polygons")
        if self.n_components != 1:
            counts.append(f"{self.n_components} components")
        if self.n_isolated_vertices:
            counts.append(f"{self.n_isolated_vertices} isolated vertices")
        if self.n_boundary_edges:
            counts.append(f"{self.n_boundary_edges} boundary edges")
        return f"Mesh({', '.join(counts)})"

    def _repr_html_(self) -> str:
        return self.picture(size=(200, 200)).html(repr(self))


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """The mesh of an OBJ, OFF, PLY, STL or glTF file, with the vertices and polygons of the file.

    An STL file repeats each vertex for each of its triangles: they are welded, because nothing else
    joins them. Other formats are taken as they are; ``mesh.clean().mesh`` is welded.
    """
    name = os.fspath(path)
    vertices, faces, polygons, n_polygons = _native.parse(read_bytes(Path(name)), name)
    if name.lower().endswith(".stl"):
        unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
        vertices = np.ascontiguousarray(unique)
        faces = inverse.reshape(-1)[faces].astype(np.uint32)
    mesh = Mesh.__new__(Mesh)
    mesh.vertices, mesh.faces = read_only(vertices), read_only(faces)
    mesh.polygon_of_face, mesh.n_polygons = read_only(polygons), n_polygons
    return mesh


def as_mesh(mesh: Any) -> Mesh:
    """``mesh`` itself, or the mesh of what stands for one."""
    return mesh if isinstance(mesh, Mesh) else Mesh(mesh)


def _parts(given: Any) -> tuple[Any, Any]:
    """Vertices and faces of an object of another package."""
    if isinstance(given, str | os.PathLike):
        raise argument(f"{os.fspath(given)!r} is a path: coseg.read_mesh reads files")
    if isinstance(given, tuple) and len(given) == 2:
        return given
    vertices = next((getattr(given, n) for n in ("vertices", "points") if hasattr(given, n)), None)
    faces = next((getattr(given, n) for n in ("faces", "triangles", "cells") if hasattr(given, n)), None)
    if vertices is None or faces is None:
        raise argument(f"a {type(given).__name__} has no vertices and faces")
    if hasattr(given, "cells_dict"):
        return vertices, _cells(faces)
    faces = np.asarray(faces)
    # pyvista: each face after the number of its corners.
    return vertices, _padded(faces) if faces.ndim == 1 else faces


def _cells(blocks: Any) -> list[Any]:
    """The polygons of meshio's blocks of cells, in their order."""
    polygons: list[Any] = []
    for block in blocks:
        if block.type not in ("triangle", "quad", "polygon"):
            raise argument(f"cells are of type {block.type!r}, but must be triangles or polygons")
        polygons.extend(np.asarray(block.data).tolist())
    return polygons


def _padded(flat: NDArray[Any]) -> list[Any] | NDArray[Any]:
    if len(flat) and len(flat) % 4 == 0 and (flat[::4] == 3).all():
        return flat.reshape(-1, 4)[:, 1:]
    polygons, at = [], 0
    while at < len(flat):
        n = int(flat[at])
        polygons.append(flat[at + 1 : at + 1 + n].tolist())
        at += 1 + n
    return polygons


def _triangles(points: Doubles, faces: Any) -> tuple[Indices, Indices, int]:
    """Triangles (m, 3), the polygon of each, and the number of polygons."""
    try:
        array = np.asarray(faces)
    except ValueError:  # of different lengths
        array = np.empty(0, dtype=object)
    if array.ndim == 2 and array.shape[1] == 3:
        triangles = indices(array, len(points), "faces", "vertices")
        return triangles, np.arange(len(triangles), dtype=np.uint32), len(triangles)
    if array.ndim == 2 and array.shape[1] > 3:
        corners = indices(array, len(points), "faces", "vertices")
        lengths = np.full(len(array), array.shape[1], dtype=np.int64)
    else:
        polygons = cast(Sequence[Sequence[int]], list(faces))
        if not polygons or not all(isinstance(p, Sequence | np.ndarray) for p in polygons):
            raise argument(f"faces have shape {array.shape}, but (m, 3) or polygons are needed")
        lengths = np.fromiter((len(p) for p in polygons), np.int64, len(polygons))
        flat = np.concatenate([np.asarray(p) for p in polygons])
        corners = indices(flat, len(points), "faces", "vertices")
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    triangles, polygon_of_face = _native.triangulate(points, corners.reshape(-1), offsets)
    return triangles, polygon_of_face, len(lengths)
