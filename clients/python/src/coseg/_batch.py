"""A stream of meshes becomes requests of bounded size, whose ids name their contents."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from coseg import types as t
from coseg._size import beyond
from coseg._wire import FrameWriter, MeshLike, shape_input
from coseg.errors import BadMesh
from coseg.v1 import collection_pb2, job_pb2

#: Shapes and bytes of one request: small enough that the first is at work while the next is read.
BATCH_SHAPES = 16
BATCH_BYTES = 16 << 20
#: What :meth:`add_many` takes: paths, named after their stems, or pairs of a name and a mesh.
Item = str | os.PathLike[str] | tuple[str, MeshLike]


@dataclass
class Batch:
    """Shapes of one request, and those before them that could not even be sent."""

    request: job_pb2.AddShapesRequest
    writer: FrameWriter = field(default_factory=FrameWriter)
    #: In order: a shape that was not sent, or ``None`` for the next one of the request.
    results: list[t.Added | None] = field(default_factory=list)

    def request_id(self, index: int) -> str:
        """The same for the same shapes at the same place, whoever sends them."""
        digest = hashlib.blake2b(self.request.SerializeToString(deterministic=True), digest_size=16)
        for frame in self.writer.frames:
            digest.update(len(frame).to_bytes(8, "little"))
            digest.update(frame)
        return f"{index}-{digest.hexdigest()}"


def batches(
    collection: str,
    items: Iterable[Item],
    limits: t.Limits,
    in_flight: int,
    replace: bool,
    create: collection_pb2.CollectionSpec | None,
) -> Iterator[Batch]:
    """Cuts a stream into batches; one that cannot be read becomes a failed result in its place."""
    if in_flight < 1:
        raise ValueError(f"in_flight is {in_flight}, expected at least 1")
    # A batch that the whole queue cannot hold would be refused for ever.
    n_shapes = max(
        1, min(BATCH_SHAPES, in_flight // 4, limits.max_shapes_per_request, limits.max_queued_shapes)
    )
    n_bytes = min(BATCH_BYTES, limits.max_message_bytes // 2)
    empty = job_pb2.AddShapesRequest(collection=collection, mode=job_pb2.ADD_MODE_JOB, create=create)

    def new() -> Batch:
        request = job_pb2.AddShapesRequest()
        request.CopyFrom(empty)
        return Batch(request)

    batch = new()
    for item in items:
        name, mesh = (Path(item).stem, item) if isinstance(item, str | os.PathLike) else item
        one = FrameWriter()
        try:
            shape = shape_input(name, mesh, replace, one)
            if one.n_bytes > limits.max_shape_bytes and shape.HasField("encoded"):
                limit = limits.max_shape_bytes
                key = "limits.max_shape, within limits.memory"
                raise BadMesh(beyond(f"{name}: the file has", one.n_bytes, limit, key))
            if one.n_bytes > limits.max_message_bytes * 15 // 16:
                limit = limits.max_message_bytes
                key = "limits.max_message, of which arrays may have 15 in 16"
                raise BadMesh(beyond(f"{name}: the arrays have", one.n_bytes, limit, key))
        except (BadMesh, OSError) as e:
            batch.results.append(t.Added(name, "failed", error=e))
            continue
        full = len(batch.request.shapes) == n_shapes or batch.writer.n_bytes + one.n_bytes > n_bytes
        if full and batch.request.shapes:
            yield batch
            batch = new()
        _renumber(shape, len(batch.writer.frames))
        batch.request.shapes.append(shape)
        batch.writer.frames += one.frames
        batch.writer.n_bytes += one.n_bytes
        batch.results.append(None)
    if batch.results:
        yield batch


def _renumber(shape: job_pb2.ShapeInput, first: int) -> None:
    if shape.HasField("encoded"):
        shape.encoded.bytes.frame += first
    else:
        shape.arrays.vertices.frame += first
        shape.arrays.faces.frame += first
