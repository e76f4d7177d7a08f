"""The connection without its socket."""

import pytest

from coseg._link import PING_S, RESEND_S, Link
from coseg._options import reachable
from coseg.errors import BadReply, NoAnswer
from coseg.v1 import daemon_pb2, message_pb2


def hello(instance: str, request_id: str = "?1") -> bytes:
    body = daemon_pb2.HelloReply(instance=instance)
    return message_pb2.Reply(request_id=request_id, hello=body).SerializeToString()


def ids(sent: object) -> list[str]:
    assert isinstance(sent, list)
    return [request_id for request_id, _ in sent]


def test_silence_is_asked_about_and_ends_in_no_answer() -> None:
    link = Link("e", 3.0)
    link.begin("a", [b"x"], 100.0)
    assert link.tick(100.5) == []
    assert ids(link.tick(101.0)) == ["?1"]
    assert ids(link.tick(102.1)) == ["?2"]
    with pytest.raises(NoAnswer):
        link.tick(103.2)


def test_work_may_take_long_while_the_daemon_lives() -> None:
    link = Link("e", 3.0)
    link.begin("a", [b"x"], 0.0)
    now = 0.0
    resent = []
    while now < 100.0:
        now = link.next_tick()
        resent += [now for i in ids(link.tick(now)) if i == "a"]
        assert link.receive(hello("one"), now + 0.01) is None
    # Seldom, and ever more so.
    assert [round(t / RESEND_S) for t in resent] == [1, 3]


def test_another_daemon_gets_what_the_first_may_have_lost() -> None:
    link = Link("e", 30.0)
    link.begin("h", [b""], 0.0)
    assert link.receive(hello("one", "h"), 0.0) is not None
    link.end("h")
    link.begin("a", [b"x"], 1.0)
    assert ids(link.tick(2.0)) == ["?1"]
    link.receive(hello("one"), 2.0)
    assert ids(link.tick(3.0)) == ["?2"]
    link.receive(hello("two"), 3.1)
    assert link.next_tick() <= 3.1
    assert ids(link.tick(3.1)) == ["?3", "a"]
    link.receive(hello("two"), 3.2)
    assert ids(link.tick(3.2 + PING_S)) == ["?4"]


def test_what_could_not_be_sent_is_sent_at_the_next_tick() -> None:
    link = Link("e", 30.0)
    link.begin("a", [b"x"], 0.0)
    link.unsent("a")
    assert ids(link.tick(PING_S)) == ["?1", "a"]


def test_replies_nobody_waits_for_are_dropped_and_nonsense_is_told() -> None:
    link = Link("e", 3.0)
    assert link.receive(hello("one", "old"), 0.0) is None
    with pytest.raises(BadReply):
        link.receive(b"\xff\xff", 0.0)


def test_events_come_from_the_host_that_is_known() -> None:
    assert reachable("tcp://0.0.0.0:7001", "tcp://shapes:7000") == "tcp://shapes:7001"
    assert reachable("tcp://[::]:7001", "tcp://[fe80::1]:7000") == "tcp://[fe80::1]:7001"
    assert reachable("tcp://10.0.0.1:7001", "tcp://shapes:7000") == "tcp://10.0.0.1:7001"
    assert reachable("ipc:///run/x.events", "ipc:///run/x") == "ipc:///run/x.events"
