"""Meshes of an OpenUSD asset are labelled by a layer over it, and corrected by what a person does there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import BINARY, Daemon, environment

import coseg

pytest.importorskip("pxr", reason="needs usd-core")
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdValidation

from coseg import usd
from coseg._instances import instance_numbers
from coseg._usd_stage import AXES, turn

QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
LEGS = [((x, y, 0), (x + 5, y + 5, 40)) for x in (0, 40) for y in (0, 40)]
CHAIR = [*LEGS, ((0, 0, 40), (45, 45, 45)), ((0, 40, 45), (45, 45, 90))]
STOOL = [*LEGS, ((0, 0, 40), (45, 45, 44))]


def boxes(stage: Any, path: str, all_boxes: Any) -> Any:
    """A mesh of boxes with texture coordinates, each of its own vertices."""
    points: list[tuple[float, ...]] = []
    corners: list[int] = []
    for low, high in all_boxes:
        n = len(points)
        points += [tuple((high if i >> k & 1 else low)[k] for k in range(3)) for i in range(8)]
        corners += [n + c for quad in QUADS for c in quad]
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([4] * (len(corners) // 4))
    mesh.CreateFaceVertexIndicesAttr(corners)
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    st.Set([(0, 0), (1, 0), (1, 1), (0, 1)] * (len(corners) // 4))
    return mesh


def new_stage(path: Path, root: str) -> Any:
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, root).GetPrim())
    return stage


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """Two instances of a chair, the same chair as a payload, a stool with a reference to it in the same
    stage, a mesh for guides, and one without faces."""
    stage = new_stage(tmp_path / "chair.usda", "/Chair")
    body = boxes(stage, "/Chair/body", CHAIR)
    wood = UsdShade.Material.Define(stage, "/Chair/wood")
    shader = UsdShade.Shader.Define(stage, "/Chair/wood/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    surface = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    wood.CreateSurfaceOutput().ConnectToSource(surface)
    faces = list(range(len(CHAIR) * 6))
    subset = UsdGeom.Subset.CreateGeomSubset(body, "wooden", "face", faces, "materialBind", "partition")
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(wood)
    stage.Save()
    stage = new_stage(tmp_path / "room.usda", "/World")
    for i in range(3):
        chair = UsdGeom.Xform.Define(stage, f"/World/chair_{i}")
        chair.AddTranslateOp().Set((100 * i, 0, 0))
        if i < 2:
            chair.GetPrim().GetReferences().AddReference("./chair.usda")
            chair.GetPrim().SetInstanceable(True)
        else:
            chair.GetPrim().GetPayloads().AddPayload("./chair.usda")
    boxes(stage, "/World/stool", STOOL).AddTranslateOp().Set((0, 200, 0))
    stage.DefinePrim("/World/copy").GetReferences().AddInternalReference("/World/stool")
    boxes(stage, "/World/guide", LEGS).CreatePurposeAttr(UsdGeom.Tokens.guide)
    UsdGeom.Mesh.Define(stage, "/World/empty")
    stage.Save()
    return tmp_path / "room.usda"


def all_meshes(stage: Any) -> dict[str, Any]:
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return {str(p.GetPath()): UsdGeom.Mesh(p) for p in prims if p.IsA(UsdGeom.Mesh)}


def labels_of(mesh: Any) -> np.ndarray[Any, Any]:
    """The label of each face by subsets and by the primvar, which must be the same; all valid."""
    valid, why = UsdGeom.Subset.ValidateFamily(mesh, UsdGeom.Tokens.face, usd.FAMILY)
    assert valid, (mesh, why)
    found = np.full(len(mesh.GetFaceVertexCountsAttr().Get()), -2)
    for subset in UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.face, usd.FAMILY):
        found[list(subset.GetIndicesAttr().Get())] = subset.GetPrim().GetAttribute("coseg:label").Get()
    primvars = UsdGeom.PrimvarsAPI(mesh)
    assert list(primvars.GetPrimvar("coseg:label").Get()) == found.tolist()
    assert len(primvars.GetPrimvar("coseg:confidence").Get()) == len(found)
    return found


def problems(path: Path) -> list[str]:
    """What the validators of OpenUSD, which ``usdchecker`` runs, say of a file."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in errors]


LABELLED = [
    "/World/chair_0/body",
    "/World/chair_1/body",
    "/World/chair_2/body",
    "/World/copy",
    "/World/stool",
]


@pytest.mark.parametrize("instances", [False, True])
def test_an_asset_is_labelled_by_a_layer_over_it(daemon: Daemon, room: Path, instances: bool) -> None:
    before = {path.name: path.read_bytes() for path in room.parent.iterdir()}
    output = room.parent / "out" / "labels.usda"
    output.parent.mkdir()
    with coseg.Library(daemon.endpoint) as lib:
        report = usd.label(room, lib, "chairs", output, parts=3, instances=instances, materials=instances)
        assert list(report.errors) == ["/World/empty"]
        assert report.prims["room:World.chair_0.body"] == ["/World/chair_0/body", "/World/chair_1/body"]
        assert lib.collection("chairs").info().up == "+z"
        stage = Usd.Stage.Open(str(output))
        assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 0.01
        meshes = all_meshes(stage)
        for shape, paths in report.prims.items():
            labels = lib.collection("chairs").labels(shape)
            for path in paths:
                assert labels_of(meshes[path]).tolist() == labels.tolist(), path
                assert len(UsdGeom.PrimvarsAPI(meshes[path]).GetPrimvar("st").Get()) == 4 * len(labels)
                valid, why = UsdGeom.Subset.ValidateFamily(meshes[path], "face", "materialBind")
                assert valid or not UsdGeom.Subset.GetGeomSubsets(meshes[path], "face", "materialBind"), why
        assert sorted(path for paths in report.prims.values() for path in paths) == LABELLED
        # Instances share their mesh as before.
        assert len(stage.GetPrototypes()) == 1
        legs = UsdGeom.Subset.GetGeomSubsets(meshes["/World/chair_1/body"], "face", usd.FAMILY)
        names = [subset.GetPrim().GetName() for subset in legs]
        assert all(name.rsplit("_", 1)[1].isdigit() for name in names)
        assert any(name.endswith("_001") for name in names) == instances
        bound = UsdShade.MaterialBindingAPI(meshes["/World/chair_1/body"]).GetMaterialBindSubsets()
        assert ("wooden" in [s.GetPrim().GetName() for s in bound]) != instances
        again = usd.label(room, lib, "chairs", output)
        assert set(again.outcomes.values()) == {"unchanged"}
    assert problems(output) == problems(room) == []
    assert {path.name: path.read_bytes() for path in room.parent.iterdir() if path.is_file()} == before


