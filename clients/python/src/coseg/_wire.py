"""Values become frames and frames become values; nothing here touches a socket."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from google.protobuf.message import Message
from numpy.typing import ArrayLike, NDArray

from coseg import types as t
from coseg._gltf import read_mesh
from coseg._link import Frame
from coseg.errors import BadMesh, BadReply, Refused
from coseg.v1 import (
    analysis_pb2,
    array_pb2,
    collection_pb2,
    correction_pb2,
    daemon_pb2,
    event_pb2,
    job_pb2,
    link_pb2,
    message_pb2,
    portrait_pb2,
    proposal_pb2,
    question_pb2,
    review_pb2,
    shape_pb2,
)

_DTYPES: dict[int, np.dtype[Any]] = {
    array_pb2.DATA_TYPE_INT32: np.dtype("<i4"),
    array_pb2.DATA_TYPE_UINT32: np.dtype("<u4"),
    array_pb2.DATA_TYPE_FLOAT32: np.dtype("<f4"),
    array_pb2.DATA_TYPE_FLOAT64: np.dtype("<f8"),
}
_WIRE_DTYPES: dict[np.dtype[Any], Any] = {dtype: wire for wire, dtype in _DTYPES.items()}


#: Most kinds of parts that a collection can be told to have.
MAX_PARTS = 64


@runtime_checkable
class HasFaces(Protocol):
    """A mesh object, such as ``trimesh.Trimesh``."""

    @property
    def vertices(self) -> Any:
        """(n, 3)."""

    @property
    def faces(self) -> Any:
        """(m, 3)."""


#: A mesh: the path of a file, the bytes of one, ``(vertices, faces)``, or an object that has both.
MeshLike = str | os.PathLike[str] | t.Encoded | tuple[ArrayLike, ArrayLike] | HasFaces


class FrameWriter:
    """Collects the raw frames of a request."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.n_bytes = 0

    def file(self, data: bytes) -> array_pb2.BytesRef:
        """Appends the bytes of a file."""
        return array_pb2.BytesRef(frame=self._push(data))

    def array(self, values: NDArray[Any]) -> array_pb2.ArrayRef:
        """Appends an array of one of the protocol's types."""
        dtype = values.dtype.newbyteorder("<")
        flat = np.ascontiguousarray(values, dtype=dtype).reshape(-1).view(np.uint8)
        frame = self._push(flat.data)
        return array_pb2.ArrayRef(dtype=_WIRE_DTYPES[dtype], shape=values.shape, frame=frame)

    def _push(self, frame: Frame) -> int:
        self.frames.append(frame)
        self.n_bytes += len(frame)
        return len(self.frames) - 1


def shape_input(name: str, mesh: MeshLike, replace: bool, writer: FrameWriter) -> job_pb2.ShapeInput:
    """A shape to add; its bytes go to ``writer``. Raises :class:`BadMesh` or :class:`OSError`."""
    shape = job_pb2.ShapeInput(name=name, replace=replace)
    if isinstance(mesh, str | os.PathLike):
        path = Path(mesh)
        mesh = t.Encoded(path.suffix.removeprefix(".").lower(), read_mesh(path))
    if isinstance(mesh, t.Encoded):
        shape.encoded.format = mesh_format(mesh.format)
        shape.encoded.bytes.CopyFrom(writer.file(mesh.data))
        return shape
    if isinstance(mesh, tuple) and len(mesh) == 2:
        vertices, faces = np.asarray(mesh[0]), np.asarray(mesh[1])
    elif isinstance(mesh, HasFaces):
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    else:
        raise BadMesh(f"{name}: a {type(mesh).__name__} is no mesh")
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise BadMesh(f"{name}: vertices are {vertices.dtype}{vertices.shape}, expected real (n, 3)")
    if faces.ndim != 2 or faces.shape[1] < 3 or faces.dtype.kind not in "iu":
        raise BadMesh(f"{name}: faces are {faces.dtype}{faces.shape}, expected integer (m, d ≥ 3)")
    if vertices.dtype != np.float32:
        vertices = vertices.astype(np.float64)
    if faces.size and not 0 <= int(faces.min()) <= int(faces.max()) < len(vertices):
        bad = faces.min() if faces.min() < 0 else faces.max()
        raise BadMesh(f"{name}: a face names vertex {bad}, but the mesh has {len(vertices)}")
    shape.arrays.vertices.CopyFrom(writer.array(vertices))
    shape.arrays.faces.CopyFrom(writer.array(faces.astype(np.uint32, copy=False)))
    return shape


