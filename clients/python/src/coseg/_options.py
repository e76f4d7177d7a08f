"""Where the daemon is and how to reach it."""

from __future__ import annotations

import os
import re
import uuid
from dataclasses import dataclass
from typing import Any

import zmq


@dataclass(frozen=True)
class Curve:
    """Keys of an encrypted connection, each 40 characters of Z85."""

    #: The daemon's public key.
    server: str
    #: This client's pair.
    public: str
    secret: str

    @staticmethod
    def ephemeral(server: str) -> Curve:
        """A new pair, for a daemon that lets any client in that knows its key."""
        public, secret = zmq.curve_keypair()
        return Curve(server, public.decode(), secret.decode())

    def apply(self, socket: zmq.Socket[Any]) -> None:
        """Sets the keys on a socket that is not yet connected."""
        socket.curve_serverkey = self.server.encode()
        socket.curve_publickey = self.public.encode()
        socket.curve_secretkey = self.secret.encode()


def default_endpoint() -> str:
    """``$COSEG_ENDPOINT``, else where a daemon of this user listens when nobody says otherwise."""
    if endpoint := os.environ.get("COSEG_ENDPOINT"):
        return endpoint
    for variable, below in (("RUNTIME_DIRECTORY", ""), ("XDG_RUNTIME_DIR", "/coseg")):
        if directory := os.environ.get(variable):
            return f"ipc://{directory}{below}/coseg.sock"
    return f"ipc:///tmp/coseg-{os.getuid()}/coseg.sock"


def reachable(announced: str, endpoint: str) -> str:
    """Where events come from: a daemon that listens on all addresses names none, so the host is ours."""
    every = re.fullmatch(r"tcp://(?:0\.0\.0\.0|\[::\]|\*):(\d+)", announced)
    known = re.fullmatch(r"tcp://(.+):\d+", endpoint)
    return f"tcp://{known[1]}:{every[1]}" if every and known else announced


def new_client_id() -> str:
    """A name that no other client ever has: idempotency keys must not be shared by accident."""
    return f"python-{uuid.uuid4().hex}"


def configure(socket: zmq.Socket[Any], curve: Curve | None) -> None:
    """What every socket of a client has."""
    socket.linger = 0
    if curve is not None:
        curve.apply(socket)