def test_what_a_person_does_to_subsets_is_a_correction(daemon: Daemon, room: Path) -> None:
    output = room.with_name("labels.usda")
    arguments = ["--collection", "chairs", "--endpoint", daemon.endpoint]
    command = [BINARY, "usd"]
    env = {**environment(), "COSEG_PYTHON": sys.executable}
    run = {"env": env, "capture_output": True, "text": True}
    label = [*command, "label", str(room), *arguments, "--parts", "3", "-o", str(output)]
    done: Any = subprocess.run(label, **run)  # type: ignore[call-overload]
    assert done.returncode == 1 and "/World/empty" in done.stderr, done.stderr
    stage = Usd.Stage.Open(str(output))
    mesh = all_meshes(stage)["/World/stool"]
    subsets = UsdGeom.Subset.GetGeomSubsets(mesh, "face", usd.FAMILY)
    # A face goes from one label to a new one, which has only a name.
    taken = subsets[0].GetIndicesAttr().Get()[0]
    subsets[0].GetIndicesAttr().Set(list(subsets[0].GetIndicesAttr().Get())[1:])
    UsdGeom.Subset.CreateGeomSubset(mesh, "foot rest".replace(" ", "_"), "face", [taken], usd.FAMILY)
    stage.GetRootLayer().Save()
    with coseg.Library(daemon.endpoint) as lib:
        chairs = lib.collection("chairs")
        before = chairs.labels("room:World.stool")
        report = usd.correct(output, lib, "chairs")
        assert report.n_corrected["room:World.stool"] == 1
        assert sum(report.n_corrected.values()) == 1 and not report.errors, report
        names = {label.name: label.id for label in chairs.info().labels}
        after = chairs.labels("room:World.stool")
        assert after[taken] == names["foot_rest"] and after[taken] != before[taken]
        # Overlapping subsets are refused.
        subsets[1].GetIndicesAttr().Set([*subsets[1].GetIndicesAttr().Get(), taken])
        stage.GetRootLayer().Save()
        assert problems(output)
        report = usd.correct(output, lib, "chairs")
        assert "which another subset has too" in report.errors["room:World.stool"]
    missing: Any = subprocess.run([*label[:3], "none.usd", *label[4:]], **run)  # type: ignore[call-overload]
    assert missing.returncode == 1 and "none.usd cannot be opened" in missing.stderr


@pytest.mark.parametrize("wanted", sorted(AXES))
def test_meshes_are_turned_upright(wanted: str) -> None:
    for up in ("+y", "+z"):
        found = turn(up, wanted)
        assert np.allclose(found @ AXES[up], AXES[wanted]) and np.isclose(np.linalg.det(found), 1)
    assert np.array_equal(turn("+y", "auto"), np.eye(3))


def test_instances_are_those_of_an_export(daemon: Daemon, meshes: list[Path], tmp_path: Path) -> None:
    with coseg.Library(daemon.endpoint) as lib:
        collection = lib.collection("c", parts=4, up="+y")
        collection.add("a", meshes[0])
        labels = collection.labels("a").astype(np.int64)
    export = [BINARY, "export", "--endpoint", daemon.endpoint, "--format", "usda", "--out"]
    n_subsets = []
    for options in ([], ["--instances"]):
        folder = tmp_path / f"out{len(options)}"
        subprocess.run([*export, str(folder), *options], check=True, env=environment(), capture_output=True)
        stage = Usd.Stage.Open(str(folder / "a.usda"))
        (mesh,) = all_meshes(stage).values()
        assert labels_of(mesh).tolist() == labels.tolist() and problems(folder / "a.usda") == []
        subsets = UsdGeom.Subset.GetGeomSubsets(mesh, UsdGeom.Tokens.face, usd.FAMILY)
        n_subsets.append(len(subsets))
    assert n_subsets[0] == len(np.unique(labels)) < n_subsets[1]
    numbers = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("coseg:instance").Get()
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(), np.int64)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int64)
    points = np.array(mesh.GetPointsAttr().Get(), np.float64)
    assert instance_numbers(points, counts, corners, labels).tolist() == list(numbers)
    for subset in subsets:
        number = subset.GetPrim().GetAttribute("coseg:instance").Get()
        assert {numbers[face] for face in subset.GetIndicesAttr().Get()} == {number}
    # Small pieces count with the nearest large one.
    squares = [(0, 1), (7, 0.1), (9, 1), (2, 0.1)]
    places = [(x + u * side, v * side, 0) for x, side in squares for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
    found = instance_numbers(np.array(places, float), np.full(4, 4), np.arange(16), np.full(4, 3, np.int64))
    assert found.tolist() == [1, 2, 2, 1]
