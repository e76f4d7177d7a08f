"""Reads what coseg exported with other programs and compares the labels: check.py INPUTS OUTPUTS."""

import json
import sys
from pathlib import Path

import numpy as np
import trimesh
from plyfile import PlyData
from pxr import Usd, UsdGeom

inputs, outputs = map(Path, sys.argv[1:])
print(f"{'shape':<14}{'faces':>7}  {'labels':<14} plyfile  trimesh ply  obj  glb  usd")
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
        if len(original.faces) == len(labels):
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
    expected = {names[l]: int(triangles[labels == l].sum()) for l in np.unique(labels)}
    for ending in (".obj", ".glb"):
        options = {"group_material": True, "split_object": False} if ending == ".obj" else {}
        scene = trimesh.load(outputs / f"{name}{ending}", process=False, force="scene", **options)
        found = {}
        for geometry in scene.geometry.values():
            material = geometry.visual.material.name
            found[material] = found.get(material, 0) + len(geometry.faces)
        assert found == expected, (name, ending, found, expected)

    stage = Usd.Stage.Open(str(outputs / f"{name}.usda"))
    mesh = next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [len(p) for p in polygons], name
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("label")
    assert primvar.GetInterpolation() == "uniform" and list(primvar.Get()) == labels.tolist()
    of_subsets = np.full(len(labels), -2)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        of_subsets[list(subset.GetIndicesAttr().Get())] = subset.GetPrim().GetAttribute("label").Get()
    assert np.array_equal(of_subsets, labels), name
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1, name
    # What is up in the files, +z, is up in glTF: +y.
    upright = trimesh.load(outputs / f"{name}.glb", process=False, force="scene").bounds
    used = np.unique(np.concatenate([np.asarray(p) for p in polygons]))
    lying = np.stack([ply["vertex"][c] for c in "xyz"], axis=1)[used]
    assert np.allclose(upright[:, 1], [lying[:, 2].min(), lying[:, 2].max()], atol=1e-5), name
    assert np.allclose(upright[:, 2], [-lying[:, 1].max(), -lying[:, 1].min()], atol=1e-5), name
    valid, why = UsdGeom.Subset.ValidateFamily(mesh, "face", "materialBind")
    assert valid, why
    print(f"{name:<14}{len(labels):>7}  {str(np.unique(labels).tolist()):<14} same     same         same same same")
