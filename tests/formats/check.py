"""Reads what coseg exported with other programs and compares labels, names and counts: check.py INPUTS OUTPUTS.

Prints the parts of each GLB for other readers, as JSON, to OUTPUTS/parts.json.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np
import trimesh
from plyfile import PlyData
from pxr import Usd, UsdGeom

inputs, outputs = map(Path, sys.argv[1:])


def document(path):
    """The JSON of a GLB."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])


def parts_of_glb(path, labels):
    """Triangles of each part, by name, from what nodes and primitives say of them."""
    root, parts, seen = document(path), {}, np.zeros(len(labels), int)
    for node in root["nodes"]:
        if "label" not in node.get("extras", {}):
            continue
        assert node["name"] == f"{node['extras']['label_name']}.{node['extras']['instance']:03}" not in parts, node
        primitives = root["meshes"][node["mesh"]]["primitives"]
        parts[node["name"]] = sum(root["accessors"][p["indices"]]["count"] // 3 for p in primitives)
        for primitive in primitives:
            assert primitive["extras"]["label"] == node["extras"]["label"]
            for first, count in np.reshape(primitive["extras"]["polygons"], (-1, 2)):
                seen[first : first + count] += 1
                assert (labels[first : first + count] == node["extras"]["label"]).all(), path
    assert (seen == 1).all(), path
    return parts


def faces_of_obj(path, labels):
    """Faces of each group, by name; their comments say which faces of the input they are."""
    groups, label, seen = {}, None, np.zeros(len(labels), int)
    for line in path.read_text().splitlines():
        word, _, rest = line.partition(" ")
        if word == "g":
            name = rest.split()[0]
            assert name not in groups, (path, name)
            groups[name] = 0
        elif line.startswith("# label "):
            label = int(rest.removeprefix("label "))
        elif line.startswith("# faces "):
            for run in rest.split()[1:]:
                first, _, last = run.partition("-")
                faces = slice(int(first), int(last or first) + 1)
                seen[faces] += 1
                assert (labels[faces] == label).all(), (path, run)
        elif word == "f":
            groups[name] += 1
    assert (seen == 1).all(), path
    return groups


all_parts = {}
print(f"{'shape':<14}{'faces':>7}  {'labels':<14} parts plyfile  trimesh ply  obj  glb  usd")
for path in sorted(inputs.iterdir()):
    name = path.stem
    labels = np.load(outputs / f"{name}.labels.npy")
    assert labels.dtype == np.int32 and labels.ndim == 1
    text = [int(line) for line in (outputs / f"{name}.labels.txt").read_text().split()]
    seg = [int(line) for line in (outputs / f"{name}.seg").read_text().split()]
    table = json.loads((outputs / f"{name}.labels.json").read_text())
    assert text == seg == table["labels"] == labels.tolist(), name
    names = {int(label): material for label, material in table["names"].items()}

    ply = PlyData.read(outputs / f"{name}.ply")
    polygons = [list(p) for p in ply["face"]["vertex_indices"]]
    assert np.array_equal(ply["face"]["label"], labels), name
    if path.suffix != ".glb":
        original = trimesh.load(path, process=False, maintain_order=True)
        if isinstance(original, trimesh.Trimesh) and len(original.faces) == len(labels):
            found = ply_vertices = np.stack([ply["vertex"][c] for c in "xyz"], axis=1)
            corners = found[np.array(polygons)]
            assert np.allclose(corners, original.vertices[original.faces], atol=1e-6), name

    # trimesh reads a binary PLY only if all its polygons have as many corners.
    if len({len(p) for p in polygons}) == 1:
        loaded = trimesh.load(outputs / f"{name}.ply", process=False)
        raw = loaded.metadata["_ply_raw"]["face"]["data"]["label"]
        assert np.array_equal(np.asarray(raw).ravel(), labels), name

    # Whatever triangles a polygon becomes, its area is half of the length of its Newell normal.
    corners = np.stack([ply["vertex"][c] for c in "xyz"], axis=1)
    rings = [corners[p] - corners[p[0]] for p in polygons]
    normals = [np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0) for ring in rings]
    area = 0.5 * np.linalg.norm(normals, axis=1).sum()
    exported = trimesh.load(outputs / f"{name}.glb", process=False, force="scene").area
    assert np.isclose(exported, area, rtol=1e-5), (name, exported, area)

    triangles = np.array([max(len(p) - 2, 1) for p in polygons])
    parts = parts_of_glb(outputs / f"{name}.glb", labels)
    scene = trimesh.load(outputs / f"{name}.glb", process=False, force="scene")
    found = {node: len(scene.geometry[scene.graph[node][1]].faces) for node in scene.graph.nodes_geometry}
    assert found == parts, (name, found, parts)
    for label in np.unique(labels):
        of_label = [n for part, n in parts.items() if part.rsplit(".", 1)[0] == names[label]]
        assert sum(of_label) == triangles[labels == label].sum(), (name, label)
    groups = faces_of_obj(outputs / f"{name}.obj", labels)
    if path.suffix != ".glb" and "painted" not in name:
        # Nodes of a glTF, and objects of an OBJ, bound parts.
        assert list(groups) == list(parts), (name, groups, parts)
    scene = trimesh.load(
        outputs / f"{name}.obj", process=False, force="scene", split_groups=True, group_material=False
    )
    found = sorted(len(geometry.faces) for geometry in scene.geometry.values())
    if path.suffix != ".glb":
        expected = sorted(n for part, n in parts.items()) if "painted" not in name else found
        assert found == expected, (name, found, expected)
    all_parts[name] = {"glb": parts, "obj": groups, "n_faces": len(labels), "labels": np.unique(labels).tolist()}

    stage = Usd.Stage.Open(str(outputs / f"{name}.usda"))
    mesh = next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [len(p) for p in polygons], name
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for primvar in ("label", "instance", "confidence"):
        assert primvars.GetPrimvar(f"coseg:{primvar}").GetInterpolation() == "uniform", primvar
    assert list(primvars.GetPrimvar("coseg:label").Get()) == labels.tolist()
    assert len(primvars.GetPrimvar("coseg:confidence").Get()) == len(labels)
    of_subsets = np.full(len(labels), -2)
    for subset in UsdGeom.Subset.GetGeomSubsets(mesh, "face", "coseg:parts"):
        prim = subset.GetPrim()
        of_subsets[list(subset.GetIndicesAttr().Get())] = label = prim.GetAttribute("coseg:label").Get()
        assert prim.GetAttribute("coseg:name").Get() == names[label], name
    assert np.array_equal(of_subsets, labels), name
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1, name
    # What is up in the files, +z, is up in glTF: +y.
    upright = trimesh.load(outputs / f"{name}.glb", process=False, force="scene").bounds
    used = np.unique(np.concatenate([np.asarray(p) for p in polygons]))
    lying = np.stack([ply["vertex"][c] for c in "xyz"], axis=1)[used]
    assert np.allclose(upright[:, 1], [lying[:, 2].min(), lying[:, 2].max()], atol=1e-5), name
    assert np.allclose(upright[:, 2], [-lying[:, 1].max(), -lying[:, 1].min()], atol=1e-5), name
    for family in ("coseg:parts", "materialBind"):
        valid, why = UsdGeom.Subset.ValidateFamily(mesh, "face", family)
        assert valid, why
    text = str(np.unique(labels).tolist())
    print(f"{name:<14}{len(labels):>7}  {text:<14} {len(parts):>5} same     same         same same same")

