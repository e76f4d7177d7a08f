"""The extension in Blender without a window (``bpy``), against a real daemon."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender as a module: pip install bpy")
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

import numpy as np  # noqa: E402

import coseg  # noqa: E402
import coseg_blender  # noqa: E402
from coseg_blender import meshes, operators, panel  # noqa: E402
from coseg_blender.session import current, daemon_binary  # noqa: E402

QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]


def boxes(seat: float, back: float) -> tuple[list[Any], list[Any]]:
    """A chair of boxes, whose last one is closed by an n-gon of eight corners."""
    legs = [((x, y, 0), (x + 0.1, y + 0.1, seat)) for x in (0, 0.9) for y in (0, 0.9)]
    parts = [*legs, ((0, 0, seat), (1, 1, seat + 0.1)), ((0, 0.9, seat + 0.1), (1, 1, seat + back))]
    vertices, faces = [], []
    for low, high in parts:
        n = len(vertices)
        vertices += [tuple((high if i >> k & 1 else low)[k] for k in range(3)) for i in range(8)]
        faces += [tuple(n + c for c in quad) for quad in QUADS]
    n = len(vertices)
    ring = [(np.cos(a), np.sin(a)) for a in np.arange(8) * np.pi / 4]
    vertices += [(0.5 + 0.1 * x, 0.95, seat + back + 0.1 + 0.1 * y) for x, y in ring]
    faces.append(tuple(range(n, n + 8)))
    return vertices, faces


def chair(name: str, seat: float = 0.5, back: float = 1.0) -> Any:
    vertices, faces = boxes(seat, back)
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices, [], faces)
    obj = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def select(*objects: Any) -> None:
    # Objects that are new come to the layer with an update.
    bpy.context.view_layer.update()
    for obj in bpy.context.view_layer.objects:
        obj.select_set(obj in objects)
    bpy.context.view_layer.objects.active = objects[0]


def settle() -> None:
    """Waits until nothing is under way."""
    end = time.monotonic() + 120
    while current.pump():
        assert time.monotonic() < end
        time.sleep(0.02)


def run(operator: Any, *, fails: str = "") -> None:
    """Runs an operator and takes up its result, as the timer does in a window."""
    finished = operator() == {"FINISHED"}
    settle()
    assert fails in current.error if fails else not current.error, current.error
    assert finished or fails


@pytest.fixture(scope="module", autouse=True)
def extension(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The extension, with a daemon that it has started itself."""
    folder = tmp_path_factory.mktemp("coseg")
    binary = HERE.parents[2] / "target" / "release" / "coseg"
    os.environ["COSEG_BIN"] = os.environ.get("COSEG_BIN", str(binary))
    os.environ["BLENDER_USER_RESOURCES"] = str(folder)
    coseg_blender.register()
    operators.library_folder = lambda: str(folder / "library")
    fresh_scene(f"ipc://{folder}/s")
    run(bpy.ops.coseg.connect)
    assert current.library is not None and current.message == "connected"
    yield
    coseg_blender.unregister()
    with pytest.raises(coseg.NoAnswer):
        coseg.Library(f"ipc://{folder}/s", timeout=0.5).hello()


def fresh_scene(endpoint: str = "", collection: str = "chairs") -> None:
    for obj in list(bpy.data.objects):
        bpy.data.objects.remove(obj)
    bpy.context.view_layer.update()
    bpy.context.scene.coseg.endpoint = endpoint or bpy.context.scene.coseg.endpoint
    bpy.context.scene.coseg.collection = collection
    bpy.context.scene.coseg.parts = 3
    settle()


def labels_of(obj: Any) -> np.ndarray[Any, Any]:
    """Labels by the attribute, which materials must agree with."""
    attribute = obj.data.attributes[meshes.ATTRIBUTE]
    assert (attribute.domain, attribute.data_type) == ("FACE", "INT")
    found = meshes.ints(obj, meshes.ATTRIBUTE)
    assert found is not None and (meshes.labels_by_material(obj) == found).all()
    return found


