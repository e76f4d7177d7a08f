"""The daemon's own keys, as `coseg keys generate` makes them, and the roles that they have."""

from __future__ import annotations

import asyncio
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import BINARY, Daemon, environment, free_port

import coseg


def keys(folder: Path, *arguments: str) -> None:
    command = [BINARY, "keys", "--dir", str(folder), *arguments]
    subprocess.run(command, check=True, capture_output=True, env=environment())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("keys") / "k"
    keys(made, "generate", "--server")
    for role in ("read-only", "ingest", "admin"):
        keys(made, "generate", role, "--role", role)
    return made


def curve(folder: Path, name: str) -> coseg.Curve:
    return coseg.Curve.from_files(folder / "server.pub", folder / f"{name}.key")


@pytest.fixture(scope="module")
def locked(folder: Path) -> Iterator[Daemon]:
    settings = {"COSEG__SECURITY__KEYS": str(folder)}
    started = Daemon(f"tcp://127.0.0.1:{free_port()}", settings, curve(folder, "admin"))
    yield started
    started.close()


def test_a_key_has_its_role(locked: Daemon, folder: Path, meshes: list[Path]) -> None:
    with coseg.Library(locked.endpoint, curve=curve(folder, "ingest")) as lib:
        chairs = lib.collection("chairs", parts=4)
        assert chairs.add("first", meshes[0]).outcome == "added"
        # Events come over a socket of their own, with the same keys.
        assert chairs.events_since(0)[0].kind == "collection_created"
        events = chairs.events(since=0)
        assert next(events).sequence == 1
        with pytest.raises(coseg.PermissionDenied) as refusal:
            chairs.delete()
        assert refusal.value.reason == "ROLE_TOO_LOW"
    with coseg.Library(locked.endpoint, curve=curve(folder, "read-only")) as lib:
        assert len(lib.collection("chairs").labels("first")) > 0
        with pytest.raises(coseg.PermissionDenied):
            lib.collection("chairs").remove("first")


def test_the_environment_names_the_files(
    locked: Daemon, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COSEG_SERVER_KEY", str(folder / "server.pub"))
    monkeypatch.setenv("COSEG_CLIENT_KEY", str(folder / "read-only.key"))

    async def version() -> str:
        async with coseg.AsyncLibrary(locked.endpoint) as lib:
            return (await lib.hello()).version

    assert asyncio.run(version())
    monkeypatch.delenv("COSEG_CLIENT_KEY")
    with pytest.raises(coseg.CosegError, match="COSEG_CLIENT_KEY is not set"):
        coseg.Library(locked.endpoint)


def test_who_is_not_on_the_list_gets_no_answer(locked: Daemon, folder: Path, tmp_path: Path) -> None:
    keys(tmp_path / "k", "generate", "--server")
    keys(tmp_path / "k", "generate", "stranger")
    stranger = coseg.Curve.from_files(folder / "server.pub", tmp_path / "k" / "stranger.key")
    for unknown in (stranger, None):
        with (
            coseg.Library(locked.endpoint, curve=unknown, timeout=1.5) as lib,
            pytest.raises(coseg.NoAnswer),
        ):
            lib.hello()


def test_a_key_that_is_revoked_is_refused(locked: Daemon, folder: Path) -> None:
    keys(folder, "generate", "guest", "--role", "read-only")
    # A running daemon looks at the list once a second.
    time.sleep(2)
    with coseg.Library(locked.endpoint, curve=curve(folder, "guest"), timeout=5) as lib:
        lib.hello()
        keys(folder, "revoke", "guest")
        end = time.monotonic() + 10
        with pytest.raises((coseg.PermissionDenied, coseg.NoAnswer)):
            while time.monotonic() < end:
                lib.stats()
                time.sleep(0.1)


def test_files_without_keys_are_named(tmp_path: Path) -> None:
    (tmp_path / "empty").write_text("# nothing\n")
    with pytest.raises(coseg.CosegError, match="empty has no public key"):
        coseg.Curve.from_files(tmp_path / "empty", tmp_path / "empty")
