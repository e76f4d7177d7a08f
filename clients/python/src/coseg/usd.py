"""Labels of the meshes of an OpenUSD asset, as an override layer: ``python -m coseg.usd``, or ``coseg usd``.

>>> from coseg import usd
>>> usd.label("chair.usd", lib, "chairs", "labels.usda")      # doctest: +SKIP
>>> usd.correct("labels.usda", lib, "chairs")                 # doctest: +SKIP

Needs the extra ``coseg[usd]``. Every prim of type ``Mesh`` is one shape; see ``docs/usd.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

try:
    from pxr import Tf, Usd, UsdGeom
except ImportError as e:
    raise ImportError("coseg.usd needs OpenUSD: pip install 'coseg[usd]'", name=e.name) from e

from coseg._client import Library
from coseg._usd_layer import FAMILY, PREFIX, Writer, destination, identifier, new_layer, save
from coseg._usd_stage import Array, MeshShape, meshes, turn
from coseg.errors import CosegError, NotFound

__all__ = ["FAMILY", "Report", "correct", "label", "main"]


@dataclass
class Report:
    """What became of the meshes of an asset."""

    #: Names of shapes by outcome, such as ``"added"``.
    outcomes: dict[str, str] = field(default_factory=dict)
    #: Why shapes failed, or were left out.
    errors: dict[str, str] = field(default_factory=dict)
    #: Prims that have the labels of each shape.
    prims: dict[str, list[str]] = field(default_factory=dict)
    #: Faces that were corrected, by shape.
    n_corrected: dict[str, int] = field(default_factory=dict)


def label(
    asset: str | os.PathLike[str],
    library: Library,
    collection: str,
    output: str | os.PathLike[str],
    *,
    parts: int | None = None,
    up: str | None = None,
    instances: bool = False,
    materials: bool = False,
    prefix: str | None = None,
    replace: bool = False,
) -> Report:
    """Adds the meshes of an asset to a collection, and writes their labels as a layer over the asset.

    ``parts``, ``up``
        Of the collection, if it is new; the axis that points up is the stage's if it is not given. Meshes
        are turned from the stage's axis to the collection's.
    ``instances``
        A subset for each part instance in place of one for each label.
    ``materials``
        Bind a material in its colour to the faces of each label, in place of the asset's subsets of the
        family ``materialBind``.
    ``prefix``
        What the names of shapes begin with; by default the name of the asset's file and a colon, also where
        the asset is a layer of labels over it.
    ``replace``
        Whether a mesh that has changed takes the place of the shape of its name.
    """
    stage = _open(asset)
    path = destination(stage, output)
    report = Report()
    prefix = _prefix(stage, prefix)
    shapes, sites, report.errors = meshes(stage, prefix)
    if not shapes:
        raise CosegError(f"{asset} has no mesh that can be labelled: {report.errors or 'no prim is one'}")
    own = "+" + UsdGeom.GetStageUpAxis(stage).lower()
    try:
        wanted = library.collection(collection).info().up
    except NotFound:
        up = wanted = up or own
    within = library.collection(collection, parts=parts, up=up)
    upright = turn(own, wanted)
    items = ((shape.name, shape.encoded(upright)) for shape in shapes)
    for added in within.add_many(items, replace=replace):
        report.outcomes[added.name] = added.outcome
        if added.error is not None:
            report.errors[added.name] = str(added.error)
    within.wait_idle()
    labelled = [shape for shape in shapes if shape.name not in report.errors]
    layer = new_layer(stage, prefix)
    writer = Writer(layer, within.info().labels, instances, materials)
    writer.inherit(sites)
    for shape in labelled:
        writer.write(shape, within.labelling(shape.name, confidence=True))
        report.prims[shape.name] = shape.instances
    for shape in labelled:
        writer.settle(shape)
    save(layer, path)
    return report


def correct(
    asset: str | os.PathLike[str],
    library: Library,
    collection: str,
    *,
    prefix: str | None = None,
    every_face: bool = False,
) -> Report:
    """Reads the subsets of labels of an asset, as a person has left them, and corrects the collection.

    Faces are corrected where their label differs from the collection's; with ``every_face`` all that are in
    a subset are. A subset without ``coseg:label`` has the label of its name, which is created if there is
    none.
    """
    stage = _open(asset)
    report = Report()
    shapes, _, unusable = meshes(stage, _prefix(stage, prefix))
    # A mesh that could not be labelled has no subsets, and nothing to correct.
    labelled = {path for path in unusable if _subsets(stage.GetPrimAtPath(path))}
    report.errors = {path: error for path, error in unusable.items() if path in labelled}
    within = library.collection(collection)
    known = {shape.name for shape in within.shapes()}
    names = {label.id: label.name for label in within.info().labels if label.merged_into is None}
    for shape in shapes:
        subsets = _subsets(shape.prim)
        if not subsets:
            continue
        if shape.name not in known:
            report.errors[shape.name] = f"{collection!r} has no such shape: label the asset first"
            continue
        try:
            found, new = _labels_of(shape, subsets, names)
        except CosegError as e:
            report.errors[shape.name] = str(e)
            continue
        current = within.labels(shape.name)
        if len(current) != len(found):
            text = f"the mesh has {len(found)} faces, but the shape {len(current)}: label the asset again"
            report.errors[shape.name] = text
            continue
        if not every_face:
            found[found == current] = -1
        report.n_corrected[shape.name] = int((found >= 0).sum())
        if report.n_corrected[shape.name]:
            within.correct(shape.name, found)
            for label_id, name in new.items():
                within.name_label(label_id, name)
                names[label_id] = name
    within.wait_idle()
    return report


def _subsets(prim: Any) -> Sequence[Any]:
    """The subsets of labels of a mesh: its own, or without any those that it has by an arc.

    A subset that a person adds to a mesh reaches those that refer to it, which have labels of their own.
    """
    found: Sequence[Any] = UsdGeom.Subset.GetGeomSubsets(UsdGeom.Mesh(prim), UsdGeom.Tokens.face, FAMILY)
    own = [s for s in found if any(spec.path == s.GetPath() for spec in s.GetPrim().GetPrimStack())]
    return own or found


def _labels_of(
    shape: MeshShape, subsets: Sequence[Any], names: dict[int, str]
) -> tuple[Array, dict[int, str]]:
    """The label of each face, −1 in no subset, and the names of labels that are new."""
    found = np.full(len(shape.counts), -1, np.int32)
    is_taken = np.zeros(len(found), bool)
    new: dict[int, str] = {}
    for subset in subsets:
        prim = subset.GetPrim()
        at = np.array(subset.GetIndicesAttr().Get() or [], np.int64)
        if at.size and not 0 <= at.min() <= at.max() < len(found):
            raise CosegError(f"subset {prim.GetName()!r} names face {at.max()}, but there are {len(found)}")
        if is_taken[at].any():
            face = at[is_taken[at]][0]
            raise CosegError(f"subset {prim.GetName()!r} has face {face}, which another subset has too")
        is_taken[at] = True
        label_id = _attribute(prim, "coseg:label")
        if label_id is None:
            name = _attribute(prim, "coseg:name") or prim.GetName()
            by_name = {n: i for i, n in {**names, **new}.items() if n}
            by_name = {**{identifier(n): i for n, i in by_name.items()}, **by_name}
            label_id = by_name.get(name)
            if label_id is None:
                label_id = max([-1, *names, *new]) + 1
                new[label_id] = name
        found[at] = label_id
    return found, new


def _attribute(prim: Any, name: str) -> Any:
    attribute = prim.GetAttribute(name)
    return attribute.Get() if attribute and attribute.HasAuthoredValue() else None


def _prefix(stage: Any, prefix: str | None) -> str:
    """What names of shapes begin with: as given, as a layer of labels says, or after the asset's file."""
    if prefix is not None:
        return prefix
    for layer in stage.GetLayerStack(includeSessionLayers=False):
        if PREFIX in layer.customLayerData:
            return str(layer.customLayerData[PREFIX])
    return f"{Path(stage.GetRootLayer().realPath).stem}:"


