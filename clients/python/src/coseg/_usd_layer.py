"""Labels of meshes become a layer over their stage."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from coseg import types as t
from coseg._instances import instance_numbers
from coseg._usd_stage import Array, MeshShape, Sites
from coseg.errors import CosegError

#: The family of subsets that hold labels.
FAMILY = "coseg:parts"
#: Where a layer of labels says what names of shapes begin with.
PREFIX = "coseg:prefix"


class Writer:
    """Writes labels of meshes to a layer."""

    def __init__(self, layer: Any, labels: Sequence[t.Label], instances: bool, materials: bool) -> None:
        self.layer = layer
        self.stage = Usd.Stage.Open(layer)
        self.labels = {label.id: label for label in labels}
        self.instances = instances
        self.materials = materials
        self._materials: dict[int, Any] = {}
        #: Names of the subsets of each shape.
        self._subsets: dict[Any, set[str]] = {}

    def inherit(self, sites: Sites) -> None:
        """Makes the classes of prototypes, and their instances inherit from them."""
        for site, root in sites.inherits:
            Sdf.CreatePrimInLayer(self.layer, root).specifier = Sdf.SpecifierClass
            Sdf.CreatePrimInLayer(self.layer, site).inheritPathList.Prepend(root)

    def write(self, shape: MeshShape, found: t.Labelling) -> None:
        """Writes the labels of one shape."""
        Sdf.CreatePrimInLayer(self.layer, shape.site)
        mesh = UsdGeom.Mesh(self.stage.GetPrimAtPath(shape.site))
        labels = found.labels.astype(np.int64)
        numbers = instance_numbers(shape.vertices, shape.counts, shape.corners, labels)
        ints = Vt.IntArray.FromNumpy
        self._primvar(mesh, "label", Sdf.ValueTypeNames.IntArray, ints(found.labels.astype(np.int32)))
        self._primvar(mesh, "instance", Sdf.ValueTypeNames.IntArray, ints(numbers.astype(np.int32)))
        if found.confidence is not None:
            values = Vt.FloatArray.FromNumpy(found.confidence)
            self._primvar(mesh, "confidence", Sdf.ValueTypeNames.FloatArray, values)
        partition = UsdGeom.Tokens.partition
        UsdGeom.Subset.SetFamilyType(mesh, FAMILY, partition)
        if self.materials:
            UsdGeom.Subset.SetFamilyType(mesh, UsdShade.Tokens.materialBind, partition)
        taken = {p.GetName() for p in shape.prim.GetAllChildren() if not _in_family(p, FAMILY)}
        mine = self._subsets[shape.site] = set()
        for label_id in np.unique(labels):
            stem = self._name(int(label_id))
            pieces = np.unique(numbers[labels == label_id]) if self.instances else [0]
            for number in pieces:
                here = labels == label_id
                faces = np.flatnonzero(here & (numbers == number) if number else here)
                name = identifier(f"{stem}_{number:03}" if number else stem)
                subset = self._subset(shape, _free(name, taken), FAMILY, faces)
                self._describe(subset.GetPrim(), int(label_id), stem, int(number))
                mine.add(subset.GetPrim().GetName())
            if self.materials:
                faces = np.flatnonzero(labels == label_id)
                name = _free(identifier(f"{stem}_material"), taken)
                subset = self._subset(shape, name, UsdShade.Tokens.materialBind, faces)
                UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(self._material(int(label_id)))
                mine.add(name)

    def settle(self, shape: MeshShape) -> None:
        """Leaves those subsets of the families that were written which are the shape's own.

        Others come from the asset, or through a reference from a mesh that is labelled as well.
        """
        prim = self.stage.GetPrimAtPath(shape.prim.GetPath())
        families = [FAMILY, UsdShade.Tokens.materialBind][: 1 + self.materials]
        for child in prim.GetAllChildren():
            is_mine = child.GetName() in self._subsets[shape.site]
            if is_mine == child.IsActive() or not (is_mine or any(_in_family(child, f) for f in families)):
                continue
            Sdf.CreatePrimInLayer(self.layer, shape.site.AppendChild(child.GetName())).active = is_mine

    def _name(self, label_id: int) -> str:
        if label_id < 0:
            return "unlabelled"
        known = self.labels.get(label_id)
        return known.name if known and known.name else f"label_{label_id}"

    def _primvar(self, mesh: Any, name: str, kind: Any, values: Any) -> None:
        api = UsdGeom.PrimvarsAPI(mesh)
        api.CreatePrimvar(f"coseg:{name}", kind, UsdGeom.Tokens.uniform).Set(values)

    def _subset(self, shape: MeshShape, name: str, family: str, faces: Array) -> Any:
        path = shape.site.AppendChild(name)
        spec = Sdf.CreatePrimInLayer(self.layer, path)
        spec.specifier, spec.typeName = Sdf.SpecifierDef, "GeomSubset"
        subset = UsdGeom.Subset(self.stage.GetPrimAtPath(path))
        subset.CreateElementTypeAttr(UsdGeom.Tokens.face)
        subset.CreateFamilyNameAttr(family)
        subset.CreateIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32)))
        return subset

    def _describe(self, prim: Any, label_id: int, name: str, number: int) -> None:
        for key, kind, value in (
            ("label", Sdf.ValueTypeNames.Int, label_id),
            ("name", Sdf.ValueTypeNames.String, name),
            ("instance", Sdf.ValueTypeNames.Int, number),
        ):
            if key != "instance" or number:
                prim.CreateAttribute(f"coseg:{key}", kind).Set(value)

    def _material(self, label_id: int) -> Any:
        """The material of a label, below the default prim, so that it comes along with a reference."""
        if label_id in self._materials:
            return self._materials[label_id]
        top = self.stage.GetDefaultPrim()
        root = top.GetPath() if top and not top.IsInstance() else Sdf.Path.absoluteRootPath
        scope = root.AppendChild("coseg_materials")
        UsdGeom.Scope.Define(self.stage, scope)
        taken = {p.GetName() for p in self.stage.GetPrimAtPath(scope).GetAllChildren()}
        path = scope.AppendChild(_free(identifier(self._name(label_id)), taken))
        material = UsdShade.Material.Define(self.stage, path)
        shader = UsdShade.Shader.Define(self.stage, path.AppendChild("Surface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        known = self.labels.get(label_id)
        rgb = known.colour_rgb if known else 0x808080
        # A colour of a label is sRGB; that of a material is linear.
        channels = np.array([rgb >> 16, rgb >> 8 & 255, rgb & 255]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        colour = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        colour.Set(tuple(map(float, linear)))
        surface = shader.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(surface)
        self._materials[label_id] = material
        return material


def _in_family(prim: Any, family: str) -> bool:
    return bool(prim.IsA(UsdGeom.Subset)) and UsdGeom.Subset(prim).GetFamilyNameAttr().Get() == family


def identifier(name: str) -> str:
    """A name in letters, digits and underscores, as every release of USD allows it."""
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
    return text if text and not text[0].isdigit() else f"_{text}"


def _free(name: str, taken: set[str]) -> str:
    """The name, with a number if it is taken."""
    stem, n = name, 1
    while name in taken:
        n += 1
        name = f"{stem}_{n}"
    taken.add(name)
    return name


def new_layer(stage: Any, prefix: str) -> Any:
    """An empty layer over the stage, which says the same of axes and units."""
    asset, layer = stage.GetRootLayer(), Sdf.Layer.CreateAnonymous(".usda")
    layer.customLayerData = {PREFIX: prefix}
    layer.subLayerPaths.append(asset.realPath)
    if asset.defaultPrim:
        layer.defaultPrim = asset.defaultPrim
    for key in ("upAxis", "metersPerUnit", "timeCodesPerSecond", "startTimeCode", "endTimeCode"):
        if asset.pseudoRoot.HasInfo(key):
            layer.pseudoRoot.SetInfo(key, asset.pseudoRoot.GetInfo(key))
    return layer


def destination(stage: Any, output: str | os.PathLike[str]) -> Path:
    path = Path(output).resolve()
    if path == Path(stage.GetRootLayer().realPath):
        raise CosegError(f"{output} is the asset itself: write the labels to another file")
    if path.suffix not in (".usda", ".usdc", ".usd"):
        raise CosegError(f"{output} must end in .usda, .usdc or .usd")
    return path


def save(layer: Any, path: Path) -> None:
    """Writes a layer that names the asset by the way from it."""
    layer.subLayerPaths[0] = Path(os.path.relpath(layer.subLayerPaths[0], path.parent)).as_posix()
    layer.Export(str(path))
    loaded = Sdf.Layer.Find(str(path))
    if loaded:
        loaded.Reload(force=True)