# What an artist sent comes back.
old, new = document(inputs / "painted.glb"), document(outputs / "painted.glb")
for key in ("materials", "images", "textures", "accessors"):
    assert new[key][: len(old[key])] == old[key], key
named = {node["name"]: node for node in new["nodes"]}
for node in old["nodes"]:
    assert named[node["name"]].get("matrix") == node.get("matrix"), node
    for child in named[node["name"]].get("children", []):
        part = new["nodes"][child]
        for primitive in new["meshes"][part["mesh"]]["primitives"] if "label" in part.get("extras", {}) else []:
            assert primitive["attributes"].keys() == {"POSITION", "NORMAL", "TEXCOORD_0"}, primitive
            assert new["materials"][primitive["material"]]["name"] == "oak", primitive
text, before = (Path(folder, "painted-obj.obj").read_text().splitlines() for folder in (outputs, inputs))
for keyword in ("v", "vt", "vn", "o", "usemtl", "mtllib", "#"):
    of = lambda lines: {line for line in lines if line.split()[0] == keyword}  # noqa: E731, B023
    assert of(before) <= of(text), keyword
corners = [sorted(line for line in lines if line.startswith("f ")) for lines in (before, text)]
assert corners[0] == corners[1]
new = document(outputs / "painted-obj.glb")
parents = {new["nodes"][child]["name"]: node for node in new["nodes"] for child in node.get("children", [])}
for node in new["nodes"]:
    for primitive in new["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
        assert primitive["attributes"].keys() == {"POSITION", "NORMAL", "TEXCOORD_0"}, primitive
        material = {"seat": "oak", "back": "pine"}[parents[node["name"]]["name"]]
        assert primitive["extras"]["material"] == material, primitive


def corners_of(path):
    """Position, texture coordinates and normal of each corner of a scene's triangles, sorted, and its materials."""
    rows, materials = [], set()
    scene = trimesh.load(path, process=False, maintain_order=True, force="scene")
    for node in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        at = trimesh.transform_points(mesh.vertices, matrix)
        normals = mesh.vertex_normals @ matrix[:3, :3].T
        rows.append(np.hstack([at, mesh.visual.uv, normals])[mesh.faces].reshape(-1, 8))
        materials.add(mesh.visual.material.name)
    rows = np.vstack(rows).round(4) + 0.0
    return rows[np.lexsort(rows.T)], materials


# An OBJ of a glTF has its texture coordinates, normals and names of materials.
before, after = corners_of(inputs / "painted.glb"), corners_of(outputs / "painted.obj")
assert before[0].shape == after[0].shape and np.allclose(before[0], after[0], atol=2e-4)
assert before[1] == after[1] == {"oak"}, (before[1], after[1])
assert "newmtl oak\n" in (outputs / "labels.mtl").read_text()
# A PLY has the normals of either, and the colours where there are some.
for name in ("painted", "coloured"):
    vertex = PlyData.read(outputs / f"{name}.ply")["vertex"]
    normals = np.stack([vertex[c] for c in ("nx", "ny", "nz")], axis=1)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6), name
