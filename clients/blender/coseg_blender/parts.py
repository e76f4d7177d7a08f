"""Meshes become an object for each part, in steps between which Blender draws and takes input.

A person may change or undo anything between two steps, so what is kept is a copy of the mesh, and names.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bmesh
import bpy
import numpy as np

import coseg
from coseg._instances import instance_numbers

from . import meshes

#: The layer of faces that tells parts while a mesh is separated.
PART = "coseg_part"


class Separation:
    """The mesh of an object on its way to an object for each part instance, such as ``leg.001``."""

    def __init__(self, obj: bpy.types.Object, found: np.ndarray[Any, Any]) -> None:
        """``found`` has the label of each face."""
        mesh = meshes.editable(obj)
        if len(mesh.polygons) != len(found):
            raise meshes.Unusable(
                f"{obj.name} has {len(mesh.polygons)} faces, but {len(found)} labels: send it again"
            )
        self.name = obj.name
        self._sent, self._found = meshes.arrays(obj), found
        self._whole = bmesh.new()
        self._whole.from_mesh(mesh)

    def number(self) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Label and number of each part (p, 2), and the part of each face. Runs in the session's thread."""
        sent, found = self._sent, self._found.astype(np.int64)
        numbers = instance_numbers(sent.vertices, sent.counts, sent.corners, found)
        pairs, of_face = np.unique(np.stack([found, numbers]), axis=1, return_inverse=True)
        return pairs.T, of_face.reshape(-1)

    def steps(
        self, parts: tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]], labels: dict[int, coseg.Label]
    ) -> Iterator[str]:
        """Makes the objects in a collection of their own, and yields how far it is; the mesh stays."""
        pairs, of_face = parts
        layer = self._whole.faces.layers.int.new(PART)
        for face, number in zip(self._whole.faces, of_face.tolist(), strict=True):
            face[layer] = number
        pieces: list[bmesh.types.BMesh] = []
        for piece in divided(self._whole, 0, len(pairs)):
            if piece is not None:
                pieces.append(piece)
            yield f"{len(pieces)} of {len(pairs)} parts"
        # All objects at once: a person sees all or none, and undoes them together.
        self._make(pairs, pieces, labels)

    def _make(
        self,
        pairs: np.ndarray[Any, Any],
        pieces: list[bmesh.types.BMesh],
        labels: dict[int, coseg.Label],
    ) -> None:
        """An object for each piece, in a new collection of the scene."""
        obj = bpy.data.objects.get(self.name)
        if obj is None:
            raise meshes.Unusable(f"{self.name} was removed or renamed while its parts were separated")
        if meshes.digest(*meshes.rings(obj)) != self._sent.digest:
            raise meshes.Unusable(
                f"{self.name} was edited while its parts were separated: separate them again"
            )
        target = bpy.data.collections.new(f"{obj.name} parts")
        bpy.context.scene.collection.children.link(target)
        for (label, number), piece in zip(pairs.tolist(), pieces, strict=True):
            name = f"{meshes.name_of(label, labels)}.{number:03}"
            data = bpy.data.meshes.new(name)
            piece.faces.layers.int.remove(piece.faces.layers.int[PART])
            piece.to_mesh(data)
            piece.free()
            for slot in obj.data.materials:
                data.materials.append(slot)
            made = bpy.data.objects.new(name, data)
            made.matrix_world = obj.matrix_world
            made["label"], made["label_name"] = label, meshes.name_of(label, labels)
            made["instance"] = number
            target.objects.link(made)


def divided(mesh: bmesh.types.BMesh, low: int, high: int) -> Iterator[bmesh.types.BMesh | None]:
    """The parts from ``low`` to below ``high`` of a mesh that has these, by halves: each face is copied
    as often as halving takes, and not once for each part. ``None`` comes where work pauses."""
    if high - low == 1:
        yield mesh
        return
    middle = (low + high) // 2
    second = mesh.copy()
    yield None
    for half, is_first in ((mesh, True), (second, False)):
        layer = half.faces.layers.int[PART]
        others = [face for face in half.faces if (face[layer] < middle) != is_first]
        bmesh.ops.delete(half, geom=others, context="FACES")
        yield None
    yield from divided(mesh, low, middle)
    yield from divided(second, middle, high)
