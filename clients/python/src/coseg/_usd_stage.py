"""Meshes of an OpenUSD stage, as arrays, and where opinions about them are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from coseg import types as t
from coseg._polygons import as_off, backwards
from coseg.errors import CosegError

Array = np.ndarray[Any, Any]

#: Characters of a shape's name at most.
MAX_NAME = 255
AXES = {
    sign + name: np.eye(3)[i] * (1 if sign == "+" else -1) for i, name in enumerate("xyz") for sign in "+-"
}


@dataclass
class MeshShape:
    """A mesh of a stage. Instances of one prototype share one."""

    #: The name of its shape.
    name: str
    #: Its prim; of an instance a proxy.
    prim: Any
    #: Where opinions about it are written.
    site: Any
    #: (n, 3) positions in the space of the stage, in metres.
    vertices: Array
    #: Corners of each face, and their vertices.
    counts: Array
    corners: Array
    #: Prims that have its labels with it.
    instances: list[str] = field(default_factory=list)

    def encoded(self, turn: Array) -> t.Encoded | tuple[Any, Any]:
        """The mesh as it is sent."""
        vertices = self.vertices @ turn.T
        if len(set(self.counts.tolist())) == 1 and self.counts[0] >= 3:
            return vertices, self.corners.reshape(len(self.counts), -1)
        return as_off(vertices, self.counts, self.corners)


class Sites:
    """Where opinions about prims are written in a layer over a stage.

    An opinion about a prim within an instance has no effect. So each prototype has a class in the layer,
    from which its instances inherit: they keep sharing one prototype, which has these opinions.
    """

    def __init__(self, stage: Any) -> None:
        self._stage = stage
        self._classes: dict[Any, Any] = {}
        #: Paths in the layer that inherit from a class, with the class.
        self.inherits: list[tuple[Any, Any]] = []
        self._done: set[Any] = set()

    def of(self, prim: Any) -> Any:
        """The path in the layer for a prim."""
        instance = prim
        while not instance.IsPseudoRoot() and not instance.IsInstance():
            instance = instance.GetParent()
        if instance.IsPseudoRoot():
            return prim.GetPath()
        root = self._class(instance)
        relative = prim.GetPath().MakeRelativePath(instance.GetPath())
        return root if prim == instance else root.AppendPath(relative)

    def _class(self, instance: Any) -> Any:
        prototype = instance.GetPrototype().GetPath()
        if prototype not in self._classes:
            number = len(self._classes) + 1
            while self._stage.GetPrimAtPath(f"/coseg_labels_{number}"):
                number += 1
            self._classes[prototype] = Sdf.Path(f"/coseg_labels_{number}")
        root = self._classes[prototype]
        parent = instance.GetParent()
        outer = self.of(parent) if not parent.IsPseudoRoot() else Sdf.Path.absoluteRootPath
        site = outer.AppendChild(instance.GetName())
        if site not in self._done:
            self._done.add(site)
            self.inherits.append((site, root))
        return root


def meshes(stage: Any, prefix: str) -> tuple[list[MeshShape], Sites, dict[str, str]]:
    """The meshes of a stage with the purposes ``default`` and ``render``, in the order of the stage, and why
    others are left out. Values are those at the default time, or at the first one if there is none."""
    found: dict[Any, MeshShape] = {}
    errors: dict[str, str] = {}
    sites = Sites(stage)
    transforms = UsdGeom.XformCache(Usd.TimeCode.Default())
    metres = UsdGeom.GetStageMetersPerUnit(stage)
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Mesh):
            continue
        purpose = UsdGeom.Imageable(prim).ComputePurpose()
        if purpose not in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
            continue
        path, site = str(prim.GetPath()), sites.of(prim)
        if site in found:
            found[site].instances.append(path)
            continue
        name = prefix + path.lstrip("/").replace("/", ".")
        try:
            if len(name) > MAX_NAME:
                raise CosegError(f"its name has {len(name)} characters, but at most {MAX_NAME} are allowed")
            arrays = _arrays(prim, transforms.GetLocalToWorldTransform(prim), metres)
        except CosegError as e:
            errors[path] = str(e)
            continue
        found[site] = MeshShape(name, prim, site, *arrays, [path])
    return list(found.values()), sites, errors


def _arrays(prim: Any, matrix: Any, metres: float) -> tuple[Array, Array, Array]:
    mesh = UsdGeom.Mesh(prim)

    def value(attribute: Any) -> Any:
        at_default = attribute.Get(Usd.TimeCode.Default())
        return at_default if at_default is not None else attribute.Get(Usd.TimeCode.EarliestTime())

    points = value(mesh.GetPointsAttr())
    counts = np.array(value(mesh.GetFaceVertexCountsAttr()) or [], np.int64)
    corners = np.array(value(mesh.GetFaceVertexIndicesAttr()) or [], np.int64)
    if points is None or not len(points) or not len(counts):
        raise CosegError("it has no points or no faces")
    if counts.min() < 1 or counts.sum() != len(corners):
        text = (
            f"its counts sum up to {counts.sum()} from {counts.min()} on, but it has {len(corners)} indices"
        )
        raise CosegError(text)
    if not 0 <= corners.min() <= corners.max() < len(points):
        bad = corners.min() if corners.min() < 0 else corners.max()
        raise CosegError(f"a face names point {bad}, but it has {len(points)}")
    linear = np.array(matrix)
    vertices = (np.array(points, np.float64) @ linear[:3, :3] + linear[3, :3]) * metres
    if not np.isfinite(vertices[corners]).all():
        raise CosegError("a point of a face is not finite")
    left_handed = value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
    if left_handed != (np.linalg.det(linear[:3, :3]) < 0):
        corners = backwards(counts, corners)
    return vertices, counts, corners


def turn(up: str, wanted: str) -> Array:
    """The rotation from one axis to another; none if the wanted one is not an axis."""
    if wanted not in AXES or up == wanted:
        return np.eye(3)
    a, b = AXES[up], AXES[wanted]
    if np.array_equal(a, -b):
        # Half a turn about another axis.
        other = np.roll(np.abs(a), 1)
        half: Array = 2 * np.outer(other, other) - np.eye(3)
        return half
    axis = np.cross(a, b)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn: Array = np.eye(3) + k + k @ k
    return turn
