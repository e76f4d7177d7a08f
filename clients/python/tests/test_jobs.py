"""Jobs that failed are listed with their reasons, and tried again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Daemon

import coseg


@pytest.fixture
def poisoned() -> Iterator[Daemon]:
    """A daemon whose workers do what a comment in a mesh says."""
    started = Daemon(settings={"COSEG_TEST_POISON": "1"})
    yield started
    started.close()


def test_failed_jobs_are_listed_and_tried_again(poisoned: Daemon, meshes: list[Path]) -> None:
    header, body = meshes[1].read_text().split("\n", 1)
    bad = coseg.Encoded("off", f"{header}\n# poison: panic\n{body}".encode())
    with coseg.Library(poisoned.endpoint) as lib:
        chairs = lib.collection("chairs", parts=4)
        chairs.add("good", meshes[0])
        with pytest.raises(coseg.CosegError):
            chairs.add("bad", bad)
        newest_first = [job.id for job in lib.jobs()]
        assert newest_first == sorted(newest_first, reverse=True) and len(newest_first) == 2
        assert [job.id for job in lib.jobs(collection="chairs")] == newest_first
        assert list(lib.jobs(collection="tables")) == []
        (failed,) = lib.jobs(failed=True)
        (item,) = failed.items
        assert item.name == "bad" and item.state == "failed"
        assert item.result is not None and "panic" in str(item.result.error).lower()
        # What is wrong is mended: the same bytes, and workers that pay no heed to the comment.
        poisoned.settings = {}
        poisoned.restart()
        assert lib.retry(failed.id).id == failed.id
        *_, done = lib.watch(failed.id)
        assert done.finished and not list(lib.jobs(failed=True))
        assert len(chairs.labels("bad")) > 0
        with pytest.raises(coseg.NotFound):
            lib.retry(4_711)