def of_daemon(obj: Any, collection: str = "chairs") -> np.ndarray[Any, Any]:
    assert current.library is not None
    return current.library.collection(collection).labels(meshes.shape_name(obj))


def imported(folder: Path) -> Any:
    """A chair from a file, whose axes the importer turns."""
    vertices, faces = boxes(0.8, 1.0)
    lines = [f"v {x} {z} {-y}" for x, y, z in vertices]
    lines += ["f " + " ".join(str(v + 1) for v in face) for face in faces]
    (folder / "from a file.obj").write_text("\n".join(lines) + "\n")
    bpy.ops.wm.obj_import(filepath=str(folder / "from a file.obj"))
    return bpy.context.view_layer.objects.active


def test_labels_come_to_faces_as_an_attribute_and_as_materials(tmp_path: Path) -> None:
    fresh_scene(collection="first")
    objects = [chair(f"chair {i}", 0.5 + 0.1 * i) for i in range(2)] + [imported(tmp_path)]
    assert np.isclose(meshes.arrays(objects[2]).vertices[:, 2].max(), 0.8 + 1.0 + 0.2)
    paint = bpy.data.materials.new("paint")
    objects[0].data.materials.append(paint)
    select(*objects)
    run(bpy.ops.coseg.send)
    for obj in objects:
        assert (labels_of(obj) == of_daemon(obj, "first")).all()
        assert len(np.unique(labels_of(obj))) == 3
    shown = {slot.name: slot for slot in objects[0].data.materials if slot and meshes.LABEL in slot}
    for label in current.labels:
        colour = meshes.colour_of(label)
        assert np.allclose(shown[f"label_{label.id}"].diffuse_color[:3], colour, atol=1e-6)
    select(objects[0])
    assert bpy.ops.coseg.own_materials() == {"FINISHED"}
    assert {objects[0].data.materials[i] for i in meshes.material_indices(objects[0])} == {paint}
    # Upright as Blender is.
    assert current.library.collection("first").info().up == "+z"


def test_corrections_reach_other_shapes_and_are_undone() -> None:
    fresh_scene(collection="corrected")
    one, two = chair("one"), chair("two", 0.6)
    select(one, two)
    run(bpy.ops.coseg.send)
    before = labels_of(one), labels_of(two)
    legs = np.arange(24)
    for polygon in one.data.polygons:
        polygon.select = polygon.index < 24
    select(one)
    bpy.context.scene.coseg.new_label = "leg"
    run(bpy.ops.coseg.correct_selected)
    leg = next(label for label in current.labels if label.name == "leg")
    assert (labels_of(one)[legs] == leg.id).all()
    assert (labels_of(two) == of_daemon(two, "corrected")).all()
    assert "leg" in {slot.name for slot in one.data.materials if slot}
    # In edit mode, by the menu.
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.scene.coseg.label = str(leg.id)
    run(bpy.ops.coseg.correct_selected)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert (labels_of(one)[legs] == leg.id).all()
    # By a material.
    other = next(label for label in current.labels if label.id != labels_of(one)[30])
    one.data.materials.append(meshes.material(other.id, "corrected", {other.id: other}))
    one.data.polygons[30].material_index = len(one.data.materials) - 1
    run(bpy.ops.coseg.correct_by_materials)
    assert labels_of(one)[30] == other.id
    run(bpy.ops.coseg.correct_by_materials, fails="show the labels that it has")
    for _ in range(4):
        run(bpy.ops.coseg.undo)
    assert (labels_of(one) == before[0]).all() and (labels_of(two) == before[1]).all()
    run(bpy.ops.coseg.undo, fails="undo")
    run(bpy.ops.coseg.suggest)
    assert meshes.shape_name(bpy.context.view_layer.objects.active) in current.message


