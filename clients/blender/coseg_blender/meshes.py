"""Meshes of Blender become arrays, and labels become an attribute, materials and parts.

The mesh that is sent and labelled is the object's own, in its rest shape: without modifiers, since labels
belong to the faces that a person edits and modifiers make others of them, and as the first shape key has it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import bmesh
import bpy
import numpy as np

import coseg
from coseg._polygons import as_off, backwards

#: The attribute of faces that holds labels; -1 for none.
ATTRIBUTE = "coseg_label"
#: The attribute of faces that keeps the material they had before they showed labels.
OWN_MATERIAL = "coseg_own_material"
#: Properties of a mesh: the shape that it is, its collection, and a digest of the faces that were sent.
SHAPE, COLLECTION, FACES = "coseg_shape", "coseg_collection", "coseg_faces"
#: Property of a material: the label that it shows.
LABEL = "coseg_label"
UNLABELLED = (0.5, 0.5, 0.5)


class Unusable(coseg.CosegError):
    """An object that cannot be labelled, and why."""


@dataclass
class Arrays:
    """The mesh of an object, in the space of the scene."""

    vertices: np.ndarray[Any, Any]
    counts: np.ndarray[Any, Any]
    corners: np.ndarray[Any, Any]
    #: Of the faces as they are in the object.
    digest: str

    def encoded(self) -> coseg.Encoded:
        """The mesh as it is sent."""
        return as_off(self.vertices, self.counts, self.corners)


def arrays(obj: bpy.types.Object) -> Arrays:
    """The mesh of an object, n-gons as they are."""
    mesh = editable(obj)
    counts, corners = rings(obj)
    if not mesh.polygons:
        raise Unusable(f"{obj.name} has no faces")
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    rest = mesh.shape_keys.reference_key.data if mesh.shape_keys else mesh.vertices
    rest.foreach_get("co", vertices)
    matrix = np.array(obj.matrix_world, float)
    placed = vertices.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    turned = backwards(counts, corners) if mirrored else corners
    return Arrays(placed, counts, turned, digest(counts, corners))


def rings(obj: bpy.types.Object) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Corners of each face, and their vertices."""
    mesh = obj.data
    if obj.mode == "EDIT":
        obj.update_from_editmode()
    counts = np.empty(len(mesh.polygons), np.int32)
    mesh.polygons.foreach_get("loop_total", counts)
    corners = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    return counts.astype(np.int64), corners.astype(np.int64)


def digest(counts: np.ndarray[Any, Any], corners: np.ndarray[Any, Any]) -> str:
    """Tells whether faces are those that were sent, in their order."""
    return hashlib.blake2b(counts.tobytes() + corners.tobytes(), digest_size=16).hexdigest()


def check_faces(obj: bpy.types.Object) -> None:
    """Refuses a mesh whose faces are others than those that were sent."""
    if obj.data.get(FACES) != digest(*rings(obj)):
        raise Unusable(f"the faces of {obj.name} have changed since it was sent: send it again")


def editable(obj: bpy.types.Object) -> bpy.types.Mesh:
    """The mesh of an object, if labels can be put there."""
    if obj.type != "MESH":
        raise Unusable(f"{obj.name} is no mesh, but {obj.type.lower()}: convert it to a mesh first")
    if obj.data.library is not None:
        raise Unusable(
            f"the mesh of {obj.name} is linked from {obj.data.library.filepath}: make it local first"
        )
    return obj.data


