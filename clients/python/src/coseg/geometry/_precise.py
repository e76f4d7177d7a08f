"""Maps that send vertices into faces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from coseg.geometry._arrays import Doubles, Indices, rows_of


@dataclass(frozen=True, eq=False)
class PreciseMap:
    """For each vertex of shape 2 a point in a face of shape 1."""

    #: Face of shape 1 (n2,).
    face: Indices
    #: Barycentric coordinates there (n2, 3): not negative, of sum 1.
    barycentric: Doubles
    #: Faces of shape 1 (m1, 3).
    faces_1: Indices
    n_vertices_1: int

    def transfer(self, values: ArrayLike) -> Doubles:
        """Values (n1,) or (n1, p) at the vertices of shape 1, at those of shape 2."""
        rows = rows_of(values, self.n_vertices_1, "values", "vertices of shape 1")
        corners = rows[self.faces_1[self.face]]
        found: Doubles = np.einsum("vc,vcp->vp", self.barycentric, corners)
        return found[:, 0] if np.ndim(values) == 1 else found

    @property
    def matrix(self) -> Any:
        """The map as a ``scipy.sparse.csr_matrix`` (n2, n1)."""
        from scipy import sparse

        n = len(self.face)
        rows = np.repeat(np.arange(n), 3)
        columns = self.faces_1[self.face].reshape(-1).astype(np.int64)
        entries = (self.barycentric.reshape(-1), (rows, columns))
        return sparse.csr_matrix(entries, shape=(n, self.n_vertices_1))
