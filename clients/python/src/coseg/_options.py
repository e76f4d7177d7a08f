"""Where the daemon is and how to reach it."""

from __future__ import annotations

import os
import re
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq

from coseg._folder import default_folder
from coseg.errors import CosegError


@dataclass(frozen=True)
class Curve:
    """Keys of an encrypted connection, each 40 characters of Z85."""

    #: The daemon's public key.
    server: str
    #: This client's pair.
    public: str
    secret: str

    @staticmethod
    def from_files(server: str | os.PathLike[str], client: str | os.PathLike[str]) -> Curve:
        """The keys that ``coseg keys generate`` made: the daemon's ``server.pub`` and this client's
        ``NAME.key``."""
        return Curve(_key(server, "public"), _key(client, "public"), _key(client, "secret"))

    @staticmethod
    def from_env() -> Curve | None:
        """The keys of the files that ``$COSEG_SERVER_KEY`` and ``$COSEG_CLIENT_KEY`` name, as the command
        line takes them; ``None`` where neither is set."""
        server, client = os.environ.get("COSEG_SERVER_KEY"), os.environ.get("COSEG_CLIENT_KEY")
        if not server and not client:
            return None
        if not server or not client:
            missing = "COSEG_CLIENT_KEY" if server else "COSEG_SERVER_KEY"
            raise CosegError(f"an encrypted connection needs both keys: {missing} is not set")
        return Curve.from_files(server, client)

    def apply(self, socket: zmq.Socket[Any]) -> None:
        """Sets the keys on a socket that is not yet connected."""
        socket.curve_serverkey = self.server.encode()
        socket.curve_publickey = self.public.encode()
        socket.curve_secretkey = self.secret.encode()


def _key(path: str | os.PathLike[str], kind: str) -> str:
    """The key of a kind in a file of lines `KIND KEY`."""
    for line in Path(path).read_text(encoding="ascii").splitlines():
        match line.split():
            case [found, key] if found == kind and len(key) == 40:
                return key
    raise CosegError(
        f"{os.fspath(path)} has no {kind} key of 40 characters; `coseg keys generate` makes such files"
    )


def default_endpoint() -> str:
    """``$COSEG_ENDPOINT``, else where a daemon of this user listens when nobody says otherwise.

    Raises :class:`CosegError` if somebody else could listen there in its place.
    """
    return os.environ.get("COSEG_ENDPOINT") or f"ipc://{default_folder()}/coseg.sock"


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
