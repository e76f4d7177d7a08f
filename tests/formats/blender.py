"""Reads what coseg exported with Blender and compares the parts with what check.py found: blender.py OUTPUTS."""

import json
import sys
from pathlib import Path

import bpy

outputs = Path(sys.argv[1])


def imported(operator, path, **options):
    """Objects with meshes of a file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert operator(filepath=str(path), **options) == {"FINISHED"}, path
    return [o for o in bpy.data.objects if o.type == "MESH"]


for name, about in json.loads((outputs / "parts.json").read_text()).items():
    objects = imported(bpy.ops.import_scene.gltf, outputs / f"{name}.glb")
    assert {o.name: len(o.data.polygons) for o in objects} == about["glb"], name
    for o in objects:
        assert o["label"] in about["labels"] and o.name.startswith(o["label_name"]), (name, o.name)
    objects = imported(bpy.ops.wm.obj_import, outputs / f"{name}.obj", use_split_groups=True)
    found = {o.name: len(o.data.polygons) for o in objects}
    assert sum(found.values()) == sum(about["obj"].values()), name
    for group, n_faces in about["obj"].items():
        assert found.get(group) == n_faces, (name, group, found)
    (mesh,) = imported(bpy.ops.wm.ply_import, outputs / f"{name}.ply")
    assert len(mesh.data.polygons) == about["n_faces"], name
    assert "label" in mesh.data.attributes and len(mesh.data.color_attributes) == 1, name
    values = {value.value for value in mesh.data.attributes["label"].data}
    assert values <= {-1, *about["labels"]}, (name, values)
    print(f"{name:<14} Blender {bpy.app.version_string}: {len(about['glb'])} parts in GLB, "
          f"{len(about['obj'])} in OBJ, labels in PLY")
