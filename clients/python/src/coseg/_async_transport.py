"""asyncio sockets around :class:`coseg._link.Link`: one for all tasks."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Any

import zmq
import zmq.asyncio

from coseg._link import Frame, Link
from coseg._options import Curve, configure
from coseg.v1 import message_pb2

Answer = tuple[message_pb2.Reply, list[memoryview]]


class AsyncTransport:
    """Sends requests and awaits their replies. To be used within one event loop."""

    def __init__(self, endpoint: str, timeout: float, curve: Curve | None) -> None:
        self.endpoint, self.timeout, self.curve = endpoint, timeout, curve
        self._context = zmq.asyncio.Context()
        self._link = Link(endpoint, timeout)
        self._waiting: dict[str, asyncio.Future[Answer]] = {}
        self._socket: zmq.asyncio.Socket | None = None
        self._reader: asyncio.Task[None] | None = None

    async def close(self) -> None:
        """Closes all sockets; who still waits is cancelled."""
        if self._reader is not None:
            self._reader.cancel()
        for future in self._waiting.values():
            future.cancel()
        self._context.destroy(linger=0)

    async def sleep(self, seconds: float) -> None:
        """Waits."""
        await asyncio.sleep(seconds)

    async def exchange(self, request_id: str, frames: Sequence[Frame]) -> Answer:
        """Sends a request, again if need be, and returns the reply and its raw frames."""
        if self._socket is None:
            self._socket = self._context.socket(zmq.DEALER)
            configure(self._socket, self.curve)
            self._socket.connect(self.endpoint)
        if self._reader is None or self._reader.done():
            self._reader = asyncio.create_task(self._read(self._socket))
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting[request_id] = future
        self._link.begin(request_id, frames, time.monotonic())
        try:
            await self._send(self._socket, request_id, frames)
            while True:
                left = max(0.001, self._link.next_tick() - time.monotonic())
                awaited: set[asyncio.Future[Any]] = {future, self._reader}
                done, _ = await asyncio.wait(awaited, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                if future in done:
                    return future.result()
                if self._reader in done:
                    # It ends with an error only.
                    self._reader.result()
                for again, due in self._link.tick(time.monotonic()):
                    await self._send(self._socket, again, due)
        finally:
            self._link.end(request_id)
            del self._waiting[request_id]

    async def _read(self, socket: zmq.asyncio.Socket) -> None:
        while True:
            header, *raw = await socket.recv_multipart(copy=False)
            reply = self._link.receive(header.bytes, time.monotonic())
            if reply is not None:
                future = self._waiting[reply.request_id]
                if not future.done():
                    future.set_result((reply, [frame.buffer for frame in raw]))

    async def _send(self, socket: zmq.asyncio.Socket, request_id: str, frames: Sequence[Frame]) -> None:
        try:
            await socket.send_multipart(frames, zmq.DONTWAIT, copy=False)
        except zmq.Again:
            self._link.unsent(request_id)

    def subscribe(self, endpoint: str, topics: Sequence[bytes]) -> AsyncSubscription:
        """A socket that receives what is published under the topics."""
        return AsyncSubscription(self._context, endpoint, topics, self.curve)


class AsyncSubscription:
    """A socket that receives events."""

    def __init__(self, context: Any, endpoint: str, topics: Sequence[bytes], curve: Curve | None) -> None:
        self._socket: zmq.asyncio.Socket = context.socket(zmq.SUB)
        configure(self._socket, curve)
        for topic in topics:
            self._socket.subscribe(topic)
        self._socket.connect(endpoint)

    async def __aenter__(self) -> AsyncSubscription:
        return self

    async def __aexit__(self, *_: object) -> None:
        self._socket.close(linger=0)

    async def receive(self, timeout: float) -> bytes | None:
        """The body of the next message, or ``None`` after that many seconds of silence."""
        if not await self._socket.poll(int(timeout * 1000)):
            return None
        return (await self._socket.recv_multipart())[-1]
