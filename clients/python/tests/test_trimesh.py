"""Meshes of trimesh go in, and labelled ones come out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import Daemon

import coseg
from coseg.trimesh import labelled


def test_a_trimesh_goes_in_and_comes_out_labelled(daemon: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(daemon.endpoint) as lib:
        collection = lib.collection("trimesh", parts=4, up="+y")
        mesh: Any = trimesh.load(meshes[0], process=False, maintain_order=True)
        assert collection.add("a", mesh).outcome == "added"
        assert collection.add("b", meshes[1]).outcome == "added"
        collection.name_label(0, "seat")
        for name, path in (("a", meshes[0]), ("b", meshes[1])):
            out = labelled(collection, name)
            same: Any = trimesh.load(path, process=False, maintain_order=True)
            assert (out.faces == same.faces).all()
            assert np.abs(out.vertices - same.vertices).max() < 1e-6
            assert (out.face_attributes["label"] == collection.labels(name)).all()
            assert out.metadata["labels"][0] == "seat"
            colours = {tuple(c) for c in out.visual.face_colors}
            assert len(colours) == len(np.unique(collection.labels(name)))
        quads = ([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [1, 0, 1]], [[0, 1, 2, 3]])
        collection.add("quad", quads)
        assert collection.labels("quad").shape == (1,)
        with pytest.raises(coseg.CosegError, match="1 polygons, of which trimesh makes 2"):
            labelled(collection, "quad")
