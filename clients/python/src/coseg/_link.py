"""One connection without its socket: what to send when, until every request has its answer.

A ZeroMQ socket hides that a daemon was gone for a while, and with it what was under way. So while
answers are awaited, a Hello is sent once a second. Its reply shows that the daemon lives, and whether
it is still the one that got the requests: if not, they are sent again, which the idempotency key makes
harmless. The timeout is for silence, not for work: a request may take long while Hellos are answered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from google.protobuf.message import DecodeError

from coseg.errors import BadReply, NoAnswer
from coseg.v1 import daemon_pb2, message_pb2

#: A raw frame to send.
Frame = bytes | memoryview
#: Seconds of silence after which the daemon is asked whether it lives.
PING_S = 1.0
#: Seconds after which a request is sent again although the daemon lives: it drops replies to clients
#: that do not read. Doubled each time.
RESEND_S = 20.0
#: Marks the ids of Hellos that only ask for life.
PING = "?"


@dataclass
class _Pending:
    frames: Sequence[Frame]
    resend_at: float
    resend_s: float = RESEND_S


class Link:
    """The state of one connection. All times are seconds of one monotonic clock."""

    def __init__(self, endpoint: str, timeout: float) -> None:
        self.endpoint = endpoint
        self.timeout = timeout
        self._pending: dict[str, _Pending] = {}
        self._instance = ""
        self._heard = 0.0
        self._pinged = 0.0
        self._n_pings = 0

    def begin(self, request_id: str, frames: Sequence[Frame], now: float) -> None:
        """Notes a request; the caller sends it."""
        if not self._pending:
            self._heard = self._pinged = now
        self._pending[request_id] = _Pending(frames, now + RESEND_S)

    def unsent(self, request_id: str) -> None:
        """Notes that a request could not be sent: it is due at the next tick."""
        if (pending := self._pending.get(request_id)) is not None:
            pending.resend_at = 0.0

    def end(self, request_id: str) -> None:
        """Forgets a request, answered or not."""
        self._pending.pop(request_id, None)

    def next_tick(self) -> float:
        """When :meth:`tick` is to be called, unless something arrives before."""
        return max(self._pinged, self._heard) + PING_S

    def tick(self, now: float) -> list[tuple[str, Sequence[Frame]]]:
        """What is to be sent now, with its id. Raises :class:`NoAnswer` after too long a silence."""
        if not self._pending or now < self.next_tick():
            return []
        if now - self._heard > self.timeout:
            raise NoAnswer(self.endpoint, self.timeout)
        due: list[tuple[str, Sequence[Frame]]] = []
        for request_id, pending in self._pending.items():
            if now >= pending.resend_at:
                if pending.resend_at:
                    pending.resend_s *= 2
                pending.resend_at = now + pending.resend_s
                due.append((request_id, pending.frames))
        self._pinged = now
        self._n_pings += 1
        ping = message_pb2.Request(request_id=f"{PING}{self._n_pings}", hello=daemon_pb2.HelloRequest())
        return [(ping.request_id, [ping.SerializeToString()]), *due]

    def receive(self, header: bytes, now: float) -> message_pb2.Reply | None:
        """The reply to a request, or ``None`` for one that nobody waits for."""
        self._heard = now
        try:
            reply = message_pb2.Reply.FromString(header)
        except DecodeError as e:
            raise BadReply(f"the header frame is not a coseg.v1.Reply: {e}") from e
        if reply.HasField("hello"):
            instance = reply.hello.instance
            if self._instance and instance != self._instance:
                # What was sent before may be lost with the daemon that got it.
                for pending in self._pending.values():
                    pending.resend_at = 0.0
                self._pinged = self._heard = now - PING_S
            self._instance = instance
        return reply if reply.request_id in self._pending else None