def one_of_each_mesh(objects: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Objects without those that share their mesh with one before them: labels belong to meshes."""
    seen: dict[Any, bpy.types.Object] = {}
    for obj in objects:
        seen.setdefault(obj.data, obj)
    return list(seen.values())


def free_copies(objects: list[bpy.types.Object]) -> None:
    """Makes copies of meshes that are shapes, which have their properties, shapes of their own."""
    for obj in objects:
        shape = obj.data.get(SHAPE)
        if shape is None or obj.data.library is not None:
            continue
        same = [m for m in bpy.data.meshes if m.get(SHAPE) == shape and m.library is None]
        same = [m for m in same if m.get(COLLECTION) == obj.data.get(COLLECTION)]
        named = [o.data for o in bpy.data.objects if o.name == shape and o.data in same]
        if obj.data != (named or same)[0]:
            for name in (SHAPE, COLLECTION, FACES):
                obj.data.pop(name, None)


def shape_name(obj: bpy.types.Object) -> str:
    """The name of the shape that the mesh of an object is, or becomes."""
    name: str = obj.data.get(SHAPE) or obj.name.replace("/", "|")
    return name


def shapes_of(collection: str) -> list[bpy.types.Object]:
    """An object for each mesh that is a shape of a collection."""
    objects = [o for o in bpy.data.objects if o.type == "MESH" and o.data.get(COLLECTION) == collection]
    return one_of_each_mesh(objects)


def colour_of(label: coseg.Label) -> tuple[float, ...]:
    """The colour of a label, in linear light."""
    channels = [label.colour_rgb >> shift & 255 for shift in (16, 8, 0)]
    srgb = [c / 255 for c in channels]
    return tuple(c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb)


def name_of(label: int, labels: dict[int, coseg.Label]) -> str:
    """The name of a label as exports have it."""
    if label < 0:
        return "unlabelled"
    known = labels.get(label)
    return known.name if known and known.name else f"label_{label}"


def material(label: int, collection: str, labels: dict[int, coseg.Label]) -> bpy.types.Material:
    """The material of a label, made if it is missing, in its colour."""
    known = labels.get(label)
    name = name_of(label, labels)
    rgb = colour_of(known) if known else UNLABELLED
    for found in bpy.data.materials:
        if found.get(LABEL) == label and found.get(COLLECTION) == collection and found.library is None:
            break
    else:
        found = bpy.data.materials.new(name)
        found[LABEL], found[COLLECTION] = label, collection
    found.name = name
    found.diffuse_color = (*rgb, 1.0)
    if found.node_tree is None:
        found.use_nodes = True
    for node in found.node_tree.nodes:
        if node.type == "BSDF_PRINCIPLED":
            node.inputs["Base Color"].default_value = (*rgb, 1.0)
    return found


def show(
    obj: bpy.types.Object, collection: str, found: np.ndarray[Any, Any], labels: dict[int, coseg.Label]
) -> None:
    """Puts labels on the faces of a mesh: the attribute, and materials in the colours of the labels."""
    mesh = editable(obj)
    check_faces(obj)
    if len(mesh.polygons) != len(found):
        raise Unusable(
            f"{obj.name} has {len(mesh.polygons)} faces, but its shape {len(found)}: send it again"
        )
    slots = {}
    for label in np.unique(found).tolist():
        wanted = material(label, collection, labels)
        index = mesh.materials.find(wanted.name)
        if index < 0:
            if not mesh.materials and not slots:
                # Faces without a material have the index of the first slot, which must stay theirs.
                mesh.materials.append(None)
            mesh.materials.append(wanted)
            index = len(mesh.materials) - 1
        slots[label] = index
    own = ints(obj, OWN_MATERIAL)
    shown = material_indices(obj)
    is_label = np.array([slot is not None and LABEL in slot for slot in mesh.materials] or [False])
    if own is None:
        own = shown
    else:
        # Faces that were given another material since.
        changed = ~is_label[np.minimum(shown, len(is_label) - 1)]
        own = np.where(changed, shown, own)
    write(obj, OWN_MATERIAL, own)
    write(obj, ATTRIBUTE, found)
    set_materials(obj, np.array([slots[label] for label in found.tolist()], np.int32))


def show_own_materials(obj: bpy.types.Object) -> None:
    """Gives faces back the materials that they had."""
    own = ints(obj, OWN_MATERIAL)
    if own is not None:
        set_materials(obj, own)


def labels_by_material(obj: bpy.types.Object) -> np.ndarray[Any, Any]:
    """The label that the material of each face shows; -1 for other materials."""
    mesh = editable(obj)
    of_slot = [-1 if slot is None else int(slot.get(LABEL, -1)) for slot in mesh.materials] or [-1]
    shown = material_indices(obj)
    return np.array(of_slot, np.int32)[np.minimum(shown, len(of_slot) - 1)]


def selected_faces(obj: bpy.types.Object) -> np.ndarray[Any, Any]:
    """Faces that are selected."""
    mesh = editable(obj)
    if obj.mode == "EDIT":
        obj.update_from_editmode()
    selected = np.empty(len(mesh.polygons), bool)
    mesh.polygons.foreach_get("select", selected)
    return np.flatnonzero(selected)


def select_faces(obj: bpy.types.Object, faces: np.ndarray[Any, Any]) -> None:
    """Selects these faces alone."""
    chosen = np.zeros(len(obj.data.polygons), bool)
    if len(faces) and faces.max() >= len(chosen):
        raise Unusable(f"{obj.name} has {len(chosen)} faces, but its shape has more: send it again")
    chosen[faces] = True
    if obj.mode == "EDIT":
        edited = bmesh.from_edit_mesh(obj.data)
        for face, is_chosen in zip(edited.faces, chosen.tolist(), strict=True):
            face.select_set(is_chosen)
        bmesh.update_edit_mesh(obj.data)
        return
    # Selected edges and vertices would select their faces when the mesh is edited.
    # (MeshEdges.foreach_set crashes Blender 5.0 for them; without the attribute none is selected.)
    for name in (".select_vert", ".select_edge"):
        attribute = obj.data.attributes.get(name)
        if attribute is not None:
            obj.data.attributes.remove(attribute)
    obj.data.polygons.foreach_set("select", chosen)
    obj.data.update()


def ints(obj: bpy.types.Object, name: str) -> np.ndarray[Any, Any] | None:
    """An attribute of faces, if the mesh has it."""
    if obj.mode == "EDIT":
        # Attributes of an edited mesh are in its BMesh alone.
        edited = bmesh.from_edit_mesh(obj.data)
        layer = edited.faces.layers.int.get(name)
        return None if layer is None else np.array([face[layer] for face in edited.faces], np.int32)
    attribute = obj.data.attributes.get(name)
    if attribute is None or attribute.domain != "FACE" or attribute.data_type != "INT":
        return None
    values = np.empty(len(obj.data.polygons), np.int32)
    attribute.data.foreach_get("value", values)
    return values


def write(obj: bpy.types.Object, name: str, values: np.ndarray[Any, Any]) -> None:
    """Writes an attribute of faces; an edited mesh keeps its selection."""
    mesh = obj.data
    if obj.mode == "EDIT":
        edited = bmesh.from_edit_mesh(mesh)
        layers = edited.faces.layers.int
        layer = layers.get(name) or layers.new(name)
        for face, value in zip(edited.faces, values.tolist(), strict=True):
            face[layer] = value
        bmesh.update_edit_mesh(mesh)
        return
    attribute = mesh.attributes.get(name)
    if attribute is not None and (attribute.domain != "FACE" or attribute.data_type != "INT"):
        mesh.attributes.remove(attribute)
        attribute = None
    if attribute is None:
        attribute = mesh.attributes.new(name, "INT", "FACE")
    attribute.data.foreach_set("value", values.astype(np.int32))
    mesh.update()


def material_indices(obj: bpy.types.Object) -> np.ndarray[Any, Any]:
    """The material slot of each face."""
    if obj.mode == "EDIT":
        obj.update_from_editmode()
    values = np.empty(len(obj.data.polygons), np.int32)
    obj.data.polygons.foreach_get("material_index", values)
    return values


def set_materials(obj: bpy.types.Object, slots: np.ndarray[Any, Any]) -> None:
    """Gives each face a material slot."""
    if obj.mode == "EDIT":
        edited = bmesh.from_edit_mesh(obj.data)
        for face, slot in zip(edited.faces, slots.tolist(), strict=True):
            face.material_index = slot
        bmesh.update_edit_mesh(obj.data)
        return
    obj.data.polygons.foreach_set("material_index", slots.astype(np.int32))
    obj.data.update()
