"""Distances along a mesh from any of its vertices, prepared once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from coseg.geometry._arrays import Doubles, _native, indices
from coseg.geometry._progress import Progress, reporter

if TYPE_CHECKING:
    from coseg.geometry._mesh import Mesh


class Geodesics:
    """Distances by the heat method; see :meth:`coseg.Mesh.geodesics`.

    What all sources have in common (two factorisations) is computed here, once.
    """

    mesh: Mesh
    #: For how long heat flows, in squares of the mean edge.
    time: float

    def __init__(self, mesh: Mesh, *, time: float = 1.0) -> None:
        self.mesh, self.time = mesh, float(time)
        self._solver = _native.HeatGeodesics(mesh.vertices, mesh.faces, self.time)

    def distances(self, sources: ArrayLike, *, progress: Progress = None) -> Doubles:
        """Distances (s, n) from each of the vertices ``sources`` (s,)."""
        given = np.atleast_1d(np.asarray(sources))
        own = indices(given, self.mesh.n_vertices, "sources", "vertices").reshape(-1)
        return self._solver.distances(own, reporter(progress))

    def __repr__(self) -> str:
        return f"Geodesics({self.mesh.n_vertices} vertices, heat, time {self.time:g})"
