"""Events: each once, in order, whatever happens to the socket or the daemon."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from conftest import Daemon

import coseg
from coseg.v1 import event_pb2


def test_events_follow_and_the_log_is_complete(
    daemon: Daemon, lib: coseg.Library, meshes: list[Path]
) -> None:
    collection = lib.collection("events", parts=4)
    collection.add(meshes[0].stem, meshes[0])
    newest = collection.info().sequence
    events = collection.events()
    snapshot = collection.snapshot()
    assert snapshot.sequence == newest
    assert (snapshot.shapes[meshes[0].stem].labels == collection.labels(meshes[0].stem)).all()
    # The first step subscribes and asks for the log; the change comes after.
    timer = threading.Timer(0.5, lambda: collection.add(meshes[1].stem, meshes[1]))
    timer.start()
    first = next(events)
    timer.join()
    assert first.sequence == newest + 1
    log = collection.events_since(0)
    assert [e.sequence for e in log] == list(range(1, len(log) + 1))
    assert log[0].kind == "collection_created"
    added = [e for e in log if e.kind == "shape_added"]
    assert [e.shape for e in added] == [m.stem for m in meshes[:2]]
    assert isinstance(added[0].data["area_shares"], list)
    assert collection.events_since(0, limit=2) == log[:2]
    from_begin = collection.events(since=0)
    assert [next(from_begin) for _ in log] == log


def test_events_survive_kills_and_miss_nothing(daemon: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(daemon.endpoint) as lib, coseg.Library(daemon.endpoint) as writer:
        lib.create("kept", parts=4)
        seen: list[coseg.Event] = []
        done = threading.Event()

        def follow() -> None:
            for event in lib.collection("kept").events(since=0):
                seen.append(event)
                if event.shape == meshes[5].stem and event.kind == "shape_added":
                    done.set()
                    return

        follower = threading.Thread(target=follow, daemon=True)
        follower.start()
        collection = writer.collection("kept")
        for i, mesh in enumerate(meshes[:6]):
            if i in (2, 4):
                daemon.restart()
            collection.add(mesh.stem, mesh)
        assert done.wait(60)
        follower.join(10)
        assert [e.sequence for e in seen] == list(range(1, len(seen) + 1))
        assert seen == collection.events_since(0)[: len(seen)]


def test_what_the_socket_drops_comes_from_the_log(
    daemon: Daemon, lib: coseg.Library, meshes: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two of three messages are thrown away before the iterator sees them."""
    from coseg import _sync_transport

    receive = _sync_transport.Subscription.receive
    n = 0

    def lossy(self: _sync_transport.Subscription, timeout: float) -> bytes | None:
        nonlocal n
        while True:
            body = receive(self, timeout)
            if body is None or event_pb2.Event.FromString(body).HasField("heartbeat"):
                return body
            n += 1
            if n % 3 == 0:
                return body

    monkeypatch.setattr(_sync_transport.Subscription, "receive", lossy)
    collection = lib.create("lossy", parts=4)
    events = collection.events(since=0)
    for mesh in meshes[:3]:
        collection.add(mesh.stem, mesh)
    collection.wait_idle()
    log = collection.events_since(0)
    assert [next(events).sequence for _ in log] == list(range(1, len(log) + 1))
    timer = threading.Timer(0.3, lambda: collection.name_label(0, "seat"))
    timer.start()
    assert next(events).kind == "label_named"  # seen by its heartbeat at the latest
    timer.join()


def test_a_deleted_collection_goes_on_under_its_name(lib: coseg.Library) -> None:
    collection = lib.create("again")
    events = collection.events(since=0)
    assert next(events).kind == "collection_created"
    collection.delete()
    assert next(events).kind == "collection_deleted"
    lib.create("again")
    event = next(events)
    assert (event.kind, event.sequence) == ("collection_created", 3)


def test_another_library_is_noticed(daemon: Daemon, lib: coseg.Library) -> None:
    collection = lib.create("short")
    with pytest.raises(coseg.EventLogRewound, match="ends with event 1, but event 7 was seen"):
        next(collection.events(since=7))


def test_patience_ends(daemon: Daemon) -> None:
    with coseg.Library(daemon.endpoint, timeout=1) as lib:
        collection = lib.create("patience")
        events = collection.events(since=0, patience=2)
        next(events)
        daemon.kill()
        with pytest.raises(coseg.NoAnswer):
            next(events)
