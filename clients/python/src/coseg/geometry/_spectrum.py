"""The smallest eigenpairs of a Laplacian, with a proof that none is missing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from coseg.geometry._arrays import Doubles, _native, argument, doubles, rows_of
from coseg.geometry._progress import Progress, reporter

if TYPE_CHECKING:
    from coseg._pixels import Picture
    from coseg.geometry._mesh import Mesh
    from coseg.geometry._operators import Laplacian


@dataclass(frozen=True)
class Certificate:
    """Why no eigenvalue is missing."""

    #: Whether the count holds for the matrix as given, whatever rounding did.
    is_proved: bool
    #: Every eigenvalue below this was found.
    tau: float
    #: Eigenvalues below ``tau``, counted by the signs of pivots.
    count: int
    #: Distance from ``tau`` to the nearest eigenvalue found.
    margin: float
    #: The count is that of a matrix within this distance; less than ``margin`` if it is proved.
    perturbation: float
    #: Growth of the pivots.
    growth: float
    #: Connected components of the stiffness.
    n_components: int
    #: Largest Krylov space; 0: solved densely.
    n_krylov: int
    #: Rounds of inverse iteration that residuals needed.
    n_polish: int
    #: Rounds in which pairs missed at first were looked for.
    n_repair: int


@dataclass(frozen=True, eq=False, repr=False)
class Spectrum:
    """The ``k`` smallest eigenpairs of ``W φ = λ A φ``, in the units of the mesh."""

    #: Ascending, not negative (k,).
    eigenvalues: Doubles
    #: Mass-orthonormal (n, k); in each column the entry of largest magnitude is positive.
    eigenvectors: Doubles
    #: Diagonal of A (n,).
    mass: Doubles
    #: ``‖W φ - λ A φ‖`` in the norm of A⁻¹ (k,).
    residuals: Doubles
    certificate: Certificate
    #: ``None`` for a spectrum of matrices.
    mesh: Mesh | None = None
    operator: str = "given"
    #: Edges that join components.
    n_bridges: int = 0

    @property
    def k(self) -> int:
        """Number of pairs."""
        return len(self.eigenvalues)

    @property
    def n_vertices(self) -> int:
        """Rows of the eigenvectors."""
        return len(self.mass)

    def hks(self, times: int | ArrayLike = 100) -> Doubles:
        """Heat kernel signature (n, times); Sun, Ovsjanikov and Guibas 2009.

        A number of times spreads them as the paper does: log-uniform from 4 ln 10 / λ_last to
        4 ln 10 / λ₂. The unit is 1 / area.
        """
        if isinstance(times, int):
            at = _native.hks_times(self.eigenvalues, times)
        else:
            at = doubles(times, "times").reshape(-1)
        return _native.point_kernels(self.eigenvalues, self.eigenvectors, at, 0)

    def wks(self, n_energies: int = 100) -> Doubles:
        """Wave kernel signature (n, n_energies); Aubry, Schlickewei and Cremers 2011.

        Energies are uniform in log λ, and bands 7 % of their range wide, as in the paper.
        """
        none = np.empty(0)
        return _native.point_kernels(self.eigenvalues, self.eigenvectors, none, n_energies)

    def gps(self, n_dims: int = 25) -> Doubles:
        """Global point signature (n, n_dims): ``φ_i / √λ_i``; Rustamov 2007."""
        skip = self.n_zero
        if not 0 < n_dims <= self.k - skip:
            raise argument(f"{n_dims} dimensions, but there are {self.k - skip} eigenvalues above 0")
        chosen = slice(skip, skip + n_dims)
        found: Doubles = self.eigenvectors[:, chosen] / np.sqrt(self.eigenvalues[chosen])
        return found

    def shape_dna(self, n: int = 50) -> Doubles:
        """The first ``n`` eigenvalues above 0, times the area: it does not depend on the scale."""
        skip = self.n_zero
        if not 0 < n <= self.k - skip:
            raise argument(f"{n} eigenvalues, but there are {self.k - skip} above 0")
        found: Doubles = self.eigenvalues[skip : skip + n] * self.mass.sum()
        return found

    @cached_property
    def n_zero(self) -> int:
        """Eigenvalues that are zero: one for each component."""
        return _native.null_space(self.eigenvalues)

    def project(self, values: ArrayLike, k: int | None = None) -> Doubles:
        """Coefficients (k,) or (k, p) of functions (n,) or (n, p): ``Φᵀ A f``."""
        rows = rows_of(values, self.n_vertices, "values", "vertices")
        found: Doubles = self.eigenvectors[:, :k].T @ (self.mass[:, None] * rows)
        return found[:, 0] if np.ndim(values) == 1 else found

    def synthesize(self, coefficients: ArrayLike) -> Doubles:
        """Functions (n,) or (n, p) of coefficients (k,) or (k, p): ``Φ c``."""
        given = doubles(coefficients, "coefficients")
        if given.ndim not in (1, 2) or not 0 < len(given) <= self.k:
            raise argument(f"coefficients have shape {given.shape}, but k is {self.k}")
        found: Doubles = self.eigenvectors[:, : len(given)] @ given
        return found

    def plot(self, index: int = 1, *, backend: str | None = None) -> Any:
        """Shows an eigenvector on the mesh; see :meth:`Mesh.plot`."""
        return self._mesh("plot").plot(self.eigenvectors[:, index], backend=backend)

    def picture(self, index: int = 1, *, size: tuple[int, int] = (320, 320)) -> Picture:
        """A picture of an eigenvector on the mesh."""
        return self._mesh("picture").picture(self.eigenvectors[:, index], size=size)

    def _mesh(self, what: str) -> Mesh:
        if self.mesh is None:
            raise argument(f"{what} needs a mesh, but this spectrum was made of matrices alone")
        return self.mesh

    @cached_property
    def shape(self) -> _native.Shape:
        """What the native module needs of it for maps, computed once."""
        mesh = self._mesh("a functional map")
        return _native.Shape(mesh.vertices, mesh.faces, self.eigenvalues, self.eigenvectors, self.mass)

    def __repr__(self) -> str:
        proof = "proved complete" if self.certificate.is_proved else "counted, not proved"
        low, high = self.eigenvalues[0], self.eigenvalues[-1]
        return f"Spectrum(k={self.k}, n={self.n_vertices}, {self.operator}, {low:.4g} to {high:.4g}, {proof})"

    def _repr_html_(self) -> str:
        if self.mesh is None or self.k < 2:
            return f"<code>{self!r}</code>"
        return self.picture(size=(200, 200)).html(f"{self!r}; eigenvector 1")


def of_laplacian(
    laplacian: Laplacian, k: int, tolerance: float, threads: int | None, progress: Progress
) -> Spectrum:
    """The spectrum of a mesh's Laplacian."""
    values, vectors, residuals, certificate = _native.spectrum(
        laplacian.row_starts,
        laplacian.columns,
        laplacian.values,
        laplacian.mass,
        k,
        tolerance,
        0x5EED,
        threads or 0,
        reporter(progress),
    )
    return Spectrum(
        eigenvalues=values,
        eigenvectors=vectors,
        mass=laplacian.mass,
        residuals=residuals,
        certificate=Certificate(**certificate),
        mesh=laplacian.mesh,
        operator=laplacian.operator,
        n_bridges=laplacian.n_bridges,
    )


