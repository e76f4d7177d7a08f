"""Building blocks of functional maps between two spectra.

``c_12`` (k2, k1) carries coefficients on shape 1 to coefficients on shape 2, ``p2p_21`` (n2,) sends
each vertex of shape 2 to one of shape 1. Both are in the units of the meshes: a function f on shape
1 is ``two.synthesize(c_12 @ one.project(f, k1))`` on shape 2. Solvers work in single precision.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from coseg.geometry._arrays import Doubles, Indices, _native, argument, doubles, indices, rows_of
from coseg.geometry._precise import PreciseMap
from coseg.geometry._spectrum import Spectrum

#: Vertices above which a search of all pairs would take minutes: cells of samples are searched.
EXACT_UP_TO = 20_000


def scale(one: Spectrum, two: Spectrum) -> float:
    """By which a map between the shapes scaled to area 1 becomes one between them as given."""
    return math.sqrt(float(two.mass.sum()) / float(one.mass.sum()))


def _unit(one: Spectrum, two: Spectrum, c_12: ArrayLike) -> Doubles:
    """``c_12`` between the shapes scaled to area 1."""
    c = doubles(c_12, "entries of c_12")
    if c.ndim != 2 or not (0 < c.shape[0] <= two.k and 0 < c.shape[1] <= one.k):
        raise argument(f"c_12 has shape {c.shape}, but must be (k2, k1) with k2 up to {two.k}, k1 to {one.k}")
    return np.ascontiguousarray(c / scale(one, two))


def _is_exact(one: Spectrum, two: Spectrum, exact: bool | None) -> bool:
    return max(one.n_vertices, two.n_vertices) <= EXACT_UP_TO if exact is None else exact


def pointwise(
    one: Spectrum,
    two: Spectrum,
    c_12: ArrayLike,
    *,
    direction: Literal["2->1", "1->2"] = "2->1",
    exact: bool | None = None,
) -> Indices:
    """The pointwise map of ``c_12``: ``p2p_21`` (n2,), or ``p2p_12`` (n1,) with ``"1->2"``.

    Nearest rows of ``Φ₂`` and ``Φ₁ C₁₂ᵀ``. With ``exact`` all pairs are compared, block by block,
    O(n1 n2 k); without, the nearest cells of samples are searched, which takes a square ``c_12``.
    By default meshes of up to 20,000 vertices are searched exactly.
    """
    c = _unit(one, two, c_12)
    is_exact = _is_exact(one, two, exact)
    if not is_exact and c.shape[0] != c.shape[1]:
        raise argument(f"c_12 is {c.shape}, but a search in cells takes a square one: exact=True")
    if direction not in ("2->1", "1->2"):
        raise argument(f'direction is {direction!r}, but must be "2->1" or "1->2"')
    return _native.pointwise(one.shape, two.shape, c, direction == "1->2", is_exact)


def functional(one: Spectrum, two: Spectrum, p2p_21: ArrayLike, k1: int, k2: int) -> Doubles:
    """``c_12`` (k2, k1) of a pointwise map ``p2p_21`` (n2,): ``Φ₂ᵀ A₂ Φ₁[p2p_21]``."""
    given = indices(p2p_21, one.n_vertices, "entries of p2p_21", "vertices of shape 1")
    if given.shape != (two.n_vertices,):
        raise argument(f"p2p_21 has shape {given.shape}, but shape 2 has {two.n_vertices} vertices")
    _check_sizes(one, two, k1, k2)
    return _native.functional(one.shape, two.shape, given, k1, k2) * scale(one, two)


def _check_sizes(one: Spectrum, two: Spectrum, k1: int, k2: int) -> None:
    if not (0 < k1 <= one.k and 0 < k2 <= two.k):
        raise argument(f"k1 = {k1}, k2 = {k2}, but the spectra have {one.k} and {two.k} pairs")


def icp(one: Spectrum, two: Spectrum, c_12: ArrayLike, rounds: int = 10) -> Doubles:
    """``rounds`` times: pointwise map, functional map, nearest orthogonal one; (k2, k1).

    Ovsjanikov et al. 2012, section 6.2. Orthogonal for shapes of equal area.
    """
    c = _unit(one, two, c_12)
    return _native.icp(one.shape, two.shape, c, rounds) * scale(one, two)


def zoomout(
    one: Spectrum,
    two: Spectrum,
    c_12: ArrayLike,
    *,
    step: int = 5,
    rounds: int = 10,
    exact: bool | None = None,
) -> Doubles:
    """ZoomOut (Melzi et al. 2019): a map (k, k) grows to (k + rounds step, k + rounds step).

    See :func:`pointwise` for ``exact``.
    """
    c = _unit(one, two, c_12)
    last = c.shape[0] + rounds * step
    if c.shape[0] != c.shape[1] or last > min(one.k, two.k):
        raise argument(
            f"c_12 is {c.shape} and grows to {last}, but must be square and end at "
            f"{min(one.k, two.k)} at most"
        )
    is_exact = _is_exact(one, two, exact)
    found = _native.zoomout(one.shape, two.shape, c, step, rounds, is_exact)
    return found * scale(one, two)


def precise(one: Spectrum, two: Spectrum, c_12: ArrayLike) -> PreciseMap:
    """For each vertex of shape 2 a point inside a face of shape 1; Ezuz and Ben-Chen 2017.

    O(n1 n2 k).
    """
    c = _unit(one, two, c_12)
    mesh = one._mesh("a precise map")
    return PreciseMap(*_native.precise(one.shape, two.shape, c), mesh.faces, mesh.n_vertices)


def fit(
    one: Spectrum,
    two: Spectrum,
    probes_1: ArrayLike,
    probes_2: ArrayLike,
    *,
    k1: int = 30,
    k2: int = 30,
    probe_weight: float = 1.0,
    laplacian_weight: float = 1e-2,
    commutativity_weight: float = 1e-1,
    orientation_weight: float = 0.0,
    mask: Literal["laplacian", "resolvent"] = "laplacian",
) -> Doubles:
    """The map ``c_12`` (k2, k1) that best carries ``probes_1`` (n1, p) to ``probes_2`` (n2, p).

    Columns correspond; each is brought to mean 0 and variance 1. The terms are the fit of the
    functions, closeness to the diagonal (commuting with the Laplacians, or their resolvents: Ren et
    al. 2019), commuting with multiplication by each function (Nogneng and Ovsjanikov 2017), and with
    crossing its gradient, which keeps orientation (Ren et al. 2018).
    """
    own_1 = rows_of(probes_1, one.n_vertices, "probes_1", "vertices of shape 1")
    own_2 = rows_of(probes_2, two.n_vertices, "probes_2", "vertices of shape 2")
    if own_1.shape[1] != own_2.shape[1]:
        raise argument(f"probes_1 are {own_1.shape[1]} functions, but probes_2 {own_2.shape[1]}")
    _check_sizes(one, two, k1, k2)
    if mask not in ("laplacian", "resolvent"):
        raise argument(f'mask is {mask!r}, but must be "laplacian" or "resolvent"')
    weights = [probe_weight, laplacian_weight, commutativity_weight, orientation_weight]
    found = _native.fit(one.shape, two.shape, own_1, own_2, k1, k2, weights, mask)
    return found * scale(one, two)


def landmark_probes(spectrum: Spectrum, vertices: ArrayLike) -> Doubles:
    """Functions (n, 3 l) that say where landmarks are: heat from each vertex at three times."""
    given = indices(vertices, spectrum.n_vertices, "landmarks", "vertices").reshape(-1)
    return _native.landmark_probes(spectrum.shape, given)


def signature_probes(
    spectrum: Spectrum, *, n_energies: int = 20, n_times: int = 10, n_curvatures: int = 4
) -> Doubles:
    """Functions (n, n_energies + n_times + n_curvatures) that mean the same on every shape.

    Wave kernels, logarithms of heat kernels, and mean curvatures, each of mean 0 and variance 1 up
    to a factor for each kind.
    """
    return _native.signature_probes(spectrum.shape, n_energies, n_times, n_curvatures)
