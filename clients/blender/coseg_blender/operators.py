"""What the panel does: each operator reads the scene, hands work to the session, and takes up its result."""

from __future__ import annotations

from functools import partial
from typing import Any

import bpy
import numpy as np

import coseg
from coseg.types import Question

from . import meshes
from .parts import Separation
from .session import current

#: Labels that a part has with less probability are not named in a question.
LIKELY = 0.01


def labels_menu(_self: Any, _context: Any) -> list[tuple[str, str, str]]:
    """Labels in use, for menus; Blender needs the texts to stay alive."""
    in_use = [label for label in current.labels if label.merged_into is None]
    menu = [(str(label.id), label.name or f"label_{label.id}", "") for label in in_use]
    labels_menu.kept = menu or [("-1", "no labels yet", "")]  # type: ignore[attr-defined]
    return labels_menu.kept  # type: ignore[attr-defined, no-any-return]


def fetch_menu(settings: Any, _context: Any) -> None:
    """Fetches the labels of another collection for the menu."""
    current.labels, current.question = [], None
    if current.library is not None:
        name = settings.collection
        current.submit("fetching labels", lambda: labels_in(name), take_up_menu)


def labels_in(collection: str) -> list[coseg.Label]:
    """Labels of a collection, which may not exist yet. Runs in the session's thread."""
    try:
        return list(current.collection(collection).info().labels)
    except coseg.NotFound:
        return []


def take_up_menu(labels: list[coseg.Label]) -> None:
    """Shows labels in the menu."""
    current.labels = labels


class Settings(bpy.types.PropertyGroup):
    """What a scene keeps of the panel."""

    endpoint: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Endpoint", description="Of the daemon; empty: your own one, started if none answers"
    )
    collection: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Collection",
        description="Shapes of one class, which share labels",
        default="shapes",
        update=fetch_menu,
    )
    parts: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Part kinds", description="Of a new collection; 0: estimated", default=0, min=0, max=64
    )
    label: bpy.props.EnumProperty(name="Label", items=labels_menu)  # type: ignore[valid-type]
    new_label: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="New label", description="Name of a new label, in place of the one of the menu"
    )


def settings() -> Any:
    """Of the scene."""
    return bpy.context.scene.coseg


def library_folder() -> str:
    """Where a daemon that is started here keeps its library."""
    try:
        return bpy.utils.extension_path_user(__package__, path="library", create=True)
    except ValueError:
        # The package is not installed as an extension.
        return bpy.utils.user_resource("DATAFILES", path="coseg", create=True)


def fetch(collection: coseg.Collection, names: list[str]) -> tuple[list[coseg.Label], dict[str, Any]]:
    """Labels of a collection and of some of its shapes. Runs in the session's thread."""
    collection.wait_idle()
    known = {shape.name for shape in collection.shapes()}
    return list(collection.info().labels), {n: collection.labels(n) for n in names if n in known}


def take_up(collection: str, result: tuple[list[coseg.Label], dict[str, Any]]) -> None:
    """Shows labels on the meshes that are shapes of a collection."""
    current.labels, found = result
    by_id = {label.id: label for label in current.labels}
    failed = []
    for obj in meshes.shapes_of(collection):
        labels = found.get(meshes.shape_name(obj))
        if labels is not None:
            try:
                meshes.show(obj, collection, labels, by_id)
            except meshes.Unusable as e:
                failed.append(str(e))
    if failed:
        raise coseg.CosegError("; ".join(failed))


def selected_meshes(context: Any) -> list[bpy.types.Object]:
    """Objects with meshes that are selected, or in a collection whose instance is."""
    found = []
    for obj in context.view_layer.objects.selected:
        instanced = obj.instance_collection if obj.instance_type == "COLLECTION" else None
        found += [o for o in (instanced.all_objects if instanced else [obj]) if o.type == "MESH"]
    return found


class Step(bpy.types.Operator):
    """An operator that reports errors and needs a connection."""

    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return current.library is not None

    def execute(self, context: Any) -> set[str]:
        try:
            self.begin(context)
        except coseg.CosegError as e:
            current.error = str(e)
            self.report({"WARNING"}, str(e))
            return {"CANCELLED"}
        return {"FINISHED"}

    def begin(self, context: Any) -> None:
        """Hands work to the session."""
        raise NotImplementedError


