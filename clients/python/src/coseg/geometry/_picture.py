"""Small pictures of meshes: faces in sight, and their colours."""

from __future__ import annotations

import importlib.util
import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from coseg._pixels import NOTHING, PALETTE, Picture, ramp
from coseg.geometry._arrays import Doubles, _native, argument, doubles

if TYPE_CHECKING:
    from coseg.geometry._mesh import Mesh

PLAIN = (176, 190, 206)
#: Pixels of a side are computed this many times as fine, and averaged.
FINER = 2


def beside(left: Picture, right: Picture) -> Picture:
    """Both in one, of the same height."""
    return Picture(np.concatenate([left.pixels, right.pixels], axis=1))


def picture(mesh: Mesh, values: ArrayLike | None, size: tuple[int, int], up: str = "+y") -> Picture:
    """The mesh, seen from the front, the right and above, coloured by ``values``."""
    width, height = size
    if width < 1 or height < 1:
        raise argument(f"the size is {size}, but both must be positive")
    turned = mesh.vertices @ _view(up).T
    turned = np.ascontiguousarray(turned)
    seen = _native.faces_in_sight(turned, mesh.faces, FINER * width, FINER * height)
    a, b, c = (turned[mesh.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    light = np.array([0.3, 0.5, 0.81])
    shade = np.abs(normals @ light) / np.maximum(lengths, 1e-300)
    colours = _colours(mesh, values) * (0.35 + 0.65 * shade)[:, None]
    pixels = np.full((*seen.shape, 3), 255.0)
    pixels[seen >= 0] = colours[seen[seen >= 0]]
    fine = pixels.reshape(height, FINER, width, FINER, 3)
    return Picture(fine.mean(axis=(1, 3)).round().clip(0, 255).astype(np.uint8))


def _view(up: str) -> Doubles:
    """Rows: right, up and towards the viewer."""
    axes = {"x": 0, "y": 1, "z": 2}
    if len(up) != 2 or up[0] not in "+-" or up[1] not in axes:
        raise argument(f'up is {up!r}, but must be one of "+x", "-x", "+y", "-y", "+z", "-z"')
    above = np.zeros(3)
    above[axes[up[1]]] = 1.0 if up[0] == "+" else -1.0
    front = np.roll(np.abs(above), 1)
    right = np.cross(above, front)
    towards = 0.75 * front + 0.5 * right + 0.4 * above
    towards /= np.linalg.norm(towards)
    across = np.cross(above, towards)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(towards, across), towards])


def _colours(mesh: Mesh, values: ArrayLike | None) -> Doubles:
    """Colours of the faces (m, 3), 0 to 255."""
    if values is None:
        return np.full((mesh.n_faces, 3), PLAIN, dtype=np.float64)
    given = np.asarray(values)
    counts = {mesh.n_vertices, mesh.n_faces, mesh.n_polygons}
    if given.ndim not in (1, 2) or len(given) not in counts:
        raise argument(
            f"values have shape {given.shape}, but the mesh has {mesh.n_vertices} vertices, "
            f"{mesh.n_faces} faces and {mesh.n_polygons} polygons"
        )
    if given.ndim == 2 and given.shape[1] != 3:
        raise argument(f"values have shape {given.shape}, but colours are (n, 3), from 0 to 1")
    if len(given) == mesh.n_vertices:
        corners = given[mesh.faces]
        is_label = given.ndim == 1 and given.dtype.kind in "iub"
        at_faces = corners[:, 0] if is_label else corners.mean(axis=1)
    elif len(given) == mesh.n_faces:
        at_faces = given
    else:
        at_faces = given[mesh.polygon_of_face]
    if given.ndim == 2:
        found: Doubles = 255.0 * doubles(at_faces, "colours").clip(0.0, 1.0)
        return found
    if given.dtype.kind in "iub":
        labels = at_faces.astype(np.int64)
        found = PALETTE[labels % len(PALETTE)].astype(np.float64)
        found[labels < 0] = NOTHING
        return found
    return ramp(doubles(at_faces, "values"))


def _has_screen() -> bool:
    """Whether a window can be opened; without X11 and Wayland those packages fail on Linux."""
    return sys.platform != "linux" or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


def plot(mesh: Mesh, values: ArrayLike | None, backend: str | None) -> Any:
    """Shows the mesh in a window or a notebook; see :meth:`Mesh.plot`."""
    if backend is None:
        windows = ("polyscope", "pyvista") if _has_screen() else ()
        backend = next((n for n in windows if importlib.util.find_spec(n)), "png")
    if backend == "png":
        return picture(mesh, values, (480, 480))
    colours = _colours(mesh, values) / 255.0
    if backend == "polyscope":
        import polyscope

        polyscope.init()
        shown = polyscope.register_surface_mesh("mesh", mesh.vertices, mesh.faces)
        shown.add_color_quantity("values", colours, defined_on="faces", enabled=True)
        return polyscope.show()
    if backend == "pyvista":
        import pyvista

        padded = np.insert(mesh.faces.astype(np.int64), 0, 3, axis=1)
        surface = pyvista.PolyData(mesh.vertices, padded.reshape(-1))
        surface.cell_data["values"] = (255 * colours).astype(np.uint8)
        return surface.plot(scalars="values", rgb=True)
    raise argument(f'backend is {backend!r}, but must be "polyscope", "pyvista" or "png"')
