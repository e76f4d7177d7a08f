"""Every field of every reply has a place in what the client returns: changing it there changes that."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message

import coseg
from coseg._wire import Raw
from coseg.v1 import message_pb2

#: Entries of a repeated field: as many as there are states of an item that tell different things.
N = 3
#: What must have a certain value for the rest to be told: by message, field and entry.
GIVEN = {
    ("JobItem", "state"): (3, 4, 2),
    ("Placed", "outcome"): (1, 2, 3),
}
#: Fields without a place, and why.
ELSEWHERE = {
    "create_collection.collection": "`create` returns the collection, whose `info` asks for it",
    "add_shapes.n_shapes": "the caller knows how many it gave",
    "add_shapes.job": "only told where the request waits, as the client's never does; it watches the job",
    "list_jobs.more": "the client reads page after page",
    "list_shapes.next_page_token": "the client reads page after page",
    "events_since.more": "the client reads page after page",
}

#: The first that a reply's field may say: the others are refused.
PROXY: Any = {"resolution": "proxy"}

Call = Callable[[coseg.Library, coseg.Collection], object]
CALLS: dict[str, Call] = {
    "hello": lambda lib, _: lib.hello(),
    "stats": lambda lib, _: lib.stats(),
    "drain": lambda lib, _: lib.drain(),
    "create_collection": lambda lib, _: lib.create("a").name,
    "list_collections": lambda lib, _: lib.collections(),
    "describe_collection": lambda _, c: c.info(),
    "update_collection": lambda _, c: c.set(up="+z"),
    "delete_collection": lambda _, c: c.delete(),
    "name_label": lambda _, c: c.name_label(1, "leg"),
    "add_shapes": lambda _, c: c.submit([("a", coseg.Encoded("off", b"OFF"))]),
    "get_job": lambda lib, _: lib.job(1),
    "watch_job": lambda lib, _: next(iter(lib.watch(1))),
    "cancel_job": lambda lib, _: lib.cancel(1),
    "wait_idle": lambda _, c: c.wait_idle(0),
    "list_jobs": lambda lib, _: first(lib.jobs()),
    "retry_job": lambda lib, _: lib.retry(1),
    "list_shapes": lambda _, c: first(c.shapes()),
    "get_shape": lambda _, c: c.shape("a"),
    "get_labels": lambda _, c: c.labelling("a", confidence=True),
    "get_original": lambda _, c: c.original("a"),
    "remove_shape": lambda _, c: c.remove("a"),
    "labels_snapshot": lambda _, c: c.snapshot(),
    "get_spectrum": lambda _, c: or_refusal(lambda: c.spectrum("a", eigenvectors=True, **PROXY)),
    "get_hks": lambda _, c: or_refusal(lambda: c.hks("a", **PROXY)),
    "get_descriptors": lambda _, c: c.descriptors("a"),
    "get_functional_map": lambda _, c: or_refusal(
        lambda: c.map("a", "b", alternative=True, agreement=True, **PROXY)
    ),
    "get_part_correspondence": lambda _, c: c.match_parts("a", "b"),
    "nearest": lambda _, c: c.nearest("a"),
    "get_portraits": lambda _, c: c.portraits(["a"]),
    "transfer_function": lambda _, c: or_refusal(lambda: c.transferred(np.zeros((2, 2)), "a", "b", **PROXY)),
    "events_since": lambda _, c: c.events_since(0, limit=N),
    "correct_labels": lambda _, c: c.correct("a", part=0, label=1),
    "merge_labels": lambda _, c: c.merge(1, into=2),
    "split_label": lambda _, c: c.split(1),
    "undo": lambda _, c: c.undo(),
    "suggest_next": lambda _, c: c.suggest(),
    "next_question": lambda _, c: c.ask(),
    "answer_question": lambda _, c: c.answer("a", 0, 1),
    "review_shape": lambda _, c: c.approve("a"),
    "list_proposals": lambda _, c: c.proposals(),
    "get_proposal": lambda _, c: c.proposed_labels(1),
    "choose_proposal": lambda _, c: c.choose(1),
    "link_parts": lambda _, c: c.same(("a", 0), ("b", 1)),
    "unlink_parts": lambda _, c: c.unlink(1),
    "list_links": lambda _, c: c.links("a"),
    "publish": lambda _, c: c.bundle_head(),
    "get_array_file": lambda _, c: c.array_file("a", "0" * 64),
}


def or_refusal(call: Callable[[], object]) -> object:
    """What a call returns, or says of a reply with other rows than were asked for."""
    try:
        return call()
    except coseg.BadReply as refusal:
        return refusal


def first(entries: Iterator[object]) -> list[object]:
    """The entries of the first page."""
    return [entry for entry, _ in zip(entries, range(N), strict=False)]


Path = tuple[tuple[Any, int], ...]


class Replies:
    """Replies with something in every field."""

    def __init__(self) -> None:
        self.frames: list[memoryview] = []

    def frame(self, seed: int) -> int:
        # Four numbers of any type; as truth values different ones too.
        values = np.arange(4, dtype="<i4") + 16 * seed
        self.frames.append(memoryview(values.tobytes()))
        return len(self.frames) - 1

    def scalar(self, field: Any, entry: int, seed: int) -> Any:
        within = field.containing_type
        given = GIVEN.get((within.name if within else "", field.name))
        if field.enum_type is not None:
            # Not 0, which says nothing.
            values = field.enum_type.values
            at = given[entry] if given and seed == 0 else 1 + (entry + seed) % (len(values) - 1)
            return values[at].number
        if field.type == FieldDescriptor.TYPE_BOOL:
            return seed == 0
        if field.type == FieldDescriptor.TYPE_STRING:
            return f"{field.name} {entry} {seed}"
        number = 3 + 7 * entry + 100 * seed + field.number
        return number + 0.5 if field.type == FieldDescriptor.TYPE_DOUBLE else number

    def fill(self, message: Message, entry: int = 0) -> None:
        """Puts something into every field, and into the first of those of which only one can be."""
        for field in message.DESCRIPTOR.fields:
            oneof = field.containing_oneof
            if oneof is None or oneof.fields[0] is field or len(oneof.fields) == 1:
                self.put(message, field, entry)

    def put(self, message: Message, field: Any, entry: int, seed: int = 0) -> None:
        """Puts something into a field."""
        if field.message_type is None:
            if not field.is_repeated:
                setattr(message, field.name, self.scalar(field, entry, seed))
            else:
                getattr(message, field.name)[:] = [self.scalar(field, i, seed) for i in range(N)]
        elif not field.is_repeated:
            self.fill_any(getattr(message, field.name), entry, seed)
        else:
            for i in range(N):
                self.fill_any(getattr(message, field.name).add(), i, seed)

    def fill_any(self, message: Any, entry: int, seed: int) -> None:
        message.SetInParent()
        if message.DESCRIPTOR.name == "ArrayRef":
            message.dtype, message.frame = 1, self.frame(seed + entry)
            message.shape[:] = [2, 2]
        elif message.DESCRIPTOR.name == "BytesRef":
            message.frame = self.frame(seed + entry)
        else:
            self.fill(message, entry)

    def with_other(self, reply: Message, path: Path) -> tuple[Message, Message]:
        """The reply with the field at a path there, and the same with another value in it."""
        pair = []
        for seed in (0, 1):
            changed = type(reply)()
            changed.CopyFrom(reply)
            message: Any = changed
            for field, entry in path[:-1]:
                if field.containing_oneof is not None and not message.HasField(field.name):
                    self.put(message, field, entry)
                message = getattr(message, field.name)
                if field.is_repeated:
                    message = message[entry]
            field, entry = path[-1]
            message.ClearField(field.name)
            self.put(message, field, entry, seed)
            pair.append(changed)
        return pair[0], pair[1]


def leaves(of: Descriptor, path: Path = (), entry: int = 0) -> Iterator[Path]:
    """The ways to all fields that are no messages themselves, or references to raw frames."""
    for field in of.fields:
        kind = field.message_type
        if kind is None or kind.name in ("ArrayRef", "BytesRef"):
            yield (*path, (field, entry))
        elif field.is_repeated:
            for i in range(N):
                yield from leaves(kind, (*path, (field, i)), i)
        else:
            yield from leaves(kind, (*path, (field, entry)), entry)


def told(value: object) -> object:
    """All that a value of the client says, as something to compare."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if is_dataclass(value):
        return {f.name: told(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, BaseException):
        return [type(value).__name__, str(value), {k: told(v) for k, v in vars(value).items()}]
    if isinstance(value, Mapping):
        return {k: told(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [told(v) for v in value]
    return value


class Stub(coseg.Library):
    """Answers every call with one reply."""

    def __init__(self) -> None:
        super().__init__("ipc:///nobody")
        self.reply: Any = None
        self.body = ""
        self.raw: list[memoryview] = []

    def call(self, body: str, *_: object, **__: object) -> tuple[Any, Raw]:
        if body == self.body:
            return self.reply, Raw(self.raw)
        reply = message_pb2.Reply()
        Replies().put(reply, reply.DESCRIPTOR.fields_by_name[body], 0)
        return getattr(reply, body), Raw([])


def test_every_reply_has_a_call() -> None:
    results = message_pb2.Reply.DESCRIPTOR.oneofs_by_name["result"].fields
    assert sorted(CALLS) == sorted(f.name for f in results if f.name != "error")


@pytest.mark.parametrize("body", CALLS)
def test_every_field_is_told(body: str) -> None:
    replies = Replies()
    full = message_pb2.Reply()
    replies.put(full, full.DESCRIPTOR.fields_by_name[body], 0)
    reply = getattr(full, body)
    places: dict[str, bool] = {}
    lib = Stub()
    lib.body, lib.raw = body, replies.frames
    for path in leaves(reply.DESCRIPTOR):
        name = ".".join([body, *(f.name for f, _ in path)])
        if places.get(name):
            continue
        answers = []
        for lib.reply in replies.with_other(reply, path):
            answers.append(told(CALLS[body](lib, lib.collection("a"))))
        places[name] = answers[0] != answers[1]
    lib.close()
    known = {name for name in ELSEWHERE if name.split(".")[0] == body}
    lost = {name for name, is_told in places.items() if not is_told}
    assert lost == {n for n in places if any(n == k or n.startswith(f"{k}.") for k in known)}