def _open(asset: str | os.PathLike[str]) -> Any:
    try:
        return Usd.Stage.Open(os.fspath(asset))
    except Tf.ErrorException as e:
        raise CosegError(f"{asset} cannot be opened: {e}") from e


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="coseg usd", description="Labels of the meshes of an OpenUSD asset."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name, text in (
        ("label", "Add the meshes of an asset to a collection, and write their labels as a layer over it"),
        ("correct", "Correct a collection by the subsets of labels of an asset, as a person has left them"),
    ):
        command = commands.add_parser(name, help=text, description=text)
        command.add_argument("asset", help="a USD file; to correct, usually the layer that label wrote")
        command.add_argument("--collection", required=True, help="the collection of its meshes")
        command.add_argument(
            "--prefix", help="what names of shapes begin with [default: NAME: of the asset's file]"
        )
        command.add_argument("--endpoint", help="of the daemon [default: $COSEG_ENDPOINT]")
        command.add_argument("--json", action="store_true", help="print one JSON object")
    command = commands.choices["label"]
    command.add_argument("-o", "--output", required=True, help="the layer to write: .usda, .usdc or .usd")
    command.add_argument("--parts", type=int, help="number of part kinds of a new collection")
    command.add_argument("--up", help="up axis of a new collection [default: the stage's]")
    command.add_argument("--instances", action="store_true", help="a subset for each part, such as leg_001")
    command.add_argument("--materials", action="store_true", help="bind a material to each label")
    command.add_argument("--replace", action="store_true", help="replace shapes whose mesh has changed")
    commands.choices["correct"].add_argument(
        "--every-face", action="store_true", help="also pin faces whose label is the collection's already"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; its exit code."""
    args = _parser().parse_args(arguments)
    try:
        with Library(args.endpoint) as library:
            if args.command == "label":
                report = label(
                    args.asset,
                    library,
                    args.collection,
                    args.output,
                    parts=args.parts,
                    up=args.up,
                    instances=args.instances,
                    materials=args.materials,
                    prefix=args.prefix,
                    replace=args.replace,
                )
            else:
                report = correct(
                    args.asset, library, args.collection, prefix=args.prefix, every_face=args.every_face
                )
    except (CosegError, OSError, ValueError) as e:
        print(f"error: {e}", file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps(vars(report)))
    else:
        for name, outcome in report.outcomes.items():
            print(f"{name}: {outcome}, {len(report.prims.get(name, ()))} prims")
        for name, n in report.n_corrected.items():
            print(f"{name}: {n} faces corrected")
    for name, error in report.errors.items():
        print(f"error: {name}: {error}", file=sys.stderr)
    return 1 if report.errors else 0


if __name__ == "__main__":
    sys.exit(main())