def test_questions_are_asked_with_the_part_selected() -> None:
    fresh_scene(collection="asked")
    objects = [chair(f"asked {i}", 0.5 + 0.1 * i) for i in range(3)]
    select(*objects)
    run(bpy.ops.coseg.send)
    run(bpy.ops.coseg.ask)
    question = current.question
    assert question is not None and "which label" in current.message
    obj = bpy.context.view_layer.objects.active
    assert meshes.shape_name(obj) == question.shape
    assert meshes.selected_faces(obj).tolist() == sorted(question.faces.tolist())
    bpy.context.scene.coseg.new_label = "rung"
    run(bpy.ops.coseg.answer)
    assert current.question is None
    rung = next(label for label in current.labels if label.name == "rung")
    assert (labels_of(obj)[question.faces] == rung.id).all()
    run(bpy.ops.coseg.ask)
    again = current.question
    run(bpy.ops.coseg.skip)
    run(bpy.ops.coseg.ask)
    after = current.question
    assert again is not None and after is not None
    assert (after.shape, after.part) != (again.shape, again.part)
    run(bpy.ops.coseg.cut_wrongly)
    assert current.question is None and current.message == "noted"
    # Another collection has other labels, and no question.
    run(bpy.ops.coseg.ask)
    bpy.context.scene.coseg.collection = "none yet"
    settle()
    assert current.question is None and current.labels == [] and not current.error
    bpy.context.scene.coseg.collection = "asked"
    settle()
    assert "rung" in {label.name for label in current.labels}
    run(bpy.ops.coseg.refresh)


def test_a_mesh_is_labelled_again_after_an_edit() -> None:
    fresh_scene(collection="edited")
    obj = chair("edited")
    select(obj)
    run(bpy.ops.coseg.send)
    n_faces = len(labels_of(obj))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.subdivide()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(obj.data.polygons) > n_faces
    run(bpy.ops.coseg.correct_selected, fails="send it again")
    run(bpy.ops.coseg.refresh, fails="send it again")
    run(bpy.ops.coseg.send)
    assert len(labels_of(obj)) == len(obj.data.polygons) == len(of_daemon(obj, "edited"))
    # As many faces, but others.
    obj.data.flip_normals()
    obj.data.polygons[0].select = True
    run(bpy.ops.coseg.correct_selected, fails="send it again")
    run(bpy.ops.coseg.send)


def test_copies_are_shapes_of_their_own_and_names_of_others_are_respected() -> None:
    fresh_scene(collection="copied")
    first = chair("first")
    select(first)
    run(bpy.ops.coseg.send)
    copy = first.copy()
    copy.data = first.data.copy()
    bpy.context.scene.collection.objects.link(copy)
    copy.data.vertices[0].co.z -= 0.2
    select(copy)
    run(bpy.ops.coseg.send)
    names = [shape.name for shape in current.library.collection("copied").shapes()]
    assert names == ["first", copy.name] and meshes.shape_name(first) == "first"
    # A mesh of another file, which happens to have a name that is taken.
    fresh_scene(collection="copied")
    before = current.library.collection("copied").original("first")
    other = chair("first", 0.9)
    assert other.name == "first"
    select(other)
    run(bpy.ops.coseg.send, fails="rename the object")
    assert current.library.collection("copied").original("first") == before
    assert meshes.SHAPE not in other.data


def test_parts_become_objects() -> None:
    fresh_scene(collection="separated")
    obj = chair("whole")
    select(obj)
    run(bpy.ops.coseg.send)
    labels = [*np.repeat([0, 0, 0, 0, 1, 2], 6).tolist(), 2]
    current.library.collection("separated").correct("whole", labels)
    current.library.collection("separated").name_label(0, "leg")
    run(bpy.ops.coseg.refresh)
    run(bpy.ops.coseg.separate)
    parts = bpy.data.collections["whole parts"].objects
    # Blender numbers names that are taken.
    found = {part.name[: part.name.index(".") + 4]: len(part.data.polygons) for part in parts}
    assert {name: n for name, n in found.items() if name.startswith("leg")} == {
        f"leg.{i:03}": 6 for i in range(1, 5)
    }
    assert sum(found.values()) == len(obj.data.polygons) == 37
    assert all(part["label"] == 0 for part in parts if part.name.startswith("leg"))