def mesh_format(name: str) -> Any:
    """The format of that name or file extension."""
    # A GLB is a glTF in one binary file.
    name = "gltf" if name.lower() == "glb" else name
    key = f"MESH_FORMAT_{name.upper()}"
    if name.lower() == "unspecified" or key not in job_pb2.MeshFormat.keys():
        known = ", ".join(n.removeprefix("MESH_FORMAT_").lower() for n in job_pb2.MeshFormat.keys()[1:])
        raise BadMesh(f"{name!r} is no mesh format; known are {known}")
    return job_pb2.MeshFormat.Value(key)


def dtype_of(value: Any) -> np.dtype[Any]:
    """The type of the elements of an array."""
    return _DTYPES[value]


def format_name(value: int) -> str:
    """The name of a format, such as ``off``."""
    return enum_name(job_pb2.MeshFormat, "MESH_FORMAT_", value)


class Raw:
    """The raw frames of a reply."""

    def __init__(self, frames: Sequence[memoryview]) -> None:
        self._frames = frames

    def array(self, ref: array_pb2.ArrayRef) -> NDArray[Any]:
        """An array, copied from its frame."""
        dtype = _DTYPES.get(ref.dtype)
        if dtype is None:
            raise BadReply(f"an array has element type {ref.dtype}")
        frame = self._frame(ref.frame)
        shape = tuple(ref.shape)
        if len(frame) != dtype.itemsize * int(np.prod(shape, dtype=object)):
            raise BadReply(f"an array of shape {shape} and type {dtype} has {len(frame)} bytes")
        values: NDArray[Any] = np.frombuffer(frame, dtype).reshape(shape)
        return values.astype(dtype.newbyteorder("="))

    def file(self, ref: array_pb2.BytesRef) -> bytes:
        """The bytes of a file."""
        return bytes(self._frame(ref.frame))

    def _frame(self, index: int) -> memoryview:
        if index >= len(self._frames):
            raise BadReply(f"frame {index} is named, but the reply has {len(self._frames)}")
        return self._frames[index]


T = TypeVar("T")


def flat(cls: type[T], message: Message, **others: object) -> T:
    """A value of ``cls`` from the message's fields of the same names."""
    values = dict(others)
    for f in fields(cls):  # type: ignore[arg-type]
        if f.name not in values:
            value = getattr(message, f.name)
            values[f.name] = (
                tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value
            )
    return cls(**values)


def enum_name(wrapper: Any, prefix: str, value: int) -> str:
    """The name of an enum's value without its prefix, in lower case; a number if it is unknown."""
    known = wrapper.DESCRIPTOR.values_by_number.get(value)
    return str(known.name).removeprefix(prefix).lower() if known else str(value)


def plain(message: Message) -> dict[str, object]:
    """A message without arrays as plain values; what is optional and absent is ``None``."""
    values: dict[str, object] = {}
    for f in message.DESCRIPTOR.fields:
        value = getattr(message, f.name)
        if f.has_presence and not message.HasField(f.name):
            values[f.name] = None
        elif f.message_type is None:
            values[f.name] = list(value) if f.is_repeated else value
        elif f.is_repeated:
            values[f.name] = [plain(v) for v in value]
        else:
            values[f.name] = plain(value)
    return values


# -- replies ------------------------------------------------------------------------------------


def hello(reply: daemon_pb2.HelloReply) -> t.Hello:
    """Who the daemon is."""
    formats = tuple(map(format_name, reply.formats))
    return flat(t.Hello, reply, formats=formats, limits=flat(t.Limits, reply.limits))


