"""Thousands of shapes: bounded, in order, and taken up again when this program and the daemon die."""

from __future__ import annotations

import time
from collections.abc import Iterator

from conftest import Daemon

import coseg

N = 2_000
IN_FLIGHT = 64


def test_thousands_stream_and_are_taken_up_again(daemon: Daemon) -> None:
    n_read = 0

    def source() -> Iterator[tuple[str, coseg.Encoded]]:
        """Each another file, and none a surface: refused soon, so that the stream is what takes time."""
        nonlocal n_read
        for i in range(N):
            n_read += 1
            text = f"OFF\n3 1 0\n{i} 0 0\n1 0 0\n0 1 0\n3 0 1 9\n"
            yield f"s{i:04}", coseg.Encoded("off", text.encode())

    begin = time.monotonic()
    with coseg.Library(daemon.endpoint) as lib:
        first = lib.collection("many", parts=2).add_many(source(), key="run", in_flight=IN_FLIGHT)
        for n_seen in range(1, N // 2):
            added = next(first)
            assert added.name == f"s{n_seen - 1:04}" and isinstance(added.error, coseg.InvalidArgument)
            assert n_read - n_seen <= IN_FLIGHT + 16
    # This program is gone, and the daemon too.
    daemon.restart()
    n_jobs_before = 0
    n_read = 0
    with coseg.Library(daemon.endpoint) as lib:
        n_jobs_before = sum(1 for _ in lib.jobs())
        names = [
            added.name
            for added in lib.collection("many", parts=2).add_many(source(), key="run", in_flight=IN_FLIGHT)
        ]
        assert names == [f"s{i:04}" for i in range(N)]
        # The jobs of the first run were taken up: only what it had not handed over is new.
        assert sum(1 for _ in lib.jobs()) == N // 16
        assert n_jobs_before >= N // 2 // 16
    print(f"{N} shapes, half of them twice: {time.monotonic() - begin:.1f} s")