class Connect(Step):
    """Connect to a daemon, which is started if none answers"""

    bl_idname = "coseg.connect"
    bl_label = "Connect"

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return True

    def begin(self, _context: Any) -> None:
        endpoint, name, folder = settings().endpoint, settings().collection, library_folder()

        def work() -> list[coseg.Label]:
            current.connect(endpoint, folder)
            return labels_in(name)

        def done(labels: list[coseg.Label]) -> None:
            take_up_menu(labels)
            current.message = "connected"

        current.submit("connecting", work, done)


class Send(Step):
    """Send the meshes of selected objects, also again after an edit, and show their labels"""

    bl_idname = "coseg.send"
    bl_label = "Send Selected"

    def begin(self, context: Any) -> None:
        name, parts = settings().collection, settings().parts
        objects = meshes.one_of_each_mesh(selected_meshes(context))
        if not objects:
            raise coseg.CosegError("select objects with meshes first")
        meshes.free_copies(objects)
        for obj in objects:
            if obj.data.get(meshes.COLLECTION, name) != name:
                raise coseg.CosegError(f"{obj.name} is a shape of {obj.data[meshes.COLLECTION]!r} already")
        # An object that cannot be sent is reported before any is.
        sent = {meshes.shape_name(o): meshes.arrays(o) for o in objects}
        if len(sent) < len(objects):
            raise coseg.CosegError("an object has the name of another one's shape: rename it")
        # Blender may put other meshes in the place of these while the work goes on, by an undo.
        mesh_names = {meshes.shape_name(o): o.data.name for o in objects}
        replaced = {meshes.shape_name(o) for o in objects if meshes.SHAPE in o.data}

        def work() -> tuple[dict[str, str], Any]:
            collection, errors, n = current.collection(name, parts), {}, 0
            for again in (False, True):
                items = [(s, a.encoded()) for s, a in sent.items() if (s in replaced) == again]
                # A mesh that is new here does not replace a shape of another file.
                for added in collection.add_many(items, replace=again):
                    n += 1
                    current.progress = f"{n} of {len(sent)}"
                    if added.error is not None:
                        errors[added.name] = reason(added.error, again)
            return errors, fetch(collection, [*sent, *others])

        def done(result: tuple[dict[str, str], Any]) -> None:
            errors, found = result
            for shape in found[1].keys() & sent.keys() - errors.keys():
                mesh = bpy.data.meshes.get(mesh_names[shape])
                if mesh is not None:
                    mesh[meshes.SHAPE], mesh[meshes.COLLECTION] = shape, name
                    mesh[meshes.FACES] = sent[shape].digest
            take_up(name, found)
            if errors:
                raise coseg.CosegError("; ".join(f"{shape}: {e}" for shape, e in errors.items()))
            current.message = f"{len(sent)} shapes labelled"

        others = [meshes.shape_name(o) for o in meshes.shapes_of(name)]
        current.submit(f"labelling {len(sent)} shapes", work, done)


def reason(error: coseg.CosegError, again: bool) -> str:
    """Why a mesh was not added."""
    if isinstance(error, coseg.AlreadyExists) and not again:
        return "the collection has another shape of this name: rename the object"
    return str(error)


class Refresh(Step):
    """Show the newest labels on all meshes of the collection"""

    bl_idname = "coseg.refresh"
    bl_label = "Refresh Labels"

    def begin(self, _context: Any) -> None:
        change("fetching labels", lambda _collection: None)


def change(doing: str, work: Any, message: str = "") -> None:
    """Changes a collection by ``work``, and shows its labels then."""
    name = settings().collection
    names = [meshes.shape_name(obj) for obj in meshes.shapes_of(name)]

    def both() -> Any:
        collection = current.collection(name)
        work(collection)
        return fetch(collection, names)

    def done(found: Any) -> None:
        take_up(name, found)
        current.message = message

    current.submit(doing, both, done)