def label(info: collection_pb2.LabelInfo) -> t.Label:
    """A label."""
    merged = info.merged_into if info.HasField("merged_into") else None
    return flat(t.Label, info, merged_into=merged)


def up_name(value: int) -> str:
    """An axis as the command line writes it: ``+y``, ``unknown``, ``auto``."""
    name = enum_name(collection_pb2.Up, "UP_", value)
    return name.replace("plus_", "+").replace("minus_", "-")


def up_value(name: str) -> Any:
    """The axis of that name."""
    key = "UP_" + name.upper().replace("+", "PLUS_").replace("-", "MINUS_")
    return _value(collection_pb2.Up, key, f"up is {name!r}")


def changed_label(reply: correction_pb2.MergeLabelsReply | correction_pb2.SplitLabelReply) -> t.ChangedLabel:
    """A label after a merge or a split."""
    return t.ChangedLabel(**vars(label(reply.label)), n_changed=reply.n_shapes)


def review_state(name: str) -> Any:
    """A verdict by its name."""
    return _value(review_pb2.ReviewState, f"REVIEW_STATE_{name.upper()}", f"review is {name!r}")


def link_kind(name: str) -> Any:
    """What a link demands, by its name."""
    return _value(link_pb2.LinkKind, f"LINK_KIND_{name.upper()}", f"kind is {name!r}")


def part_of_shape(part: tuple[str, int]) -> link_pb2.PartOfShape:
    """A part by its shape and its number."""
    shape, number = part
    return link_pb2.PartOfShape(shape=shape, part=number)


def link(message: link_pb2.Link) -> t.Link:
    """A link between two parts."""
    return flat(
        t.Link,
        message,
        kind=enum_name(link_pb2.LinkKind, "LINK_KIND_", message.kind),
        a=(message.a.shape, message.a.part),
        b=(message.b.shape, message.b.part),
    )


def linked(reply: link_pb2.LinkPartsReply) -> t.Linked:
    """A link that was made."""
    return flat(t.Linked, reply, link=link(reply.link))


def question(reply: question_pb2.NextQuestionReply, raw: Raw) -> t.Question:
    """The part to ask a person about."""
    return flat(
        t.Question,
        reply,
        faces=raw.array(reply.faces),
        likeliest=tuple(flat(t.OfferedLabel, label) for label in reply.likeliest),
    )


def proposals(reply: proposal_pb2.ListProposalsReply) -> t.Proposals:
    """The proposals of a collection."""
    found = tuple(flat(t.Proposal, proposal) for proposal in reply.proposals)
    return flat(t.Proposals, reply, proposals=found)


def answered(reply: question_pb2.AnswerQuestionReply) -> t.Answered:
    """What an answer did."""
    corrected = flat(t.Corrected, reply.corrected) if reply.HasField("corrected") else None
    return t.Answered(reply.label if reply.HasField("label") else None, corrected)


def collection(message: collection_pb2.Collection) -> t.CollectionInfo:
    """A collection."""
    spec = message.spec
    estimates: dict[str, t.UpEstimate | None] = {}
    for field in ("up_estimate", "up_disagrees"):
        found = getattr(message, field)
        is_there = message.HasField(field)
        estimates[field] = t.UpEstimate(up_name(found.up), found.agreement) if is_there else None
    return flat(
        t.CollectionInfo,
        message,
        name=spec.name,
        n_parts=spec.n_parts,
        up=up_name(spec.up),
        operator=enum_name(collection_pb2.Operator, "OPERATOR_", spec.operator).replace("_", "-"),
        working_faces=spec.working_faces,
        labels=tuple(map(label, message.labels)),
        reviews=flat(t.ReviewCounts, message.reviews),
        **estimates,
    )


def portrait_detail(name: str) -> Any:
    """What a portrait shows of a shape."""
    return _value(portrait_pb2.PortraitDetail, f"PORTRAIT_DETAIL_{name.upper()}", f"detail is {name!r}")


