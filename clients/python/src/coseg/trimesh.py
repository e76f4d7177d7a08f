"""To and from ``trimesh``. A ``Trimesh`` can be added as it is: ``chairs.add("101", mesh)``."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from coseg._client import Collection
from coseg.errors import CosegError


def labelled(collection: Collection, name: str) -> Any:
    """A shape as ``trimesh.Trimesh``, faces as they were sent, in the colours of their labels.

    ``mesh.face_attributes["label"]`` has the labels, ``mesh.metadata["labels"]`` the labels' names.
    """
    import trimesh

    original = collection.original(name)
    if original.format == "gltf":
        # Nodes may come in another order there than the daemon's.
        raise CosegError(f"{name!r} is a glTF; `coseg export --format glb` writes it with its labels")
    # Anything that trimesh does to the faces would put the labels on the wrong ones.
    mesh: Any = trimesh.load(
        io.BytesIO(original.data),
        file_type=original.format,
        force="mesh",
        process=False,
        maintain_order=True,
    )
    labels = collection.labels(name)
    if len(mesh.faces) != len(labels):
        raise CosegError(
            f"{name!r} has {len(labels)} polygons, of which trimesh makes {len(mesh.faces)} triangles"
        )
    known = {label.id: label for label in collection.info().labels}
    palette = np.full((max([*known, 0]) + 2, 4), (128, 128, 128, 255), np.uint8)
    for label in known.values():
        rgb = label.colour_rgb
        palette[label.id, :3] = rgb >> 16, rgb >> 8 & 255, rgb & 255
    mesh.face_attributes["label"] = labels
    mesh.metadata["labels"] = {label.id: label.name for label in known.values()}
    mesh.visual.face_colors = palette[labels]
    return mesh
