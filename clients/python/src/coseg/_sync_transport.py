"""Blocking sockets around :class:`coseg._link.Link`: one for each thread that asks."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import zmq

from coseg._link import Frame, Link
from coseg._options import Curve, configure
from coseg.v1 import message_pb2

Answer = tuple[message_pb2.Reply, list[memoryview]]


class Transport:
    """Sends requests and waits for their replies. Threads do not wait for each other."""

    def __init__(self, endpoint: str, timeout: float, curve: Curve | None) -> None:
        self.endpoint, self.timeout, self.curve = endpoint, timeout, curve
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._local = threading.local()

    def close(self) -> None:
        """Closes all sockets; no thread may be waiting."""
        self._context.destroy(linger=0)

    def sleep(self, seconds: float) -> None:
        """Waits."""
        time.sleep(seconds)

    def exchange(self, request_id: str, frames: Sequence[Frame]) -> Answer:
        """Sends a request, again if need be, and returns the reply and its raw frames."""
        socket, link = self._connection()
        link.begin(request_id, frames, time.monotonic())
        try:
            self._send(socket, link, request_id, frames)
            while True:
                left = max(0.0, link.next_tick() - time.monotonic())
                if socket.poll(int(left * 1000) + 1):
                    header, *raw = socket.recv_multipart(copy=False)
                    reply = link.receive(header.bytes, time.monotonic())
                    if reply is not None and reply.request_id == request_id:
                        return reply, [frame.buffer for frame in raw]
                for again, due in link.tick(time.monotonic()):
                    self._send(socket, link, again, due)
        finally:
            link.end(request_id)

    def _connection(self) -> tuple[zmq.Socket[Any], Link]:
        if not hasattr(self._local, "connection"):
            socket = self._context.socket(zmq.DEALER)
            configure(socket, self.curve)
            socket.connect(self.endpoint)
            self._local.connection = socket, Link(self.endpoint, self.timeout)
        connection: tuple[zmq.Socket[Any], Link] = self._local.connection
        return connection

    def _send(self, socket: zmq.Socket[Any], link: Link, request_id: str, frames: Sequence[Frame]) -> None:
        try:
            socket.send_multipart(frames, zmq.DONTWAIT, copy=False)
        except zmq.Again:
            link.unsent(request_id)

    def subscribe(self, endpoint: str, topics: Sequence[bytes]) -> Subscription:
        """A socket that receives what is published under the topics."""
        return Subscription(self._context, endpoint, topics, self.curve)


class Subscription:
    """A socket that receives events."""

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        topics: Sequence[bytes],
        curve: Curve | None,
    ) -> None:
        self._socket = context.socket(zmq.SUB)
        configure(self._socket, curve)
        for topic in topics:
            self._socket.subscribe(topic)
        self._socket.connect(endpoint)

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close(linger=0)

    def receive(self, timeout: float) -> bytes | None:
        """The body of the next message, or ``None`` after that many seconds of silence."""
        if not self._socket.poll(int(timeout * 1000)):
            return None
        return self._socket.recv_multipart()[-1]
