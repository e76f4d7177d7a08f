"""Everything that the daemon computes of one shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coseg._pixels import Picture
from coseg.geometry._arrays import Doubles, Indices, _native, argument
from coseg.geometry._mesh import Mesh

Singles = NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class Description:
    """Arrays of a proxy of a shape: centred, of area 1, with n vertices and m faces."""

    #: Surface area of the shape, in its own units.
    area: float
    #: What cleaning found and did, by name.
    report: dict[str, int]
    #: (n, 3).
    vertices: Singles
    #: (m, 3).
    faces: Indices
    #: Lumped mass (n,), of sum 1.
    mass: Singles
    #: Ascending (k,).
    eigenvalues: Doubles
    #: Mass-orthonormal (n, up to 100).
    eigenvectors: Singles
    #: Heat kernel signature (n, 100).
    hks: Singles
    #: (m, 92), smoothed, not standardised: docs/methods.md names the columns.
    face_descriptors: Singles
    #: Over-segmentation (m,), numbered from 0.
    patches: Indices
    #: For each polygon of the shape its face of the proxy (n_polygons,).
    face_map: Indices
    #: For each polygon its share of the area (n_polygons,).
    polygon_area: Singles
    #: Global descriptor, by which shapes are compared.
    signature: Singles

    def at_polygons(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values at faces of the proxy (m, ...), at the polygons of the shape (n_polygons, ...)."""
        if len(values) != len(self.faces):
            raise argument(f"{len(values)} values, but the proxy has {len(self.faces)} faces")
        found: NDArray[Any] = values[self.face_map]
        return found

    def segment(self, n_parts: int) -> NDArray[np.int32]:
        """A part for each polygon of the shape (n_polygons,), numbered from 0.

        Patches are merged by their descriptors and the creases between them, until ``n_parts`` are
        left.
        """
        n_patches = int(self.patches.max()) + 1
        if not 0 < n_parts <= n_patches:
            raise argument(f"{n_parts} parts, but between 1 and {n_patches} can be made")
        vertices = self.vertices.astype(np.float64)
        parts = _native.segment(vertices, self.faces, self.patches, self.face_descriptors, n_parts)
        return self.at_polygons(parts.astype(np.int32))

    def __repr__(self) -> str:
        return (
            f"Description({len(self.face_map)} polygons, proxy of {len(self.faces)} faces, "
            f"{len(self.eigenvalues)} eigenvalues, {self.face_descriptors.shape[1]} descriptors)"
        )

    def picture(self, *, size: tuple[int, int] = (320, 320)) -> Picture:
        """A picture of the proxy with its patches."""
        mesh = Mesh(self.vertices.astype(np.float64), self.faces)
        return mesh.picture(self.patches.astype(np.int32), size=size)

    def _repr_html_(self) -> str:
        return self.picture(size=(200, 200)).html(f"{self!r}; patches")