def collection_spec(
    name: str, parts: int | None, up: str | None, operator: str | None, working_faces: int
) -> collection_pb2.CollectionSpec:
    """What a collection is created with."""
    spec = collection_pb2.CollectionSpec(name=name, working_faces=working_faces)
    if parts is not None:
        if not 0 <= parts <= MAX_PARTS:
            raise ValueError(f"parts is {parts}, but must be 1 to {MAX_PARTS}, or 0: estimated")
        spec.n_parts = parts
    if up is not None:
        spec.up = up_value(up)
    if operator is not None:
        key = "OPERATOR_" + operator.upper().replace("-", "_")
        spec.operator = _value(collection_pb2.Operator, key, f"operator is {operator!r}")
    return spec


def _value(wrapper: Any, key: str, what: str) -> Any:
    if key not in wrapper.keys() or key.endswith("_UNSPECIFIED"):
        raise ValueError(f"{what}, which is none of its values")
    return wrapper.Value(key)


def shape(message: shape_pb2.Shape) -> t.Shape:
    """A shape."""
    return flat(
        t.Shape,
        message,
        report=plain(message.report),
        parts=tuple(flat(t.Part, p) for p in message.parts),
        sources=tuple(flat(t.Source, s) for s in message.sources),
        review=t.Review(
            enum_name(review_pb2.ReviewState, "REVIEW_STATE_", message.review.state),
            by=message.review.by,
            unix_ms=message.review.unix_ms,
        ),
    )


def item(message: job_pb2.JobItem) -> t.JobItem:
    """One shape of a job."""
    state = enum_name(job_pb2.ItemState, "ITEM_STATE_", message.state)
    result = None
    if state == "done":
        placed = message.placed
        result = t.Added(
            message.name,
            enum_name(job_pb2.Outcome, "OUTCOME_", placed.outcome),
            version=placed.version,
            sequence=placed.sequence,
            n_maps=placed.n_maps,
            n_relabelled=placed.n_relabelled,
            n_inconsistent=placed.n_inconsistent,
            stages={s.stage: s.ms for s in placed.stages},
        )
    elif state in ("failed", "cancelled"):
        error = Refused.from_wire(message.error) if message.HasField("error") else None
        result = t.Added(message.name, state, error=error)
    return t.JobItem(message.index, message.name, state, message.stage, result, message.attempts)


def job(message: job_pb2.Job) -> t.Job:
    """A job."""
    carrying = flat(t.Carrying, message.carrying) if message.HasField("carrying") else None
    items = tuple(map(item, message.items))
    return flat(t.Job, message, id=message.job_id, items=items, carrying=carrying)


def retried(reply: job_pb2.RetryJobReply) -> t.RetriedJob:
    """A job whose failed shapes were queued again."""
    return t.RetriedJob(**vars(job(reply.job)), n_queued=reply.n_queued)


def labelling(reply: shape_pb2.GetLabelsReply, raw: Raw) -> t.Labelling:
    """The labels of a shape."""
    confidence = raw.array(reply.confidence) if reply.HasField("confidence") else None
    return t.Labelling(reply.version, raw.array(reply.labels), confidence)


def snapshot(reply: shape_pb2.LabelsSnapshotReply, raw: Raw) -> t.Snapshot:
    """The labels of all shapes."""
    shapes = {s.shape: t.Labelling(s.version, raw.array(s.labels)) for s in reply.shapes}
    return t.Snapshot(reply.sequence, shapes)


def spectrum(reply: analysis_pb2.GetSpectrumReply, raw: Raw) -> t.Spectrum:
    """Eigenpairs."""
    return t.Spectrum(
        raw.array(reply.eigenvalues),
        raw.array(reply.eigenvectors) if reply.HasField("eigenvectors") else None,
        raw.array(reply.mass) if reply.HasField("mass") else None,
        reply.area,
    )


def descriptors(reply: analysis_pb2.GetDescriptorsReply, raw: Raw) -> t.Descriptors:
    """The working mesh and its descriptors."""
    return t.Descriptors(**{f.name: raw.array(getattr(reply, f.name)) for f in fields(t.Descriptors)})