def chosen_label(collection: coseg.Collection, label: int, new: str) -> int:
    """The label of the menu, or a new one. Runs in the session's thread."""
    if not new:
        if label < 0:
            raise coseg.CosegError("there are no labels yet: name a new one")
        return label
    known = collection.info().labels
    by_name = {k.name: k.id for k in known if k.merged_into is None and k.name}
    return by_name.get(new, max([-1, *(k.id for k in known)]) + 1)


def active_shape(context: Any) -> bpy.types.Object:
    """The active object, if its mesh is a shape of the collection."""
    obj = context.view_layer.objects.active
    if obj is None or obj.type != "MESH" or obj.data.get(meshes.COLLECTION) != settings().collection:
        raise coseg.CosegError(f"the active object is no shape of {settings().collection!r}: send it first")
    return obj


def labels_of(obj: bpy.types.Object) -> np.ndarray[Any, Any]:
    """The labels that a mesh has."""
    labels = meshes.ints(obj, meshes.ATTRIBUTE)
    if labels is None:
        raise coseg.CosegError(f"{obj.name} has no labels: send it first")
    return labels


def unchanged(obj: bpy.types.Object) -> np.ndarray[Any, Any]:
    """The labels of a mesh, which has the faces that it was labelled with."""
    meshes.check_faces(obj)
    return labels_of(obj)


class CorrectSelected(Step):
    """Give the selected faces of the active object the label; other shapes follow"""

    bl_idname = "coseg.correct_selected"
    bl_label = "Correct Selected Faces"

    def begin(self, context: Any) -> None:
        obj = active_shape(context)
        unchanged(obj)
        faces, shape, n_faces = meshes.selected_faces(obj), meshes.shape_name(obj), len(obj.data.polygons)
        if not len(faces):
            raise coseg.CosegError(f"no face of {obj.name} is selected")
        label, new = int(settings().label or -1), settings().new_label.strip()

        def work(collection: coseg.Collection) -> None:
            check_faces(collection, shape, n_faces)
            wanted = chosen_label(collection, label, new)
            collection.correct(shape, faces=faces, label=wanted)
            if new:
                collection.name_label(wanted, new)

        change(f"correcting {len(faces)} faces", work, f"{len(faces)} faces corrected")
        settings().new_label = ""


class CorrectByMaterials(Step):
    """Correct the faces of the active object whose material shows another label than they have"""

    bl_idname = "coseg.correct_by_materials"
    bl_label = "Correct by Materials"

    def begin(self, context: Any) -> None:
        obj = active_shape(context)
        before, after = unchanged(obj), meshes.labels_by_material(obj)
        after[after == before] = -1
        shape, n = meshes.shape_name(obj), int((after >= 0).sum())
        if not n:
            raise coseg.CosegError(f"the materials of {obj.name} show the labels that it has")

        def work(collection: coseg.Collection) -> None:
            check_faces(collection, shape, len(after))
            collection.correct(shape, after)

        change(f"correcting {n} faces", work, f"{n} faces corrected")


def check_faces(collection: coseg.Collection, shape: str, n_faces: int) -> None:
    """Whether the daemon has the faces of a mesh. Runs in the session's thread."""
    n = collection.shape(shape).n_polygons
    if n != n_faces:
        raise coseg.CosegError(f"{shape} has {n_faces} faces, but was sent with {n}: send it again")


class Undo(Step):
    """Take back the newest correction"""

    bl_idname = "coseg.undo"
    bl_label = "Undo Correction"

    def begin(self, _context: Any) -> None:
        change("undoing", lambda collection: collection.undo(), "undone")


class Suggest(Step):
    """Select the shape that is most worth correcting"""

    bl_idname = "coseg.suggest"
    bl_label = "Suggest Next"

    def begin(self, _context: Any) -> None:
        name = settings().collection

        def done(suggestion: coseg.Suggestion | None) -> None:
            if suggestion is None:
                current.message = "nothing to suggest"
                return
            current.message = f"{suggestion.shape}: {suggestion.reason}"
            for obj in meshes.shapes_of(name):
                if meshes.shape_name(obj) == suggestion.shape:
                    for other in bpy.context.view_layer.objects:
                        other.select_set(other == obj)
                    bpy.context.view_layer.objects.active = obj

        current.submit("looking for a shape", lambda: current.collection(name).suggest(), done)


