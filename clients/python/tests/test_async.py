"""The asyncio twin against the real daemon."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from conftest import Daemon

import coseg


def test_many_requests_are_under_way_at_once(chairs: coseg.Collection) -> None:
    names = [s.name for s in chairs.shapes()]
    endpoint = chairs.library.endpoint

    async def main() -> None:
        async with coseg.AsyncLibrary(endpoint) as lib:
            collection = lib.collection("chairs")
            pairs = [(a, b) for a in names for b in names if a != b]
            maps = await asyncio.gather(*(collection.map(a, b) for a, b in pairs))
            assert [(m.source, m.target) for m in maps] == pairs
            labels = await asyncio.gather(*(collection.labels(n) for n in names))
            for name, found in zip(names, labels, strict=True):
                assert (found == chairs.labels(name)).all()
            assert [s.name async for s in collection.shapes()] == names
            with pytest.raises(coseg.NotFound):
                await collection.labels("nobody")
            spectrum = await collection.spectrum(names[0])
            assert spectrum.eigenvalues.dtype == np.float64

    asyncio.run(main())


def test_events_come_while_shapes_stream_in_and_the_daemon_dies(daemon: Daemon, meshes: list[Path]) -> None:
    async def main() -> None:
        async with coseg.AsyncLibrary(daemon.endpoint) as lib:
            collection = await lib.create("live", parts=4)

            async def follow() -> list[coseg.Event]:
                seen: list[coseg.Event] = []
                async for event in collection.events(since=0):
                    seen.append(event)
                    if event.shape == meshes[5].stem and event.kind == "shape_added":
                        break
                return seen

            following = asyncio.create_task(follow())
            added = []
            async for one in collection.add_many(meshes[:6], in_flight=4):
                added.append(one)
                if len(added) == 3:
                    await asyncio.to_thread(daemon.restart)
            assert [a.outcome for a in added] == ["added"] * 6
            seen = await asyncio.wait_for(following, 60)
            assert [e.sequence for e in seen] == list(range(1, len(seen) + 1))

    asyncio.run(main())


def test_a_task_can_be_cancelled_and_the_connection_goes_on(daemon: Daemon) -> None:
    async def main() -> None:
        async with coseg.AsyncLibrary(daemon.endpoint) as lib:
            collection = await lib.create("c")
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(0.3):
                    async for _ in collection.events():
                        pass
            assert (await collection.info()).n_shapes == 0

    asyncio.run(main())


def test_silence_ends_every_waiting_task() -> None:
    async def main() -> None:
        async with coseg.AsyncLibrary("ipc:///tmp/no-coseg-here/s", timeout=1.2) as lib:
            results = await asyncio.gather(*(lib.hello() for _ in range(3)), return_exceptions=True)
            assert [type(r) for r in results] == [coseg.NoAnswer] * 3

    asyncio.run(main())


def test_an_outage_is_survived(daemon: Daemon) -> None:
    async def main() -> None:
        async with coseg.AsyncLibrary(daemon.endpoint) as lib:
            await lib.hello()
            daemon.kill()
            restart = threading.Timer(1.5, daemon.start)
            restart.start()
            await asyncio.gather(*(lib.create(f"c{i}") for i in range(5)))
            assert len(await lib.collections()) == 5
            restart.join()

    asyncio.run(main())


def test_the_blocking_client_is_made_of_this_one() -> None:
    tool = Path(__file__).parent.parent / "tools" / "make_sync.py"
    subprocess.run([sys.executable, tool, "--check"], check=True)
