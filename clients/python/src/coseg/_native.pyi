"""The geometry of coseg, compiled. Arrays are C-contiguous and of exactly these types."""

from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "HeatGeodesics",
    "Shape",
    "__version__",
    "clean",
    "describe",
    "edge_distances",
    "faces_in_sight",
    "faces_to_faces",
    "fit",
    "functional",
    "hks_times",
    "icp",
    "labels_to_faces",
    "landmark_probes",
    "laplacian",
    "null_space",
    "parse",
    "point_kernels",
    "point_map_back",
    "point_maps",
    "pointwise",
    "precise",
    "segment",
    "signature_probes",
    "spectrum",
    "topology",
    "triangulate",
    "zoomout",
]

__version__: str

_F64 = NDArray[np.float64]
_F32 = NDArray[np.float32]
_U32 = NDArray[np.uint32]
_I64 = NDArray[np.int64]
_I32 = NDArray[np.int32]
_Bool = NDArray[np.bool_]
_Progress = Callable[[str, int, int], None] | None

@final
class HeatGeodesics:
    def __new__(cls, vertices: _F64, faces: _U32, time: float) -> HeatGeodesics: ...
    def distances(self, sources: _U32, progress: _Progress) -> _F64: ...

@final
class Shape:
    def __new__(
        cls, vertices: _F64, faces: _U32, eigenvalues: _F64, eigenvectors: _F64, mass: _F64
    ) -> Shape: ...

def parse(data: bytes, file_name: str) -> tuple[_F64, _U32, _U32, int]: ...
def triangulate(vertices: _F64, corners: _U32, offsets: _I64) -> tuple[_U32, _U32]: ...
def clean(vertices: _F64, faces: _U32) -> tuple[_F64, _U32, _I64, _U32, dict[str, int]]: ...
def topology(vertices: _F64, faces: _U32) -> tuple[int, int, int, int]: ...
def edge_distances(vertices: _F64, faces: _U32, sources: _U32, join_components: bool) -> _F64: ...
def laplacian(
    vertices: _F64, faces: _U32, operator_name: str, join_components: bool
) -> tuple[_I64, _I64, _F64, _F64, int]: ...
def spectrum(
    row_starts: _I64,
    columns: _I64,
    values: _F64,
    mass: _F64,
    k: int,
    tolerance: float,
    seed: int,
    threads: int,
    progress: _Progress,
) -> tuple[_F64, _F64, _F64, dict[str, Any]]: ...
def point_kernels(eigenvalues: _F64, eigenvectors: _F64, times: _F64, n_energies: int) -> _F64: ...
def hks_times(eigenvalues: _F64, n_times: int) -> _F64: ...
def null_space(eigenvalues: _F64) -> int: ...
def point_maps(
    one: Shape,
    two: Shape,
    landmarks: _U32,
    probes_1: _F64,
    probes_2: _F64,
    side: str,
    alternative: bool,
    probe_weight: float,
    landmark_weight: float,
) -> list[dict[str, Any]]: ...
def point_map_back(one: Shape, two: Shape, c_12: _F64) -> tuple[_U32, _Bool]: ...
def pointwise(one: Shape, two: Shape, c_12: _F64, back: bool, is_exact: bool) -> _U32: ...
def functional(one: Shape, two: Shape, p2p_21: _U32, k1: int, k2: int) -> _F64: ...
def icp(one: Shape, two: Shape, c_12: _F64, rounds: int) -> _F64: ...
def zoomout(one: Shape, two: Shape, c_12: _F64, step: int, rounds: int, is_exact: bool) -> _F64: ...
def precise(one: Shape, two: Shape, c_12: _F64) -> tuple[_U32, _F64]: ...
def fit(
    one: Shape,
    two: Shape,
    probes_1: _F64,
    probes_2: _F64,
    k1: int,
    k2: int,
    weights: Sequence[float],
    mask: str,
) -> _F64: ...
def landmark_probes(shape: Shape, vertices: _U32) -> _F64: ...
def signature_probes(shape: Shape, n_energies: int, n_times: int, n_scales: int) -> _F64: ...
def faces_to_faces(
    faces_1: _U32, faces_2: _U32, n_1: int, p2p_21: _U32, matched: _Bool, values: _F64
) -> _F64: ...
def labels_to_faces(
    faces_1: _U32, faces_2: _U32, n_1: int, p2p_21: _U32, matched: _Bool, labels: _I32
) -> _I32: ...
def describe(
    vertices: _F64,
    faces: _U32,
    polygon_of_face: _U32,
    n_polygons: int,
    working_faces: int,
    n_eigenpairs: int,
    operator_name: str,
    progress: _Progress,
) -> dict[str, Any]: ...
def segment(vertices: _F64, faces: _U32, patches: _U32, descriptors: _F32, n_parts: int) -> _U32: ...
def faces_in_sight(vertices: _F64, faces: _U32, width: int, height: int) -> _I32: ...