at = np.stack([vertex[c] for c in "xyz"], axis=1)
assert np.allclose(normals, np.sign(at) / np.sqrt(3), atol=1e-6)
colours = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1)
assert np.array_equal(colours, np.where(at > 0, 128, 0)), colours
# A GLB has them in linear light.
data, root = (outputs / "coloured.glb").read_bytes(), document(outputs / "coloured.glb")
start = 20 + struct.unpack_from("<I", data, 12)[0] + 8
n_coloured = 0
for primitive in (p for mesh in root["meshes"] for p in mesh["primitives"]):
    read = {}
    for kind in ("POSITION", "COLOR_0"):
        accessor = root["accessors"][primitive["attributes"][kind]]
        offset = start + root["bufferViews"][accessor["bufferView"]]["byteOffset"]
        read[kind] = np.frombuffer(data, "<f4", 3 * accessor["count"], offset).reshape(-1, 3)
    light = ((0.5 + 0.055) / 1.055) ** 2.4
    assert np.allclose(read["COLOR_0"], np.where(read["POSITION"] > 0, light, 0), atol=1e-6)
    n_coloured += len(read["COLOR_0"])
assert n_coloured >= 8
print("painted.obj, painted.ply, coloured.glb and coloured.ply have attributes of the other format")
print("painted.glb and painted-obj.obj keep what they had, painted-obj.glb what it can")
(outputs / "parts.json").write_text(json.dumps(all_parts))
