"""Records conversations with a real daemon: the bytes of requests and replies, and what they mean.

``python tests/golden/record.py BINARY`` writes ``*.bin`` and ``index.json`` beside this file. It needs the
Python client's package (for the messages) and pyzmq. What differs between two runs (instance, version,
process, times, endpoints) is set to fixed values in the replies: a second recording gives the same files.

A ``.bin`` file is one message: for each frame its length (4 bytes, little-endian) and its bytes. Reasons
that no request can bring about on a healthy machine are composed, and the index says so.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zmq
from coseg.v1 import error_pb2, event_pb2, message_pb2
from google.protobuf.json_format import MessageToDict, ParseDict
from google.protobuf.message import DecodeError

HERE = Path(__file__).parent
CLIENT = "golden"
FRAMES = list[bytes]
#: Settings of the daemons; each conversation names one. What is recorded with one is one sequence.
DAEMONS: dict[str, dict[str, str]] = {
    "plain": {},
    "small": {
        "COSEG__LIMITS__MAX_QUEUED_SHAPES": "1",
        "COSEG__LIMITS__MAX_SHAPE": "2KiB",
        "COSEG__LIMITS__MAX_SHAPES_PER_REQUEST": "2",
    },
    "tcp": {},
    "asking": {},
    "linking": {},
}


def skittle(variant: int, sectors: int = 8, rings: int = 10) -> bytes:
    """A closed surface of a body and a head, as an OFF file."""
    vertices = [(0.0, 0.0, -1.0)]
    for ring in range(1, rings):
        t = ring / rings
        neck = 1 - (0.55 + 0.02 * variant) * math.exp(-(((t - 0.68) / 0.1) ** 2))
        r = math.sin(math.pi * t) * neck
        for s in range(sectors):
            a = 2 * math.pi * s / sectors
            vertices.append((r * math.cos(a), r * math.sin(a), -1 + t * (3 + 0.1 * variant)))
    vertices.append((0.0, 0.0, 2 + 0.1 * variant))

    def at(ring: int, s: int) -> int:
        return 1 + (ring - 1) * sectors + s % sectors

    faces = []
    for s in range(sectors):
        faces += [(0, at(1, s + 1), at(1, s)), (len(vertices) - 1, at(rings - 1, s), at(rings - 1, s + 1))]
        for ring in range(1, rings - 1):
            faces.append((at(ring, s), at(ring, s + 1), at(ring + 1, s)))
            faces.append((at(ring, s + 1), at(ring + 1, s + 1), at(ring + 1, s)))
    lines = [f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    return f"OFF\n{len(vertices)} {len(faces)} 0\n".encode() + "\n".join(lines).encode() + b"\n"


#: The fewest that the daemon takes: small arrays are enough here.
WORKING_FACES = 200
N_FACES = 2 * 8 * 9


def int32(*values: int) -> bytes:
    return b"".join(v.to_bytes(4, "little", signed=True) for v in values)


def floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


class Daemon:
    """A daemon with its settings on an empty library."""

    def __init__(self, binary: str, name: str) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="coseg")
        self.endpoint = "tcp://127.0.0.1:0" if name == "tcp" else f"ipc://{self.folder.name}/s"
        env = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")}
        command = [binary, "serve", "--library", f"{self.folder.name}/library", "--endpoint", self.endpoint]
        log = Path(self.folder.name, "log")
        with log.open("wb") as out:
            self.process = subprocess.Popen(
                command, stderr=out, env={**env, **DAEMONS[name], "NO_COLOR": "1"}
            )
        while "serving" not in log.read_text():
            if self.process.poll() is not None:
                raise SystemExit(f"{name}: the daemon does not start:\n{log.read_text()}")
            time.sleep(0.02)
        if name == "tcp":
            line = next(x for x in log.read_text().splitlines() if "endpoint" in x)
            self.endpoint = next(w for w in line.replace("=", " ").split() if w.startswith("tcp://"))
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.linger = 0
        self.socket.rcvtimeo = 60_000
        self.socket.connect(self.endpoint)

    def exchange(self, frames: FRAMES) -> FRAMES:
        self.socket.send_multipart(frames)
        return self.socket.recv_multipart()

    def close(self) -> None:
        self.context.destroy(linger=0)
        self.process.kill()
        self.process.wait()
        self.folder.cleanup()


def mask(reply: message_pb2.Reply) -> None:
    """Sets what differs between two runs to fixed values."""
    if reply.HasField("hello"):
        reply.hello.version = "0.0.0"
        reply.hello.instance = "instance"
        reply.hello.event_endpoint = "ipc:///run/coseg/coseg.sock.events"
    if reply.HasField("stats"):
        for field, value in reply.stats.ListFields():
            if isinstance(value, str):
                setattr(reply.stats, field.name, "0.0.0")
            elif not field.name.startswith("n_"):
                setattr(reply.stats, field.name, 1)
    for body in ("add_shapes", "get_job", "watch_job", "cancel_job"):
        if reply.HasField(body):  # type: ignore[arg-type]
            for item in getattr(reply, body).job.items:
                for stage in item.placed.stages:
                    stage.ms = 1.5
    if reply.HasField("list_shapes"):
        for shape in reply.list_shapes.shapes:
            if shape.review.unix_ms:
                shape.review.unix_ms = 1
    for body in ("link_parts", "unlink_parts"):
        if reply.HasField(body):  # type: ignore[arg-type]
            getattr(reply, body).link.unix_ms = 1
    if reply.HasField("list_links"):
        for link in reply.list_links.links:
            link.unix_ms = 1


class Recorder:
    """Keeps conversations and writes them."""

    def __init__(self) -> None:
        self.index: list[dict[str, Any]] = []
        self.daemon: Daemon | None = None
        self.daemon_name = ""
        for old in HERE.glob("*.bin"):
            old.unlink()

    def keep(self, name: str, shows: str, request: FRAMES, reply: FRAMES, origin: str) -> None:
        for what, frames in (("request", request), ("reply", reply)):
            packed = b"".join(len(f).to_bytes(4, "little") + f for f in frames)
            (HERE / f"{name}.{what}.bin").write_bytes(packed)
        decoded = message_pb2.Reply.FromString(reply[0])
        entry: dict[str, Any] = {"name": name, "shows": shows, "origin": origin}
        if origin == "recorded":
            entry["daemon"] = self.daemon_name
        try:
            asked = message_pb2.Request.FromString(request[0])
            # An empty body is its message all the same; unknown ones have no text.
            if asked.WhichOneof("body"):
                entry["request"] = MessageToDict(asked, preserving_proto_field_name=True)
        except DecodeError:
            pass  # that is what such a conversation shows
        entry["reply"] = MessageToDict(decoded, preserving_proto_field_name=True)
        entry["reply_frames"] = [
            {"bytes": len(f), "sha256": hashlib.sha256(f).hexdigest()} for f in reply[1:]
        ]
        assert all(e["name"] != name for e in self.index), name
        self.index.append(entry)

    def say(
        self,
        name: str,
        shows: str,
        frames: Sequence[bytes] = (),
        *,
        raw: bytes | None = None,
        request_id: str = "",
        deadline_ms: int = 0,
        **body: Any,
    ) -> Any:
        """One conversation; ``body`` is one field of the request."""
        request = message_pb2.Request(
            request_id=request_id or name, client_id=CLIENT, deadline_ms=deadline_ms
        )
        if body:
            ParseDict(body, request)
        sent = [request.SerializeToString() if raw is None else raw, *frames]
        assert self.daemon is not None
        answer = self.daemon.exchange(sent)
        reply = message_pb2.Reply.FromString(answer[0])
        mask(reply)
        answer[0] = reply.SerializeToString()
        self.keep(name, shows, sent, answer, "recorded")
        return reply

    def settle(self, collection: str) -> None:
        """Waits, unrecorded, until changes have been propagated: what follows has their versions."""
        assert self.daemon is not None
        request = message_pb2.Request(request_id="settle", client_id="")
        request.wait_idle.collection, request.wait_idle.wait_ms = collection, 20_000
        answer = message_pb2.Reply.FromString(self.daemon.exchange([request.SerializeToString()])[0])
        assert answer.wait_idle.idle, answer

    def compose(self, reason: str, code: str, message: str, **more: Any) -> None:
        """A refusal that cannot be brought about at will."""
        name = f"composed_{reason.lower()}"
        request = message_pb2.Request(request_id=name, client_id=CLIENT)
        request.get_hks.collection, request.get_hks.shape = "things", "a"
        error = error_pb2.Error(message=message, **more)
        error.code = error_pb2.ErrorCode.Value(f"ERROR_CODE_{code}")
        error.reason = error_pb2.ErrorReason.Value(f"ERROR_REASON_{reason}")
        reply = message_pb2.Reply(request_id=name, error=error)
        shows = f"{code} / {reason}, composed"
        self.keep(name, shows, [request.SerializeToString()], [reply.SerializeToString()], "composed")

    def reasons(self) -> set[str]:
        """Reasons that some conversation shows, of requests and of shapes."""
        found: set[str] = set()

        def walk(value: Any) -> None:
            if isinstance(value, dict):
                if "reason" in value and "code" in value:
                    found.add(value["reason"].removeprefix("ERROR_REASON_"))
                for v in value.values():
                    walk(v)
            elif isinstance(value, list):
                for v in value:
                    walk(v)

        for entry in self.index:
            walk(entry["reply"])
        return found

    def write(self) -> None:
        text = json.dumps(self.index, indent=1, ensure_ascii=False)
        (HERE / "index.json").write_text(text + "\n")


def encoded(name: str, frame: int = 0, **more: Any) -> dict[str, Any]:
    mesh = {"format": "MESH_FORMAT_OFF", "bytes": {"frame": frame}}
    return {"name": name, "encoded": mesh, **more}


def add(shapes: list[dict[str, Any]], collection: str = "things", **more: Any) -> dict[str, Any]:
    return {"add_shapes": {"collection": collection, "shapes": shapes, "mode": "ADD_MODE_WAIT", **more}}


def plain(r: Recorder) -> None:
    """What a library goes through, and what is refused on the way."""
    a, b = skittle(0), skittle(3)
    of = {"collection": "things"}
    one = {**of, "shape": "a"}
    r.say("hello", "who the daemon is; instance, version and endpoint are masked", hello={})
    r.say("stats", "counters; all but n_* are masked", stats={})
    spec = {"name": "things", "n_parts": 2, "up": "UP_PLUS_Z", "working_faces": WORKING_FACES}
    r.say("create_collection", "a new collection, every setting stated", create_collection={"spec": spec})
    r.say(
        "create_collection_again",
        "the same request again has one effect and the same reply",
        request_id="create_collection",
        create_collection={"spec": spec},
    )
    r.say(
        "error_request_id_reused",
        "another request under an id that was used",
        request_id="create_collection",
        delete_collection=of,
    )
    r.say("list_collections", "all collections", list_collections={})
    r.say("add_shapes_files", "two files, waited for", [a, b], **add([encoded("a"), encoded("b", 1)]))
    r.say("add_shapes_unchanged", "the same name with the same bytes", [a], **add([encoded("a")]))
    quads = floats(0, 0, 0, 2, 0, 0, 2, 1, 0, 0, 1, 0, 0, 0, 1, 2, 0, 1, 2, 1, 1, 0, 1, 1)
    faces = int32(3, 2, 1, 0, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7)
    arrays = {
        "vertices": {"dtype": "DATA_TYPE_FLOAT64", "shape": [8, 3], "frame": 0},
        "faces": {"dtype": "DATA_TYPE_INT32", "shape": [6, 4], "frame": 1},
    }
    create = {"n_parts": 1}
    r.say(
        "add_shapes_arrays",
        "vertices and polygons as arrays; the collection is created",
        [quads, faces],
        **add([{"name": "box", "arrays": arrays}], "boxes", create=create),
    )
    r.say(
        "add_shapes_job",
        "accepted, not waited for",
        [b],
        add_shapes={**of, "shapes": [encoded("b")], "mode": "ADD_MODE_JOB"},
    )
    job = r.say("wait_idle", "nothing is left to do", wait_idle={**of, "wait_ms": 20000})
    assert job.wait_idle.idle
    r.say("get_job", "a finished job", get_job={"job_id": 1})
    r.say("watch_job", "a finished job is answered at once", watch_job={"job_id": 1, "wait_ms": 1000})
    r.say("cancel_job", "a finished job stays as it is", cancel_job={"job_id": 1})
    r.say("describe_collection", "a collection with labels", describe_collection=of)
    r.say("list_shapes", "all shapes", list_shapes=of)
    page = r.say("list_shapes_first_page", "one shape and a token", list_shapes={**of, "page_size": 1})
    token = page.list_shapes.next_page_token
    r.say("list_shapes_next_page", "the rest", list_shapes={**of, "page_size": 1, "page_token": token})
    r.say(
        "list_shapes_of_label",
        "shapes that carry label 0, which is not the same as no label",
        list_shapes={**of, "label": 0},
    )
    r.say("get_shape", "one shape", get_shape=one)
    r.say("get_labels", "labels as int32 in a raw frame", get_labels=one)
    r.say("get_labels_confidence", "labels and their probabilities", get_labels={**one, "confidence": True})
    r.say("get_labels_version", "a version by its number", get_labels={**one, "version": 1})
    r.say("labels_snapshot", "labels of all shapes as of one event", labels_snapshot=of)
    r.say("get_original", "the bytes that were sent", get_original=one)
    r.say(
        "get_original_arrays",
        "arrays are kept as an OFF file",
        get_original={"collection": "boxes", "shape": "box"},
    )
    r.say("get_spectrum", "eigenvalues alone", get_spectrum=one)
    r.say("get_spectrum_eigenvectors", "eigenpairs and mass", get_spectrum={**one, "eigenvectors": True})
    r.say("get_hks", "a float32 matrix", get_hks=one)
    r.say("get_descriptors", "seven arrays", get_descriptors=one)
    r.say(
        "get_functional_map",
        "c_12 from a to b, p2p_21 from b to a",
        get_functional_map={**of, "from": "a", "to": "b"},
    )
    r.say(
        "get_part_correspondence",
        "which part matches which",
        get_part_correspondence={**of, "shape_a": "a", "shape_b": "b"},
    )
    r.say("nearest", "neighbours", nearest={**one, "limit": 3})
    sent(r)
    r.say("events_since", "the whole log", events_since=of)
    r.say("events_since_limit", "one event, and that there are more", events_since={**of, "limit": 1})
    r.say("suggest_next", "the shape to label next", suggest_next=of)
    labels = [-1] * N_FACES
    labels[:3] = [7, 7, 7]
    ref = {"dtype": "DATA_TYPE_INT32", "shape": [N_FACES], "frame": 0}
    r.say(
        "correct_labels",
        "three faces are labelled by hand",
        [int32(*labels)],
        correct_labels={**one, "labels": ref},
    )
    r.settle("things")
    some = {"dtype": "DATA_TYPE_UINT32", "shape": [2], "frame": 0}
    r.say(
        "correct_labels_faces",
        "a list of faces",
        [int32(5, 6)],
        correct_labels={**one, "faces": {"faces": some, "label": 8}},
    )
    r.settle("things")
    r.say("correct_labels_part", "a part", correct_labels={**one, "part": {"part": 0, "label": 7}})
    r.settle("things")
    r.say("name_label", "a label gets a name", name_label={**of, "label": 7, "name": "head"})
    r.say("merge_labels", "8 is 7 from now on", merge_labels={**of, "label": 8, "into": 7})
    r.settle("things")
    r.say("error_label_merged", "a label that was merged cannot be split", split_label={**of, "label": 8})
    r.say("split_label", "two of one", split_label={**of, "label": 7})
    r.settle("things")
    r.say("undo", "the split is taken back", undo=of)
    r.say("wait_idle_after_undo", "the other shape has followed", wait_idle={**of, "wait_ms": 20000})
    r.say("update_collection", "another up axis", update_collection={**of, "up": "UP_PLUS_Z"})
    r.say("wait_idle_after_up", "all shapes have followed", wait_idle={**of, "wait_ms": 20000})

    r.say("error_malformed_message", "the header is no Request", raw=b"\xff\xff\xff")
    r.say("error_unknown_request", "a body that this version does not know", raw=b"\x0a\x05later\xba\x3e\x00")
    r.say("error_frame_missing", "frame 5 is named, none was sent", **add([encoded("x", 5)]))
    short = {
        "vertices": {"dtype": "DATA_TYPE_FLOAT64", "shape": [9, 3], "frame": 0},
        "faces": arrays["faces"],
    }
    r.say(
        "error_frame_length",
        "an array that its frame cannot hold",
        [quads, faces],
        **add([{"name": "x", "arrays": short}]),
    )
    r.say("error_message_too_large", "1,100 raw frames", [b""] * 1100, get_hks=one)
    r.say("error_field_range", "a wait beyond the limit", wait_idle={**of, "wait_ms": 10**9})
    r.say("error_field_missing", "a collection without a spec", create_collection={})
    r.say("error_bad_name", "an empty name", create_collection={"spec": {"name": ""}})
    r.say(
        "error_n_parts_range", "too many parts", create_collection={"spec": {"name": "n", "n_parts": 100000}}
    )
    r.say(
        "error_working_faces_range",
        "too few working faces",
        create_collection={"spec": {"name": "n", "working_faces": 1}},
    )
    r.say("error_collection_exists", "a name that is taken", create_collection={"spec": {"name": "things"}})
    r.say(
        "error_collection_differs",
        "other settings than it has",
        [a],
        **add([encoded("a")], create={"n_parts": 5}),
    )
    r.say("error_no_collection", "a collection that is not there", describe_collection={"collection": "none"})
    r.say("error_no_shape", "a shape that is not there", get_labels={**of, "shape": "none"})
    r.say("error_no_label", "a label that is not there", name_label={**of, "label": 999, "name": "x"})
    r.say("error_no_job", "a job that is not there", get_job={"job_id": 999})
    r.say("error_no_version", "a version that is not there", get_labels={**one, "version": 999})
    r.say(
        "error_name_taken",
        "other bytes under a name that is taken: the shape fails",
        [b],
        **add([encoded("a")]),
    )
    r.say(
        "error_label_count",
        "three labels for many faces",
        [int32(1, 2, 3)],
        correct_labels={**one, "labels": {**ref, "shape": [3]}},
    )
    r.say(
        "error_label_range", "label 70000", [int32(*[70000] * N_FACES)], correct_labels={**one, "labels": ref}
    )
    r.say(
        "error_face_index",
        "face 9999",
        [int32(1, 9999)],
        correct_labels={**one, "faces": {"faces": some, "label": 1}},
    )
    r.say("error_part_index", "part 99", correct_labels={**one, "part": {"part": 99, "label": 1}})
    r.say(
        "error_nothing_corrected",
        "labels that are all -1",
        [int32(*[-1] * N_FACES)],
        correct_labels={**one, "labels": ref},
    )
    r.say("error_nothing_to_undo", "nothing was corrected there", undo={"collection": "boxes"})
    tiny = {
        "vertices": {"dtype": "DATA_TYPE_FLOAT64", "shape": [3, 3], "frame": 0},
        "faces": {"dtype": "DATA_TYPE_INT32", "shape": [1, 3], "frame": 1},
    }
    nan, inf = float("nan"), float("inf")
    for reason, shows, numbers, corners in (
        ("non_finite_vertex", "a NaN", (0, 0, 0, 1, nan, 0, 0, 1, inf), (0, 1, 2)),
        ("vertex_index", "a corner that is not there", (0, 0, 0, 1, 0, 0, 0, 1, 0), (0, 1, 7)),
        ("no_area", "no face has area", (0, 0, 0, 1, 0, 0, 2, 0, 0), (0, 1, 2)),
    ):
        r.say(
            f"error_{reason}",
            shows,
            [floats(*numbers), int32(*corners)],
            **add([{"name": "x", "arrays": tiny}]),
        )
    r.say(
        "error_parse",
        "no OFF file: the shape fails with its line",
        [b"OFF\n3 1 0\n0 0 zero\n"],
        **add([encoded("x")]),
    )
    r.say(
        "error_path_forbidden", "no directory is open for paths", **add([{"name": "x", "path": "/etc/x.off"}])
    )
    everything = [0] * (N_FACES // 2) + [1] * (N_FACES - N_FACES // 2)
    r.say("correct_labels_all", "a whole shape", [int32(*everything)], correct_labels={**one, "labels": ref})
    r.settle("things")
    r.say(
        "correct_labels_other",
        "and the other",
        [int32(*everything)],
        correct_labels={**of, "shape": "b", "labels": ref},
    )
    r.settle("things")
    r.say("error_nothing_to_suggest", "a person labelled every shape", suggest_next=of)
    r.say("remove_shape", "a shape goes", remove_shape={**of, "shape": "b"})
    r.say("delete_collection", "a collection goes", delete_collection={"collection": "boxes"})


def sent(r: Recorder) -> None:
    """Arrays of the meshes as they were sent."""
    of, rows = {"collection": "things"}, {"resolution": "RESOLUTION_INPUT"}
    one, pair = {**of, "shape": "a", **rows}, {**of, "from": "a", "to": "b"}
    r.say(
        "get_spectrum_input",
        "eigenvectors and mass at the vertices of the file",
        get_spectrum={**one, "eigenvectors": True},
    )
    r.say("get_hks_input", "a row for each vertex of the file", get_hks=one)
    faces = {"resolution": "RESOLUTION_INPUT_FACES"}
    r.say("get_hks_input_faces", "a row for each face of the file", get_hks={**one, **faces})
    r.say(
        "get_functional_map_input",
        "p2p_21 between the vertices of the files",
        get_functional_map={**pair, **rows},
    )
    landmarks = {"landmarks": [{"from": 0, "to": 0}], "landmark_resolution": "RESOLUTION_INPUT"}
    r.say(
        "get_functional_map_landmarks",
        "a map between points with a landmark, vertices of the files",
        get_functional_map={**pair, **rows, "points": landmarks},
    )
    past = {**landmarks, "landmarks": [{"from": 9999, "to": 0}]}
    r.say(
        "error_landmark",
        "a landmark that is not there: both numbers are named",
        get_functional_map={**pair, **rows, "points": past},
    )
    n = len(skittle(0).split(b"\n")) - 3 - N_FACES
    ids = {"dtype": "DATA_TYPE_INT32", "frame": 0}
    r.say(
        "transfer_function",
        "labels from faces to faces",
        [int32(*range(N_FACES))],
        transfer_function={**pair, "values": {**ids, "shape": [N_FACES]}},
    )
    r.say(
        "transfer_function_input",
        "labels from the vertices of one file to those of the other",
        [int32(*range(n))],
        transfer_function={**pair, **rows, "values": {**ids, "shape": [n]}},
    )
    r.say(
        "error_values_length",
        "a value too few: both lengths are named",
        [int32(*range(n - 1))],
        transfer_function={**pair, **rows, "values": {**ids, "shape": [n - 1]}},
    )


def asking(r: Recorder) -> None:
    """A person answers questions and gives verdicts."""
    of = {"collection": "asked"}
    a, b = skittle(0), skittle(3)
    two = {"n_parts": 2, "working_faces": WORKING_FACES}
    r.say(
        "add_shapes_asked", "two files", [a, b], **add([encoded("a"), encoded("b", 1)], "asked", create=two)
    )
    r.say("error_no_proposals", "two shapes are too few to propose anything", list_proposals=of)
    r.say("error_not_publishable", "two shapes without a person's labels are too few", publish=of)
    r.say("next_question", "the part whose label is worth most", next_question=of)
    part = {**of, "shape": "a", "part": 0, "by": "ada"}
    r.say("answer_question", "a name, which makes a label", answer_question={**part, "named": "head"})
    r.settle("asked")
    other = {**part, "shape": "b"}
    r.say("answer_question_passed", "a part is passed over", answer_question={**other, "skip": True})
    r.say("error_question_part", "a part that is not there", answer_question={**part, "part": 999, "label": 1})
    of_b = {**of, "shape": "b", "by": "ada"}
    r.say("review_shape", "a doubt is noted", review_shape={**of_b, "state": "REVIEW_STATE_DOUBTFUL"})
    r.say("list_shapes_doubtful", "shapes with that verdict", list_shapes={**of, "review": "REVIEW_STATE_DOUBTFUL"})
    for shape in ("a", "b"):
        r.say(
            f"review_shape_{shape}",
            "all labels are right: they are pinned",
            review_shape={**of_b, "shape": shape, "state": "REVIEW_STATE_APPROVED"},
        )
        r.settle("asked")
    r.say(
        "error_labelled_by_person",
        "labels follow from what a person labelled",
        choose_proposal={**of, "n": 1},
    )
    idle = {"collection": "asked", "wait_ms": 20_000}
    r.say("wait_idle_before_publish", "labels have followed the approvals", wait_idle=idle)
    r.say("publish", "the beginning of a bundle, and the array files behind it", publish=of)
    r.say(
        "error_gone",
        "an array file that the shape does not have",
        get_array_file={**of, "shape": "a", "blake3": "0" * 64},
    )
    r.say("error_nothing_to_ask", "a person labelled every part", next_question={**of, "passed": True})


def linking(r: Recorder) -> None:
    """A person links parts of shapes that nobody has labelled."""
    of = {"collection": "linked"}
    a, b = skittle(0), skittle(3)
    two = {"n_parts": 2, "working_faces": WORKING_FACES}
    r.say(
        "add_shapes_linked", "two files", [a, b], **add([encoded("a"), encoded("b", 1)], "linked", create=two)
    )
    parts = {**of, "a": {"shape": "a", "part": 0}, "b": {"shape": "b", "part": 0}, "by": "ada"}
    r.say("link_parts", "two parts must differ", link_parts={**parts, "kind": "LINK_KIND_DIFFER"})
    r.settle("linked")
    r.say("list_links", "the link, and whether it holds", list_links={**of, "shape": "b"})
    r.say("events_since_linked", "what the link changed", events_since=of)
    r.say("undo_link", "the link is taken back", undo=of)
    r.say("link_parts_same", "the parts must be equal", link_parts={**parts, "kind": "LINK_KIND_SAME"})
    r.settle("linked")
    r.say(
        "error_link_contradicts",
        "they must be equal already",
        link_parts={**parts, "kind": "LINK_KIND_DIFFER"},
    )
    r.say("unlink_parts", "the link is removed", unlink_parts={**of, "id": 2})
    r.say("error_no_link", "a link that is not there", unlink_parts={**of, "id": 9})


def small(r: Recorder) -> None:
    """A daemon with little room."""
    a = skittle(0)
    create = {"create": {}}
    r.say("error_mesh_too_large", "a file beyond the limit", [a], **add([encoded("a")], **create))
    r.say(
        "error_larger_than_the_queue",
        "two shapes where one may ever wait: send fewer",
        [b"OFF\n", b"OFF\n"],
        **add([encoded("a"), encoded("b", 1)], **create),
    )
    r.say(
        "too_many_shapes",
        "three shapes where two may come",
        [b"OFF\n"] * 3,
        **add([encoded(n, i) for i, n in enumerate("abc")], **create),
    )


def tcp(r: Recorder) -> None:
    """A daemon on a loopback port."""
    r.say("error_admin_ipc_only", "only a local client may stop the daemon", drain={})


def composed(r: Recorder) -> None:
    """What no request brings about on a healthy machine, or only by luck of timing."""
    texts: dict[str, tuple[str, str, dict[str, Any]]] = {
        "DEADLINE": ("DEADLINE_EXCEEDED", "no answer within the request's 1 ms", {}),
        "GONE": ("NOT_FOUND", 'no collection named "things"', {}),
        "LABEL_LIMIT": ("INVALID_ARGUMENT", "the collection would have more labels than it may", {}),
        "LINK_LIMIT": ("FAILED_PRECONDITION", "the collection has 100 links, the limit", {}),
        "LABEL_TOO_SMALL": ("FAILED_PRECONDITION", "label 3 is too small to be two", {}),
        "MESH": ("INVALID_ARGUMENT", "face 17 cannot be part of a surface", {"face": 17}),
        "LAPLACIAN": ("INVALID_ARGUMENT", "the Laplacian of the mesh cannot be built", {}),
        "SPECTRUM": ("INTERNAL", "the spectrum cannot be proved complete", {}),
        "PANIC": ("INTERNAL", "answering panicked", {}),
        "SHAPE_TIMEOUT": ("DEADLINE_EXCEEDED", "describing took longer than 600 s", {}),
        "CANCELLED": ("CANCELLED", "the job was cancelled", {}),
        "QUEUE_FULL": ("RESOURCE_EXHAUSTED", "64 shapes are queued and 1 more asked for", {"retry_after_ms": 1000}),
        "MEMORY_LIMIT": ("RESOURCE_EXHAUSTED", "requests in hand leave no memory", {"retry_after_ms": 250}),
        "DRAINING": ("FAILED_PRECONDITION", "the daemon is shutting down", {"job_id": 7}),
        "PATH_UNREADABLE": ("INVALID_ARGUMENT", "/meshes/a.off is not a regular file", {}),
        "READ_ONLY": ("FAILED_PRECONDITION", "the library refuses writes", {}),
        "STORE": ("INTERNAL", "a file cannot be read", {}),
        "DAMAGED": ("DATA_LOSS", "a file differs from what was written", {}),
        "NO_SPACE": ("RESOURCE_EXHAUSTED", "the disk is full", {"retry_after_ms": 10000}),
        "UNSPECIFIED": ("INTERNAL", "no more precise reason", {"byte_offset": 12}),
    }
    shown = r.reasons()
    for name in error_pb2.ErrorReason.keys():
        reason = name.removeprefix("ERROR_REASON_")
        if reason not in shown:
            # Reasons that are added to the protocol are composed too, until they are recorded.
            code, message, more = texts.get(reason, ("FAILED_PRECONDITION", "not recorded yet", {}))
            r.compose(reason, code, message, **more)
    shown_bodies = {body for entry in r.index for body in entry["reply"]}
    for field in message_pb2.Reply.DESCRIPTOR.oneofs_by_name["result"].fields:
        body = field.name
        if body not in shown_bodies:
            # Stopping the daemon ends a recording, and a request that was added is not recorded yet.
            request = message_pb2.Request(request_id=body, client_id=CLIENT)
            reply = message_pb2.Reply(request_id=body)
            getattr(request, body).SetInParent()
            getattr(reply, body).SetInParent()
            shows = f"{body}, an empty reply, composed"
            r.keep(body, shows, [request.SerializeToString()], [reply.SerializeToString()], "composed")
    samples = []
    for field in event_pb2.Event.DESCRIPTOR.oneofs_by_name["kind"].fields:
        event = event_pb2.Event(sequence=5, collection="things")
        getattr(event, field.name).SetInParent()
        samples.append({"kind": field.name, "hex": event.SerializeToString().hex()})
    (HERE / "events.json").write_text(json.dumps(samples, indent=1) + "\n")


def main() -> None:
    """Records all of it."""
    recorder = Recorder()
    all_of_them = (plain, small, tcp, asking, linking)
    for name, conversations in zip(DAEMONS, all_of_them, strict=True):
        recorder.daemon, recorder.daemon_name = Daemon(sys.argv[1], name), name
        try:
            conversations(recorder)
        finally:
            recorder.daemon.close()
    composed(recorder)
    recorder.write()
    n_recorded = sum(e["origin"] == "recorded" for e in recorder.index)
    print(f"{n_recorded} recorded, {len(recorder.index) - n_recorded} composed")


if __name__ == "__main__":
    main()