def map_quality(message: analysis_pb2.MapQuality) -> t.MapQuality:
    """How good a map is."""
    return t.MapQuality(**plain(message))  # type: ignore[arg-type]


def functional_map(
    source: str, target: str, reply: analysis_pb2.GetFunctionalMapReply, raw: Raw
) -> t.FunctionalMap:
    """A functional map."""
    alternative = None
    rows = resolution_name(reply.resolution)
    if reply.HasField("alternative_c_12"):
        alternative = t.FunctionalMap(
            source,
            target,
            raw.array(reply.alternative_c_12),
            raw.array(reply.alternative_p2p_21),
            map_quality(reply.alternative_quality),
            raw.array(reply.alternative_matched) != 0,
            n1=reply.n1,
            resolution=rows,
        )
    return t.FunctionalMap(
        source,
        target,
        raw.array(reply.c_12),
        raw.array(reply.p2p_21),
        map_quality(reply.quality),
        raw.array(reply.matched) != 0,
        confidence=raw.array(reply.confidence) if reply.HasField("confidence") else None,
        agreement=flat(t.MapAgreement, reply.agreement) if reply.HasField("agreement") else None,
        alternative=alternative,
        alternative_cost=reply.alternative_cost if reply.HasField("alternative_cost") else None,
        n1=reply.n1,
        resolution=rows,
    )


def resolution(name: t.Resolution) -> int:
    """What the rows of arrays are of: ``input``, ``input_faces`` or ``proxy``."""
    key = f"RESOLUTION_{name.upper()}"
    return int(_value(analysis_pb2.Resolution, key, f"resolution is {name!r}"))


def landmark_resolution(name: t.LandmarkResolution) -> int:
    """Which vertices landmarks are: ``input`` or ``proxy``."""
    if name not in ("input", "proxy"):
        raise ValueError(f'landmark_resolution is {name!r}, but must be "input" or "proxy"')
    return resolution(name)


def resolution_name(value: int) -> t.Resolution:
    """Its name; the daemons that know none have rows of the proxy."""
    names: tuple[t.Resolution, ...] = ("proxy", "proxy", "input", "input_faces")
    if not 0 <= value < len(names):
        raise BadReply(f"the reply has resolution {value}, which this client does not know")
    return names[value]


def check_resolution(found: int, wanted: t.Resolution, unset: t.Resolution | None = "proxy") -> None:
    """Refuses arrays with other rows than were asked for. Daemons that know no resolution send what
    ``unset`` says, which is taken where that was asked for."""
    if found != resolution(wanted) and not (found == 0 and wanted == unset):
        raise BadReply(
            f"a row for each {t.ROWS[wanted]} was asked for, and the daemon answers otherwise: it is too "
            'old for that; resolution="proxy" asks for the working mesh'
        )


def orientation(name: str | None) -> int:
    """Which of the maps between shapes that have a reflection: ``keep``, ``reverse``, or, without a name, the
    one that keeps orientation unless it is much worse."""
    if name is None:
        return 0
    key = f"MAP_ORIENTATION_{name.upper()}"
    return int(_value(analysis_pb2.MapOrientation, key, f"orientation is {name!r}"))


def part_matches(reply: analysis_pb2.GetPartCorrespondenceReply) -> t.PartMatches:
    """Matching parts."""
    matches = tuple(flat(t.PartMatch, m) for m in reply.matches)
    return t.PartMatches(matches, map_quality(reply.quality))


def event(message: event_pb2.Event) -> t.Event:
    """An event."""
    kind = message.WhichOneof("kind")
    data: Mapping[str, object] = plain(getattr(message, kind)) if kind else {}
    return t.Event(message.sequence, message.collection, kind or "unknown", data)


def result(reply: message_pb2.Reply, body: str) -> Any:
    """The result of the reply to a request with that body; a refusal is raised."""
    kind = reply.WhichOneof("result")
    if kind == "error":
        raise Refused.from_wire(reply.error)
    if kind != body:
        raise BadReply(f"the reply to {body} has {kind or 'no result'}")
    return getattr(reply, body)
