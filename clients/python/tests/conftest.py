"""The real daemon on a temporary library, and made shapes to feed it."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import coseg

ROOT = Path(__file__).resolve().parents[3]
BINARY = os.environ.get("COSEG_BIN", str(ROOT / "target" / "release" / "coseg"))
#: Few faces: what is tested is the client.
FACES = "1500"


def environment() -> dict[str, str]:
    own = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")}
    return {**own, "NO_COLOR": "1"}


class Daemon:
    """A daemon in a folder of its own."""

    def __init__(
        self,
        endpoint: str | None = None,
        settings: dict[str, str] | None = None,
        curve: coseg.Curve | None = None,
    ) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="coseg"))
        self.endpoint = endpoint or f"ipc://{self.folder}/s"
        self.settings = settings or {}
        self.curve = curve
        self.process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        command = [BINARY, "serve", "--library", f"{self.folder}/library", "--endpoint", self.endpoint]
        with open(self.folder / "log", "ab") as log:
            self.process = subprocess.Popen(command, stderr=log, env={**environment(), **self.settings})
        with coseg.Library(self.endpoint, timeout=30, curve=self.curve) as lib:
            lib.hello()

    def kill(self) -> None:
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def restart(self) -> None:
        self.kill()
        self.start()

    def stop(self) -> int:
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=60)

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.kill()
        shutil.rmtree(self.folder)


@pytest.fixture
def daemon() -> Iterator[Daemon]:
    started = Daemon()
    yield started
    started.close()


@pytest.fixture
def lib(daemon: Daemon) -> Iterator[coseg.Library]:
    with coseg.Library(daemon.endpoint) as library:
        yield library


@pytest.fixture(scope="session")
def shared() -> Iterator[Daemon]:
    """A daemon for tests that keep to collections of their own."""
    started = Daemon()
    yield started
    started.close()


@pytest.fixture(scope="session")
def meshes() -> Iterator[list[Path]]:
    """Twelve chairs, in the order of their numbers."""
    with tempfile.TemporaryDirectory() as folder:
        command = [BINARY, "synth", "chair", "--count", "12", "--faces", FACES, "--out", folder]
        subprocess.run(command, check=True, capture_output=True, env=environment())
        yield sorted(Path(folder).glob("*.off"))


@pytest.fixture(scope="session")
def chairs(shared: Daemon, meshes: list[Path]) -> Iterator[coseg.Collection]:
    """Six chairs with labels; tests that change them make a collection of their own."""
    with coseg.Library(shared.endpoint) as lib:
        collection = lib.collection("chairs", parts=4, up="+y")
        assert all(added.ok for added in collection.add_many(meshes[:6]))
        collection.wait_idle()
        yield collection


def wait_until(condition: object, seconds: float = 30) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come to pass"
        time.sleep(0.02)


def free_port() -> int:
    """A port that is free, and the next one too."""
    while True:
        with socket.socket() as a, socket.socket() as b:
            a.bind(("127.0.0.1", 0))
            port: int = a.getsockname()[1]
            try:
                b.bind(("127.0.0.1", port + 1))
            except OSError:
                continue
            return port
