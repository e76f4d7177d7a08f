"""What is given becomes arrays of one type and layout, without a copy where it is that already."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coseg.errors import GeometryError

try:
    from coseg import _native
except ImportError as error:
    raise ImportError(
        "coseg._native is missing: this is the pure client of the daemon; coseg.geometry needs "
        "the wheel of coseg for this platform"
    ) from error

__all__ = [
    "Doubles",
    "Indices",
    "_native",
    "argument",
    "doubles",
    "indices",
    "read_only",
    "rows_of",
]

Doubles = NDArray[np.float64]
Indices = NDArray[np.uint32]


def argument(message: str) -> GeometryError:
    """The error for an argument that does not fit."""
    return GeometryError("Argument", message)


def doubles(values: ArrayLike, what: str) -> Doubles:
    """``values`` as a C-contiguous array of doubles."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise argument(f"{what} are {array.dtype}, but must be real numbers")
    return np.ascontiguousarray(array, dtype=np.float64)


def indices(values: ArrayLike, limit: int, what: str, of: str) -> Indices:
    """``values`` as a C-contiguous array of indices below ``limit``."""
    array = np.asarray(values)
    if array.size == 0:
        array = array.astype(np.uint32)
    if array.dtype.kind not in "iu":
        raise argument(f"{what} are {array.dtype}, but must be integers")
    if array.size and not 0 <= int(array.min()) <= int(array.max()) < limit:
        bad = int(array.min()) if int(array.min()) < 0 else int(array.max())
        raise argument(f"{what} name {bad}, but there are {limit} {of}")
    return np.ascontiguousarray(array, dtype=np.uint32)


def rows_of(values: ArrayLike, n: int, what: str, of: str) -> Doubles:
    """Functions ``(n,)`` or ``(n, p)`` as ``(n, p)``."""
    array = doubles(values, what)
    if array.ndim not in (1, 2) or len(array) != n:
        raise argument(f"{what} have shape {array.shape}, but there are {n} {of}")
    return array.reshape(n, -1)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """A view that cannot be written to."""
    view = array.view()
    view.flags.writeable = False
    return view
