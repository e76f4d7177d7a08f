"""Two meshes become a map between their points and their functions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coseg._pixels import Picture
from coseg.geometry._arrays import Doubles, Indices, _native, argument, indices, rows_of
from coseg.geometry._blocks import precise, scale
from coseg.geometry._mesh import Mesh, as_mesh
from coseg.geometry._picture import beside, picture
from coseg.geometry._precise import PreciseMap
from coseg.geometry._progress import Progress
from coseg.geometry._spectrum import Spectrum

Direction = Literal["1->2", "2->1"]


@dataclass(frozen=True)
class MapQuality:
    """How far a map can be trusted, by what it shows of itself."""

    #: Mean geodesic error to expect, in units of the square root of the area; a reflection of the
    #: whole is forgiven.
    expected_error: float
    #: -1 (reverses orientation) to 1 (keeps it).
    orientation: float
    #: Share of the area of shape 1 that is hit.
    coverage: float
    #: Share of the area of shape 2 to which something corresponds.
    matched: float
    #: Mean squared difference of matched probe functions: 0 is perfect, 2 is chance.
    probe_residual: float
    #: ``‖CᵀC - I‖_F / √k``: 0 for an isometry.
    orthogonality: float
    #: Mean distance between a point and where it comes back to, in units of the root of the area.
    round_trip: float
    #: Dirichlet energy of carried coordinates over that of the own ones: near 1 if smooth.
    smoothness: float
    #: By which maps between the same shapes compare: the lower the better.
    cost: float


@dataclass(frozen=True, eq=False, repr=False)
class FunctionalMap:
    """A map from shape 1 to shape 2, on the meshes as given."""

    #: The shapes with their spectra.
    one: Spectrum
    two: Spectrum
    #: Carries coefficients on shape 1 to coefficients on shape 2: (k, k).
    c_12: Doubles
    #: For each vertex of shape 2 a vertex of shape 1: (n2,).
    p2p_21: Indices
    #: For each vertex of shape 2 whether something corresponds to it: (n2,).
    matched_2: NDArray[np.bool_]
    quality: MapQuality
    #: The best map of the other orientation, if one was found and asked for.
    alternative: FunctionalMap | None = None

    @property
    def k(self) -> int:
        """Rows and columns of ``c_12``."""
        return len(self.c_12)

    @property
    def mesh_1(self) -> Mesh:
        """Shape 1."""
        return self.one._mesh("a map")

    @property
    def mesh_2(self) -> Mesh:
        """Shape 2."""
        return self.two._mesh("a map")

    @cached_property
    def _back(self) -> tuple[Indices, NDArray[np.bool_]]:
        unit = np.ascontiguousarray(self.c_12 / scale(self.one, self.two))
        return _native.point_map_back(self.one.shape, self.two.shape, unit)

    @property
    def p2p_12(self) -> Indices:
        """For each vertex of shape 1 a vertex of shape 2 (n1,), by the same ``c_12``."""
        return self._back[0]

    @property
    def matched_1(self) -> NDArray[np.bool_]:
        """For each vertex of shape 1 whether something corresponds to it: (n1,)."""
        return self._back[1]

    @cached_property
    def precise(self) -> PreciseMap:
        """For each vertex of shape 2 a point inside a face of shape 1."""
        return precise(self.one, self.two, self.c_12)

    def transfer(
        self,
        values: ArrayLike,
        *,
        direction: Direction = "1->2",
        on: Literal["vertices", "faces"] | None = None,
        method: Literal["pointwise", "spectral"] = "pointwise",
    ) -> NDArray[Any]:
        """Values on one shape become values on the other, of the type that was given.

        ``values`` have one row for each vertex, or for each face, of the shape they come from:
        (n,), (n, p), (m,) or (m, p); ``on`` says which where both numbers are equal. Vertices get
        the values of the vertices they are matched with, or with ``"spectral"`` the function that
        ``c_12`` carries, which is smooth. Faces get the mean around the vertices matched with their
        corners, integers and booleans the most frequent one; where nothing corresponds NaN, or -1.
        """
        if direction not in ("1->2", "2->1"):
            raise argument(f'direction is {direction!r}, but must be "1->2" or "2->1"')
        forward = direction == "1->2"
        source, target = (self.mesh_1, self.mesh_2) if forward else (self.mesh_2, self.mesh_1)
        given = np.asarray(values)
        kind = _kind(given, source, direction[0], on)
        if method not in ("pointwise", "spectral"):
            raise argument(f'method is {method!r}, but must be "pointwise" or "spectral"')
        if method == "spectral":
            if kind == "faces":
                raise argument("faces have no spectrum: method='pointwise', or values at vertices")
            return self._carried(given, forward)
        p2p = self.p2p_21 if forward else self.p2p_12
        if kind == "vertices":
            carried: NDArray[Any] = given[p2p]
            return carried
        matched = self.matched_2 if forward else self.matched_1
        return _faces_to_faces(source, target, p2p, matched, given)

    def _carried(self, values: NDArray[Any], forward: bool) -> Doubles:
        source, target = (self.one, self.two) if forward else (self.two, self.one)
        # The adjoint in the inner products of both: the other direction of the same map.
        c = self.c_12 if forward else self.c_12.T / scale(self.one, self.two) ** 2
        return target.synthesize(c @ source.project(values, self.k))

    def picture(self, *, size: tuple[int, int] = (320, 320)) -> Picture:
        """Shape 1 coloured by position, and shape 2 by the map."""
        low, high = self.mesh_1.vertices.min(axis=0), self.mesh_1.vertices.max(axis=0)
        colours = 0.15 + 0.8 * (self.mesh_1.vertices - low) / np.maximum(high - low, 1e-300)
        return beside(picture(self.mesh_1, colours, size), picture(self.mesh_2, self.transfer(colours), size))

    def plot(self, *, size: tuple[int, int] = (320, 320)) -> Picture:
        """The same as :meth:`picture`."""
        return self.picture(size=size)

    def __repr__(self) -> str:
        q = self.quality
        mirrored = ", reverses orientation" if q.orientation < 0 else ""
        return (
            f"FunctionalMap({self.one.n_vertices} -> {self.two.n_vertices} vertices, k={self.k}, "
            f"expected error {q.expected_error:.3f}, coverage {q.coverage:.2f}{mirrored})"
        )

    def _repr_html_(self) -> str:
        return self.picture(size=(200, 200)).html(repr(self))


def _kind(given: NDArray[Any], mesh: Mesh, name: str, on: str | None) -> str:
    n, m = mesh.n_vertices, mesh.n_faces
    length = len(given) if given.ndim in (1, 2) else -1
    counts = {"vertices": n, "faces": m}
    if on is None:
        if n == m == length:
            raise argument(f"shape {name} has {n} vertices and as many faces: say on='vertices'")
        on = "faces" if length == m else "vertices"
    if on not in counts:
        raise argument(f'on is {on!r}, but must be "vertices" or "faces"')
    if length != counts[on]:
        raise argument(f"values have shape {given.shape}, but shape {name} has {n} vertices and {m} faces")
    return on


def _faces_to_faces(
    source: Mesh,
    target: Mesh,
    p2p: Indices,
    matched: NDArray[np.bool_],
    values: NDArray[Any],
) -> NDArray[Any]:
    common = (source.faces, target.faces, source.n_vertices, p2p, matched)
    if values.dtype.kind in "iub":
        if values.ndim != 1:
            raise argument(f"labels have shape {values.shape}, but (m,) is needed")
        kinds, compact = np.unique(values, return_inverse=True)
        found = _native.labels_to_faces(*common, compact.astype(np.int32).reshape(-1))
        if values.dtype.kind in "bu":
            # No type of theirs has a -1.
            return np.where(found < 0, -1, kinds.astype(np.int64)[found])
        return np.where(found < 0, kinds.dtype.type(-1), kinds[found])
    rows = rows_of(values, source.n_faces, "values", "faces")
    carried = _native.faces_to_faces(*common, rows)
    return carried[:, 0] if values.ndim == 1 else carried


def functional_map(
    one: Mesh | Spectrum | Any,
    two: Mesh | Spectrum | Any,
    *,
    k: int = 100,
    operator: str = "tufted",
    landmarks: ArrayLike | None = None,
    probes: tuple[ArrayLike, ArrayLike] | None = None,
    orientation: Literal["prefer", "keep", "reverse"] = "prefer",
    alternative: bool = True,
    probe_weight: float = 1.0,
    landmark_weight: float = 1.0,
    threads: int | None = None,
    progress: Progress = None,
) -> FunctionalMap:
    """The functional map from shape 1 to shape 2, at full resolution, without landmarks.

    Shapes are meshes, whose spectra of ``k`` pairs are computed here (components are joined by
    bridges), or spectra of connected meshes. ``landmarks`` (l, 2) are vertices of shape 1 and of
    shape 2 that correspond; ``probes`` functions (n1, p) and (n2, p) whose columns correspond.
    ``orientation`` says whether maps that keep the orientation are preferred (unless the reversing
    ones cost less by a quarter), or alone, or those that reverse it. The weights are relative to the
    spectral coordinates. The size of the map is at most 100.
    """
    if orientation not in ("prefer", "keep", "reverse"):
        raise argument(f'orientation is {orientation!r}, but must be "prefer", "keep" or "reverse"')
    a, b = (_spectrum(shape, k, operator, threads, progress) for shape in (one, two))
    pairs = np.empty((0, 2), np.uint32) if landmarks is None else _landmarks(landmarks, a, b)
    own_1, own_2 = (np.empty((s.n_vertices, 0)) for s in (a, b))
    if probes is not None:
        own_1 = rows_of(probes[0], a.n_vertices, "probes of shape 1", "vertices")
        own_2 = rows_of(probes[1], b.n_vertices, "probes of shape 2", "vertices")
        if own_1.shape[1] != own_2.shape[1]:
            raise argument(f"shape 1 has {own_1.shape[1]} probes, but shape 2 {own_2.shape[1]}")
    found = _native.point_maps(
        a.shape, b.shape, pairs, own_1, own_2, orientation, alternative, probe_weight, landmark_weight
    )
    if not found:
        raise argument(f"no map was found with orientation={orientation!r}")
    maps = [_made(a, b, fields) for fields in found]
    return replace(maps[0], alternative=maps[1] if len(maps) > 1 else None)


def _made(one: Spectrum, two: Spectrum, fields: dict[str, Any]) -> FunctionalMap:
    return FunctionalMap(
        one,
        two,
        fields.pop("c_12") * scale(one, two),
        fields.pop("p2p_21"),
        fields.pop("matched"),
        MapQuality(matched=fields.pop("matched_share"), **fields),
    )


def _spectrum(shape: Any, k: int, operator: str, threads: int | None, progress: Progress) -> Spectrum:
    if not isinstance(shape, Spectrum):
        mesh = as_mesh(shape)
        k = min(k, mesh.n_vertices)
        return mesh.spectrum(k, operator, bridges=True, threads=threads, progress=progress)
    if shape.n_zero > 1:
        raise argument(
            f"{shape.n_zero} eigenvalues are zero, but maps need a connected domain: "
            "make the spectrum with bridges=True"
        )
    return shape


def _landmarks(given: ArrayLike, one: Spectrum, two: Spectrum) -> Indices:
    pairs = np.asarray(given)
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise argument(f"landmarks have shape {pairs.shape}, but (l, 2) is needed")
    sides = [
        indices(pairs[:, i], s.n_vertices, f"landmarks of shape {i + 1}", "vertices")
        for i, s in enumerate((one, two))
    ]
    return np.ascontiguousarray(np.stack(sides, axis=1))
