"""Recorded conversations: this client says the same bytes, and understands the same."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from conftest import ROOT
from google.protobuf.json_format import MessageToDict, ParseDict

import coseg
from coseg.v1 import daemon_pb2, error_pb2, event_pb2, message_pb2

GOLDEN = ROOT / "tests" / "golden"
INDEX: list[dict[str, Any]] = json.loads((GOLDEN / "index.json").read_text())


def message(path: Path) -> list[bytes]:
    data, frames = path.read_bytes(), []
    while data:
        end = 4 + int.from_bytes(data[:4], "little")
        frames.append(data[4:end])
        data = data[end:]
    return frames


def recorded(entry: dict[str, Any], what: str) -> list[bytes]:
    return message(GOLDEN / f"{entry['name']}.{what}.bin")


class Replay:
    """Answers one request with the recorded reply, under the id that the client chose."""

    def __init__(self) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.router = self.context.socket(zmq.ROUTER)
        self.port = self.router.bind_to_random_port("tcp://127.0.0.1")
        self.reply: list[bytes] = []
        self.heard: list[bytes] = []
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self) -> None:
        while not self.over.is_set():
            if not self.router.poll(50):
                continue
            peer, *frames = self.router.recv_multipart()
            request = message_pb2.Request.FromString(frames[0])
            if request.request_id in ("introduction", "") or request.request_id.startswith("?"):
                reply = message_pb2.Reply(request_id=request.request_id)
                reply.hello.CopyFrom(daemon_pb2.HelloReply(instance="golden"))
                reply.hello.limits.max_message_bytes = 1 << 30
                self.router.send_multipart([peer, reply.SerializeToString()])
                continue
            self.heard = frames
            self.router.send_multipart([peer, *self.reply])

    def close(self) -> None:
        self.over.set()
        self.thread.join()
        self.context.destroy(linger=0)


@pytest.fixture(scope="module")
def replay() -> Iterator[Replay]:
    server = Replay()
    yield server
    server.close()


def test_there_are_enough_and_every_reason_is_shown() -> None:
    assert len(INDEX) >= 40
    text = json.dumps(INDEX)
    # A reason that is missing here was added to the protocol: run tests/golden/record.py.
    missing = [name for name in error_pb2.ErrorReason.keys()[1:] if f'"{name}"' not in text]
    assert missing == []
    bodies = {name for entry in INDEX for name in entry["reply"] if name != "request_id"}
    fields = message_pb2.Reply.DESCRIPTOR.oneofs_by_name["result"].fields
    assert sorted({f.name for f in fields} - bodies) == []


@pytest.mark.parametrize("entry", INDEX, ids=[e["name"] for e in INDEX])
def test_bytes_mean_what_the_index_says(entry: dict[str, Any]) -> None:
    request, reply = recorded(entry, "request"), recorded(entry, "reply")
    if "request" in entry:
        encoded = ParseDict(entry["request"], message_pb2.Request()).SerializeToString()
        assert encoded == request[0]
    decoded = message_pb2.Reply.FromString(reply[0])
    assert MessageToDict(decoded, preserving_proto_field_name=True) == entry["reply"]
    frames = [{"bytes": len(f), "sha256": hashlib.sha256(f).hexdigest()} for f in reply[1:]]
    assert frames == entry["reply_frames"]


@pytest.mark.parametrize("entry", [e for e in INDEX if "request" in e], ids=lambda e: e["name"])
def test_the_client_replays(entry: dict[str, Any], replay: Replay) -> None:
    """The whole way: what the client sends is what was recorded, and what comes back is understood."""
    request, reply = recorded(entry, "request"), recorded(entry, "reply")
    asked = message_pb2.Request.FromString(request[0])
    body = asked.WhichOneof("body")
    assert body is not None
    replay.reply = reply
    with coseg.Library(f"tcp://127.0.0.1:{replay.port}", client_id=asked.client_id) as lib:
        lib.call("hello", request_id="introduction")
        # Waits that a refusal asks for are not the point here.
        error = entry["reply"].get("error", {})
        if "retry_after_ms" in error or error.get("reason", "").endswith("DRAINING"):
            pytest.skip("the client asks again, which is tested with the real daemon")
        fields = {f.name: v for f, v in getattr(asked, body).ListFields()}
        options: dict[str, Any] = {"request_id": asked.request_id, "deadline_ms": asked.deadline_ms}
        lib._hello = coseg.Hello("", "", "", "", (), (), coseg.Limits(*[1 << 30] * 9))
        if error:
            with pytest.raises(coseg.Refused) as e:
                lib.call(body, request[1:], **options, **fields)
            assert f"ERROR_CODE_{e.value.code}" == error["code"]
            assert f"ERROR_REASON_{e.value.reason}" == error.get("reason", "ERROR_REASON_UNSPECIFIED")
            assert e.value.message == error["message"]
            for place in ("field", "face", "vertex", "byte_offset", "line", "job_id"):
                found = getattr(e.value, place)
                assert (None if found is None else str(found)) == (
                    str(error[place]) if place in error else None
                )
            code = error["code"].removeprefix("ERROR_CODE_")
            assert type(e.value).__name__.upper() == code.replace("_", "")
        else:
            answer, raw = lib.call(body, request[1:], **options, **fields)
            for field, value in answer.ListFields():
                if field.message_type is not None and field.message_type.name == "ArrayRef":
                    array = raw.array(value)
                    assert array.shape == tuple(value.shape) and array.flags.writeable
                    if array.dtype.kind == "f":
                        assert np.isfinite(array).all()
    assert replay.heard == request


def test_every_kind_of_event_is_understood() -> None:
    from coseg import _wire

    samples = json.loads((GOLDEN / "events.json").read_text())
    kinds = [_wire.event(event_pb2.Event.FromString(bytes.fromhex(s["hex"]))).kind for s in samples]
    assert kinds == [s["kind"] for s in samples]
    fields = event_pb2.Event.DESCRIPTOR.oneofs_by_name["kind"].fields
    assert sorted(kinds) == sorted(f.name for f in fields)
