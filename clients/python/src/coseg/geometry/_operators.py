"""Laplacians of meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coseg._pixels import Picture
from coseg.geometry._arrays import Doubles

if TYPE_CHECKING:
    from coseg.geometry._mesh import Mesh


@dataclass(frozen=True, eq=False, repr=False)
class Laplacian:
    """Stiffness W (n, n), positive semidefinite, and lumped mass A (n,); the operator is A⁻¹W.

    W has no unit, A that of the area. Boundaries are natural (Neumann).
    """

    mesh: Mesh
    #: ``"tufted"``, ``"cotan"`` or ``"mesh-laplace"``.
    operator: str
    #: W in compressed rows: where each row begins (n + 1,), columns and values.
    row_starts: NDArray[np.int64]
    columns: NDArray[np.int64]
    values: Doubles
    #: Diagonal of A (n,): positive, sums to the area.
    mass: Doubles
    #: Edges that join components.
    n_bridges: int

    @property
    def stiffness(self) -> Any:
        """W as a ``scipy.sparse.csr_matrix``."""
        from scipy import sparse

        n = len(self.mass)
        return sparse.csr_matrix((self.values, self.columns, self.row_starts), shape=(n, n))

    @property
    def mass_matrix(self) -> Any:
        """A as a diagonal ``scipy.sparse.dia_matrix``."""
        from scipy import sparse

        return sparse.diags(self.mass)

    def __repr__(self) -> str:
        n, entries = len(self.mass), len(self.values)
        return f"Laplacian({self.operator}, {n} x {n}, {entries} entries)"

    def picture(self, *, size: tuple[int, int] = (320, 320)) -> Picture:
        """A picture of the mesh, coloured by the logarithm of the mass at its vertices."""
        return self.mesh.picture(np.log(self.mass), size=size)

    def _repr_html_(self) -> str:
        return self.picture(size=(200, 200)).html(f"{self!r}; mass")
