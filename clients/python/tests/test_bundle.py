"""Labels by a bundle are those that the daemon gives to the same mesh."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from conftest import BINARY, Daemon

import coseg


@pytest.fixture(autouse=True)
def binary(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSEG_BIN", BINARY)


@pytest.fixture
def corrected(lib: coseg.Library, meshes: list[Path]) -> coseg.Collection:
    """Five chairs, one of which a person labelled: the sixth does not make the model be fitted again."""
    collection = lib.collection("chairs", parts=4, up="+y")
    assert all(added.ok for added in collection.add_many(meshes[:5]))
    labels = np.loadtxt(meshes[0].with_suffix(".labels.txt"), dtype=np.int32)
    collection.correct(meshes[0].stem, labels)
    collection.wait_idle()
    return collection


def arrays(path: Path) -> tuple[np.ndarray, np.ndarray]:
    lines = path.read_text().split("\n")
    n, m, _ = map(int, lines[1].split())
    vertices = np.array([line.split() for line in lines[2 : 2 + n]], np.float64)
    faces = np.array([line.split()[1:] for line in lines[2 + n : 2 + n + m]], np.int64)
    return vertices, faces


def test_labels_are_those_of_the_daemon(
    corrected: coseg.Collection, meshes: list[Path], tmp_path: Path
) -> None:
    bundle = tmp_path / "chairs.coseg"
    published = corrected.publish(bundle)
    assert published.n_bytes == bundle.stat().st_size and not published.clusters_next
    vertices, faces = arrays(meshes[6])
    sent: dict[str, coseg.MeshLike] = {
        "file": meshes[5],
        "arrays": (vertices, faces),
        "bad": coseg.Encoded("off", b"OFF\n1 1 0\n0 0 0\n"),
    }
    by_bundle = coseg.label_all(sent, bundle)
    assert list(by_bundle) == ["file", "arrays", "bad"]
    bad = by_bundle["bad"]
    assert isinstance(bad, coseg.InvalidArgument) and bad.reason == "PARSE"
    for name, mesh in (("file", meshes[5]), ("arrays", (vertices, faces))):
        found = by_bundle[name]
        assert isinstance(found, coseg.LabelledMesh)
        assert found.bundle == published.bundle and found.same_processor
        assert corrected.add(name, mesh).ok
        labelling, shape = corrected.labelling(name, confidence=True), corrected.shape(name)
        assert labelling.confidence is not None
        np.testing.assert_array_equal(found.labels, labelling.labels)
        np.testing.assert_array_equal(found.confidence, labelling.confidence)
        assert (found.parts, found.sources) == (shape.parts, shape.sources)
        assert (found.content_digest, found.area) == (shape.content_digest, shape.area)
        assert not set(found.missing) & set(found.labels.tolist())
        corrected.remove(name)
        one = coseg.label(mesh, bundle, threads=1)
        np.testing.assert_array_equal(one.labels, found.labels)


def test_a_bad_bundle_is_an_error_of_the_call(meshes: list[Path], tmp_path: Path) -> None:
    bundle = tmp_path / "no.coseg"
    bundle.write_bytes(b"OFF\n")
    with pytest.raises(coseg.CosegError, match="is no bundle of"):
        coseg.label(meshes[0], bundle)
    with pytest.raises(coseg.BadMesh):
        coseg.label(3, bundle)  # type: ignore[arg-type]


def test_a_collection_with_nothing_to_publish_is_refused(daemon: Daemon, tmp_path: Path) -> None:
    async def main() -> None:
        async with coseg.AsyncLibrary(daemon.endpoint) as lib:
            await lib.create("empty")
            with pytest.raises(coseg.FailedPrecondition) as refused:
                await lib.collection("empty").publish(tmp_path / "x.coseg")
            assert refused.value.reason == "NOT_PUBLISHABLE"

    asyncio.run(main())
    assert list(tmp_path.iterdir()) == []