class Ask(Step):
    """Ask for the label of the part that is most worth knowing, with its faces selected"""

    bl_idname = "coseg.ask"
    bl_label = "Ask"

    def begin(self, _context: Any) -> None:
        name = settings().collection
        current.submit("looking for a question", lambda: current.collection(name).ask(), show_question)


def show_question(question: Question | None) -> None:
    """Selects the part that a question is about, and the label that is likeliest."""
    current.question = question
    if question is None:
        current.message = "nothing to ask"
        return
    for obj in meshes.shapes_of(settings().collection):
        if meshes.shape_name(obj) == question.shape:
            break
    else:
        raise coseg.CosegError(f"the question is about {question.shape}, which is not in this file")
    for other in bpy.context.view_layer.objects:
        other.select_set(other == obj)
    bpy.context.view_layer.objects.active = obj
    meshes.select_faces(obj, question.faces)
    likely = [o for o in question.likeliest if o.probability >= LIKELY]
    offered = ", ".join(f"{o.name or f'label_{o.label}'} {o.probability:.0%}" for o in likely)
    current.message = f"which label has this part of {question.shape}? {offered}"
    if question.likeliest:
        settings().label = str(question.likeliest[0].label)


class QuestionStep(Step):
    """An operator that needs a question. Blender loses a class that a registered one inherits from."""

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return current.library is not None and current.question is not None


class Answer(QuestionStep):
    """Give the part in question the label of the menu, or the new one"""

    bl_idname = "coseg.answer"
    bl_label = "Answer"

    def begin(self, _context: Any) -> None:
        question, label, new = current.question, int(settings().label or -1), settings().new_label.strip()
        assert question is not None
        given: dict[str, Any] = {"new": new} if new else {"label": label}
        if not new and label < 0:
            raise coseg.CosegError("there are no labels yet: name a new one")
        respond(question, given, "answered")
        settings().new_label = ""


class Skip(QuestionStep):
    """Pass over the question"""

    bl_idname = "coseg.skip"
    bl_label = "Skip"

    def begin(self, _context: Any) -> None:
        assert current.question is not None
        respond(current.question, {"skip": True}, "skipped")


def respond(question: Question, given: dict[str, Any], message: str) -> None:
    """Answers a question, which is none any more."""
    current.question = None
    change("answering", lambda c: c.answer(question.shape, question.part, **given), message)


class CutWrongly(QuestionStep):
    """Say that the part in question is not one part, or not a whole one"""

    bl_idname = "coseg.cut_wrongly"
    bl_label = "Cut Wrongly"

    def begin(self, _context: Any) -> None:
        assert current.question is not None
        respond(current.question, {"cut_wrongly": True}, "noted")


class Separate(Step):
    """Make an object of each part of the selected objects, in a collection of their own"""

    bl_idname = "coseg.separate"
    bl_label = "Separate Parts"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.mode == "OBJECT"

    def begin(self, context: Any) -> None:
        by_id = {label.id: label for label in current.labels}
        # A mesh that has no labels is reported before any is separated.
        for one in [Separation(obj, labels_of(obj)) for obj in selected_meshes(context)]:
            current.submit(f"separating {one.name}", one.number, partial(one.steps, labels=by_id))


class OwnMaterials(Step):
    """Show the own materials of the selected objects in place of those of their labels"""

    bl_idname = "coseg.own_materials"
    bl_label = "Own Materials"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, _context: Any) -> bool:
        return True

    def begin(self, context: Any) -> None:
        for obj in selected_meshes(context):
            meshes.show_own_materials(obj)


CLASSES = (
    Settings,
    Connect,
    Send,
    Refresh,
    CorrectSelected,
    CorrectByMaterials,
    Undo,
    Suggest,
    Ask,
    Answer,
    Skip,
    CutWrongly,
    Separate,
    OwnMaterials,
)


def register() -> None:
    """Adds the operators, and what a scene keeps."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.coseg = bpy.props.PointerProperty(type=Settings)


def unregister() -> None:
    """Takes them away."""
    del bpy.types.Scene.coseg
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