def striped(n: int, n_stripes: int) -> Any:
    """A grid of n × n faces with labels in stripes, which no daemon has given."""
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=n, y_subdivisions=n)
    obj = bpy.context.view_layer.objects.active
    meshes.write(obj, meshes.ATTRIBUTE, np.repeat(np.arange(n) * n_stripes // n, n))
    return obj


def test_separating_leaves_time_to_draw() -> None:
    fresh_scene(collection="large")
    obj = striped(300, 8)
    begin = time.monotonic()
    assert bpy.ops.coseg.separate() == {"FINISHED"}
    assert current.doing == f"separating {obj.name}"
    slices = [time.monotonic() - begin]
    seen = set()
    while True:
        begin = time.monotonic()
        goes_on = current.pump()
        slices.append(time.monotonic() - begin)
        seen.add(current.progress)
        if not goes_on:
            break
        time.sleep(0.001)
    assert not current.error and {"0 of 8 parts", "4 of 8 parts"} <= seen
    assert len(bpy.data.collections[f"{obj.name} parts"].objects) == 8
    # At once it would all be one slice.
    assert max(slices) < sum(slices) / 3, slices


def test_what_happens_to_a_mesh_while_it_is_separated_is_reported() -> None:
    fresh_scene(collection="busy")
    obj, other = striped(10, 2), striped(10, 3)
    select(obj, other)
    assert bpy.ops.coseg.separate() == {"FINISHED"}
    obj.data.flip_normals()
    settle()
    assert f"{obj.name} was edited while" in current.error
    # What waits goes on.
    assert len(bpy.data.collections[f"{other.name} parts"].objects) == 3
    select(obj)
    assert bpy.ops.coseg.separate() == {"FINISHED"}
    bpy.data.objects.remove(obj)
    settle()
    assert "was removed or renamed" in current.error
    bare = chair("bare")
    select(bare, other)
    n = len(bpy.data.collections)
    run(bpy.ops.coseg.separate, fails="bare has no labels")
    assert len(bpy.data.collections) == n


def test_what_is_sent_of_instances_modifiers_shape_keys_and_transforms() -> None:
    fresh_scene(collection="odd")
    one = chair("one of two")
    two = bpy.data.objects.new("two of two", one.data)
    bpy.context.scene.collection.objects.link(two)
    two.location = (5, 0, 0)
    one.modifiers.new("smooth", "SUBSURF").levels = 1
    bpy.context.view_layer.update()
    one.shape_key_add(name="Basis")
    tall = one.shape_key_add(name="tall", from_mix=False)
    for point in tall.data:
        point.co.z *= 3
    tall.value = 1.0
    one.scale = (2, 2, 2)
    bpy.context.view_layer.update()
    select(one, two)
    run(bpy.ops.coseg.send)
    # One shape for one mesh, with its own faces and in its rest shape, as it stands in the scene.
    shapes = list(current.library.collection("odd").shapes())
    assert [shape.name for shape in shapes] == ["one of two"] and shapes[0].n_polygons == 37
    assert (labels_of(two) == labels_of(one)).all()
    sent = meshes.arrays(one)
    assert np.isclose(sent.vertices[:, 2].max(), 2 * (0.5 + 1.0 + 0.2)) and set(sent.counts) == {4, 8}
    # Mirrored, its faces are turned so that they stay outside.
    one.scale = (-2, 2, 2)
    bpy.context.view_layer.update()
    mirrored = meshes.arrays(one)
    assert (mirrored.corners[:4] == sent.corners[:4][::-1]).all() and mirrored.digest == sent.digest
    # Of an instance of a collection, the meshes of the collection.
    inner = bpy.data.collections.new("inner")
    inner.objects.link(chair("inside"))
    instance = bpy.data.objects.new("instance", None)
    instance.instance_type, instance.instance_collection = "COLLECTION", inner
    bpy.context.scene.collection.objects.link(instance)
    select(instance)
    run(bpy.ops.coseg.send)
    assert len(labels_of(bpy.data.objects["inside"])) == 37


def test_what_cannot_be_labelled_says_why(tmp_path: Path) -> None:
    fresh_scene(collection="refused")
    empty = bpy.data.objects.new("empty", bpy.data.meshes.new("empty"))
    bpy.context.scene.collection.objects.link(empty)
    select(empty)
    run(bpy.ops.coseg.send, fails="empty has no faces")
    path = str(tmp_path / "linked.blend")
    bpy.data.libraries.write(path, {chair("linked")}, fake_user=True)
    fresh_scene(collection="refused")
    with bpy.data.libraries.load(path, link=True) as (source, target):
        target.objects = source.objects
    bpy.context.scene.collection.objects.link(target.objects[0])
    select(target.objects[0])
    run(bpy.ops.coseg.send, fails="make it local first")
    for obj in bpy.context.view_layer.objects:
        obj.select_set(False)
    run(bpy.ops.coseg.send, fails="select objects with meshes first")


def test_the_panel_names_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    fresh_scene()
    select(chair("shown"))
    monkeypatch.setattr(current, "error", "a long story " * 10)
    for library in (None, current.library):
        monkeypatch.setattr(current, "library", library)
        layout = MagicMock()
        layout.row.return_value = layout.split.return_value = layout
        panel.Panel.draw(SimpleNamespace(layout=layout), bpy.context)
        names = [call.args[0] for call in layout.operator.call_args_list]
        assert len(names) == (1 if library is None else 13), names
        for name in names:
            assert getattr(bpy.ops.coseg, name.removeprefix("coseg.")).get_rna_type().name
        for call in layout.prop.call_args_list:
            assert call.args[1] in call.args[0].bl_rna.properties
        assert layout.box.return_value.label.call_count > 2


def test_the_interface_is_not_held_up() -> None:
    fresh_scene(collection="async")
    select(chair("slow"))
    begin = time.monotonic()
    assert bpy.ops.coseg.send() == {"FINISHED"}
    assert time.monotonic() - begin < 0.5 and current.doing == "labelling 1 shapes"
    assert bpy.app.timers.is_registered(current._timer)
    run(bpy.ops.coseg.refresh)


def test_the_end_does_not_wait_for_work() -> None:
    from coseg_blender import session

    other = session.Session()
    done: list[int] = []
    other.submit("first", lambda: 1, done.append)
    while other.pump():
        time.sleep(0.01)
    assert done == [1]
    release = threading.Event()
    other.submit("long", release.wait, lambda _: done.append(2))
    other.submit("never", lambda: done.append(3), lambda _: None)
    begin = time.monotonic()
    other.close()
    assert time.monotonic() - begin < session.PATIENCE + 1 and not bpy.app.timers.is_registered(other._timer)
    release.set()
    assert done == [1]


def test_a_daemon_that_cannot_be_started_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from coseg_blender import session

    other = session.Session()
    with pytest.raises(coseg.CosegError, match="the daemon did not start"):
        monkeypatch.setenv("COSEG_BIN", "/bin/false")
        other.connect(f"ipc://{tmp_path}/none", str(tmp_path / "library"))
    monkeypatch.setenv("COSEG_BIN", "")
    monkeypatch.setenv("PATH", "")
    assert daemon_binary() is None
    with pytest.raises(coseg.CosegError, match="there is no coseg program"):
        other.connect(f"ipc://{tmp_path}/none", str(tmp_path / "library"))
    other.close()