def spectrum(
    stiffness: Any,
    mass: Any,
    k: int = 300,
    *,
    mesh: Mesh | None = None,
    tolerance: float = 1e-8,
    threads: int | None = None,
    progress: Progress = None,
) -> Spectrum:
    """The ``k`` smallest eigenpairs of ``W φ = λ A φ`` for matrices of any origin.

    ``stiffness`` is a scipy sparse matrix (n, n), symmetric positive semidefinite; ``mass`` the
    diagonal of A (n,), positive, or a diagonal sparse matrix. With the ``mesh`` they belong to, the
    result can take part in functional maps.
    """
    rows = stiffness.tocsr()
    rows.sum_duplicates()
    rows.sort_indices()
    if hasattr(mass, "diagonal") and not isinstance(mass, np.ndarray):
        diagonal = mass.diagonal()
        if mass.nnz != np.count_nonzero(diagonal):
            raise argument("the mass has entries off its diagonal; lump it: mass.sum(axis=1)")
        mass = diagonal
    diagonal = doubles(mass, "mass").reshape(-1)
    if rows.shape != (len(diagonal), len(diagonal)):
        raise argument(f"the stiffness is {rows.shape}, but the mass has {len(diagonal)} entries")
    values, vectors, residuals, certificate = _native.spectrum(
        np.ascontiguousarray(rows.indptr, dtype=np.int64),
        np.ascontiguousarray(rows.indices, dtype=np.int64),
        doubles(rows.data, "entries of the stiffness"),
        diagonal,
        k,
        tolerance,
        0x5EED,
        threads or 0,
        reporter(progress),
    )
    return Spectrum(values, vectors, diagonal, residuals, Certificate(**certificate), mesh)
