"""The blocking client against the real daemon."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import Daemon, free_port, wait_until

import coseg


def fresh(chairs: coseg.Collection, name: str, meshes: list[Path]) -> coseg.Collection:
    """A collection of three shapes that a test may change."""
    collection = chairs.library.collection(name, parts=4, up="+y")
    assert all(a.ok for a in collection.add_many(meshes[:3]))
    collection.wait_idle()
    return collection


def read_off(path: Path) -> tuple[np.ndarray, np.ndarray]:
    words = path.read_text().split()
    n, m = int(words[1]), int(words[2])
    vertices = np.array(words[4 : 4 + 3 * n], np.float64).reshape(n, 3)
    faces = np.array(words[4 + 3 * n :], np.int64).reshape(m, 4)[:, 1:]
    return vertices, faces


def test_the_daemon_introduces_itself(chairs: coseg.Collection) -> None:
    hello = chairs.library.hello()
    assert hello.protocol == "coseg.v1"
    assert {"off", "obj"} <= set(hello.formats)
    assert hello.limits.max_shapes_per_request > 0
    assert "add_shapes.arrays" in hello.capabilities
    assert chairs.library.stats()["pid"]


def test_labels_come_for_each_face_in_the_order_that_was_sent(
    chairs: coseg.Collection, meshes: list[Path]
) -> None:
    vertices, faces = read_off(meshes[0])
    labels = chairs.labels(meshes[0].stem)
    assert labels.dtype == np.int32 and labels.shape == (len(faces),)
    assert len(np.unique(labels)) >= 2
    # Sent in another order, the labels are in that order.
    order = np.random.default_rng(1).permutation(len(faces))
    lib = chairs.library
    for name, mesh in {
        "float64": (vertices, faces[order]),
        "float32": (vertices.astype(np.float32), faces[order].astype(np.int32)),
        "lists": (vertices.tolist(), faces[order].tolist()),
    }.items():
        other = lib.collection(f"order-{name}", parts=4, up="+y")
        assert other.add("first", (vertices, faces)).outcome == "added"
        assert other.add("second", mesh).outcome == "added"
        first, second = other.labels("first"), other.labels("second")
        assert (first[order] == second).mean() > 0.98
        other.delete()
    full = chairs.labelling(meshes[0].stem, confidence=True)
    assert full.version >= 1 and full.confidence is not None
    assert full.confidence.dtype == np.float32 and full.confidence.shape == labels.shape
    labels[0] = 7  # the array is the caller's own


def test_shapes_tell_what_they_are(chairs: coseg.Collection, meshes: list[Path]) -> None:
    shapes = list(chairs.shapes())
    assert [s.name for s in shapes] == [m.stem for m in meshes[:6]]
    shape = chairs.shape(shapes[0].name)
    assert shape.ordinal == 1 and shape.n_polygons == len(chairs.labels(shape.name))
    assert shape.report["n_triangles"] == shape.n_polygons
    assert abs(sum(p.area_share for p in shape.parts) - 1) < 1e-3
    info = chairs.info()
    assert (info.name, info.n_parts, info.up, info.operator) == ("chairs", 4, "+y", "tufted")
    assert info.n_shapes == 6 and len(info.labels) >= 2
    label = info.labels[0]
    assert 0 <= label.colour_rgb < 1 << 24 and label.merged_into is None
    carrying = list(chairs.shapes(label=label.id))
    assert len(carrying) == label.n_shapes
    assert chairs.original(shape.name).data == meshes[0].read_bytes()
    assert chairs.original(shape.name).format == "off"
    assert [c.name for c in chairs.library.collections() if c.name == "chairs"] == ["chairs"]


def test_spectra_and_maps_are_arrays(chairs: coseg.Collection, meshes: list[Path]) -> None:
    a, b = meshes[0].stem, meshes[1].stem
    spectrum = chairs.spectrum(a, eigenvectors=True, resolution="proxy")
    assert spectrum.eigenvalues.dtype == np.float64
    assert (np.diff(spectrum.eigenvalues) >= 0).all() and abs(spectrum.eigenvalues[0]) < 1e-6
    assert spectrum.eigenvectors is not None and spectrum.mass is not None
    phi = spectrum.eigenvectors.astype(np.float64)
    gram = phi.T @ (spectrum.mass[:, None] * phi)
    assert np.abs(gram - np.eye(len(gram))).max() < 1e-3
    assert chairs.spectrum(a).eigenvectors is None
    proxy = chairs.descriptors(a)
    assert chairs.hks(a, resolution="proxy").shape[0] == len(proxy.vertices) == len(phi)
    assert proxy.face_map.shape == (len(chairs.labels(a)),)
    fmap = chairs.library.map(a, b, "chairs", resolution="proxy")
    n_b = len(chairs.descriptors(b).vertices)
    assert fmap.p2p_21.shape == (n_b,) and fmap.p2p_21.max() < len(proxy.vertices)
    # c_12 maps what p2p_21 maps: pulling a smooth function back agrees with its coefficients.
    k2, k1 = fmap.c_12.shape
    target = chairs.spectrum(b, eigenvectors=True, resolution="proxy")
    assert target.eigenvectors is not None and target.mass is not None
    pulled = target.eigenvectors[:, :k2].T @ (target.mass[:, None] * fmap.carry(phi[:, :k1]))
    assert np.abs(pulled - fmap.c_12).max() < 0.05
    # Values of another shape, at faces, or a single one are not values at its vertices.
    assert fmap.n1 == len(proxy.vertices)
    for wrong in (phi[:-1], np.zeros(fmap.n1 + 1), np.zeros(len(proxy.faces)), np.zeros(())):
        n = len(wrong) if wrong.ndim else 0
        with pytest.raises(ValueError, match=f"values have {n} rows, .* has {fmap.n1}, one for each vertex"):
            fmap.carry(wrong)
    assert fmap.quality.coverage > 0
    assert fmap.quality.expected_error is None
    assert fmap.confidence is not None and fmap.confidence.shape == fmap.matched.shape == (n_b,)
    assert np.all(fmap.confidence[~fmap.matched] == 0) and fmap.alternative is None
    assert fmap.agreement is None and 0 < (fmap.quality.confidence or 0) < 1
    agreement = chairs.map(a, b, agreement=True).agreement
    assert agreement is not None and (agreement.n_triangles > 1 or not agreement.inconsistent)
    # One for points, and what it carries: constants, and labels as good as those that are there.
    dense = chairs.library.map(a, b, "chairs", points=True, resolution="proxy")
    assert dense.p2p_21.shape == (n_b,) and 0 < (dense.quality.expected_error or 0) < 1
    turned = chairs.map(a, b, orientation="reverse", k=30, alternative=True, resolution="proxy")
    assert turned.c_12.shape == (30, 30) and (turned.quality.orientation or 0) < 0
    other = turned.alternative
    assert other is not None and other.c_12.shape == (30, 30) and (other.quality.orientation or 0) > 0
    assert turned.alternative_cost is not None and other.p2p_21.shape == (n_b,)
    with pytest.raises(ValueError, match="orientation is 'left'"):
        chairs.map(a, b, orientation="left")
    pinned = chairs.map(a, b, landmarks=[(int(dense.p2p_21[0]), 0)], resolution="proxy")
    assert pinned.quality.expected_error is not None
    n_faces = len(chairs.labels(a)), len(chairs.labels(b))
    both = chairs.transferred(np.ones((n_faces[0], 2)), a, b)
    ones = both.values
    assert both.quality.expected_error == dense.quality.expected_error
    assert ones.shape == (n_faces[1], 2) and np.allclose(ones, 1)
    voted = chairs.transfer(chairs.labels(a), a, b)
    assert voted.dtype == np.int32 and (voted == chairs.labels(b)).mean() > 0.5
    matches = chairs.match_parts(a, b)
    assert matches.matches and matches.matches[0].overlap > 0
    nearest = chairs.nearest(a, limit=2)
    assert len(nearest) == 2 and nearest[0].distance <= nearest[1].distance


@pytest.fixture(scope="session")
def coarse(shared: Daemon, meshes: list[Path]) -> Iterator[coseg.Collection]:
    """Two chairs whose working meshes are coarser than their files."""
    with coseg.Library(shared.endpoint) as lib:
        lib.create("coarse", parts=4, up="+y", working_faces=500)
        collection = lib.collection("coarse")
        assert all(added.ok for added in collection.add_many(meshes[:2]))
        yield collection


def test_arrays_are_of_the_mesh_as_it_was_sent(coarse: coseg.Collection, meshes: list[Path]) -> None:
    chairs = coarse
    a, b = meshes[0].stem, meshes[1].stem
    one, two = coseg.read_mesh(meshes[0]), coseg.read_mesh(meshes[1])
    n, n_b = len(one.vertices), len(two.vertices)
    proxy = chairs.descriptors(a)
    assert n > len(proxy.vertices) + 100
    spectrum = chairs.spectrum(a, eigenvectors=True)
    assert spectrum.eigenvectors is not None and spectrum.mass is not None
    assert len(spectrum.eigenvectors) == len(spectrum.mass) == n
    assert spectrum.mass.sum() == pytest.approx(1, abs=1e-4)
    # What is interpolated is nearly what it is there: the first is constant, the others orthonormal.
    phi = spectrum.eigenvectors[:, :10].astype(np.float64)
    assert np.allclose(phi[:, 0], phi[0, 0], rtol=1e-4)
    assert np.abs(phi.T @ (spectrum.mass[:, None] * phi) - np.eye(10)).max() < 0.1
    hks, of_faces = chairs.hks(a), chairs.hks(a, resolution="input_faces")
    assert len(hks) == n and len(of_faces) == one.n_polygons
    # Where the working mesh has kept a vertex of the file, the value is the same, to the bit.
    rows = {row.tobytes(): v for v, row in enumerate(hks)}
    own = [row.tobytes() for row in chairs.hks(a, resolution="proxy")]
    kept = np.array([(i, rows[row]) for i, row in enumerate(own) if row in rows])
    assert len(kept) > 0.95 * len(own)
    places = [proxy.vertices[kept[:, 0]].astype(np.float64), one.vertices[kept[:, 1]]]
    there, here = (p - p.mean(axis=0) for p in places)
    assert np.allclose(there / np.linalg.norm(there), here / np.linalg.norm(here), atol=1e-5)

    fmap = chairs.map(a, b)
    assert (fmap.n1, len(fmap.p2p_21), fmap.resolution) == (n, n_b, "input")
    assert fmap.confidence is not None and len(fmap.confidence) == len(fmap.matched) == n_b
    assert np.array_equal(fmap.carry(np.arange(n)), fmap.p2p_21)
    with pytest.raises(ValueError, match=f"values have {n_b} rows, .* has {n}, one for each vertex"):
        fmap.carry(np.zeros(n_b))
    faces = chairs.map(a, b, resolution="input_faces", points=True, alternative=True)
    assert (faces.n1, len(faces.p2p_21)) == (one.n_polygons, two.n_polygons)
    assert faces.alternative is not None and len(faces.alternative.p2p_21) == two.n_polygons

    # Constants stay, wherever something corresponds.
    ones = chairs.transfer(np.ones((n, 2)), a, b, resolution="input")
    matched = ~np.isnan(ones[:, 0])
    assert ones.shape == (n_b, 2) and matched.mean() > 0.5 and np.allclose(ones[matched], 1, atol=1e-5)
    ids = chairs.transfer(np.arange(n), a, b, resolution="input")
    dense = chairs.map(a, b, points=True)
    assert np.array_equal(ids, np.where(dense.matched, dense.p2p_21.astype(np.int32), -1))
    assert np.array_equal(ids >= 0, matched)
    n_proxy = len(proxy.vertices)
    assert len(chairs.transfer(np.arange(n_proxy), a, b, resolution="proxy")) == len(
        chairs.descriptors(b).vertices
    )
    itself = chairs.map(a, a, points=True)
    assert (itself.p2p_21 == np.arange(n)).mean() > 0.95

    # Landmarks are vertices of the files.
    pinned = chairs.map(a, b, landmarks=[(n - 1, n_b - 1)])
    assert pinned.quality.expected_error is not None
    with pytest.raises(coseg.InvalidArgument, match=f"vertex {n}, but the file of .* has {n} vertices"):
        chairs.map(a, b, landmarks=[(n, 0)])
    of = (("input", n - 1, n), ("proxy", n, n_proxy), ("input_faces", n, one.n_polygons))
    for resolution, wrong, has in of:
        with pytest.raises(coseg.InvalidArgument, match=f"values have {wrong} rows, but .* has {has}"):
            chairs.transfer(np.zeros(wrong), a, b, resolution=resolution)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="resolution is 'output'"):
        chairs.hks(a, resolution="output")  # type: ignore[arg-type]


def test_landmarks_are_vertices_of_either_mesh(coarse: coseg.Collection, meshes: list[Path]) -> None:
    chairs, (a, b) = coarse, (meshes[0].stem, meshes[1].stem)
    dense = chairs.map(a, b, points=True, resolution="proxy")
    pairs = [(int(dense.p2p_21[v]), v) for v in (0, 100, 200)]
    # Whatever the rows of the reply are of.
    of_proxy = chairs.map(a, b, landmarks=pairs, landmark_resolution="proxy")
    same = chairs.map(a, b, landmarks=pairs, resolution="proxy")
    assert of_proxy.resolution == "input" and same.resolution == "proxy"
    assert np.array_equal(of_proxy.c_12, same.c_12)
    of_files = chairs.map(a, b, landmarks=pairs, resolution="proxy", landmark_resolution="input")
    assert not np.array_equal(of_files.c_12, same.c_12)
    n = coseg.read_mesh(meshes[0]).n_vertices
    n_proxy = len(chairs.descriptors(a).vertices)
    with pytest.raises(coseg.InvalidArgument, match=f"vertex {n - 1}.* has {n_proxy}"):
        chairs.map(a, b, landmarks=[(n - 1, 0)], landmark_resolution="proxy")
    ones = np.ones(n)
    carried = chairs.transfer(ones, a, b, landmarks=pairs, resolution="input", landmark_resolution="proxy")
    assert np.allclose(carried[~np.isnan(carried)], 1, atol=1e-5)
    with pytest.raises(ValueError, match="landmark_resolution is 'input_faces'"):
        chairs.map(a, b, landmarks=pairs, landmark_resolution="input_faces")  # type: ignore[arg-type]


def test_a_map_of_faces_carries_values_of_faces(coarse: coseg.Collection, meshes: list[Path]) -> None:
    chairs, (a, b) = coarse, (meshes[0].stem, meshes[1].stem)
    labels, faces = chairs.labels(a), chairs.map(a, b, resolution="input_faces")
    carried = faces.carry(labels)
    assert len(carried) == len(chairs.labels(b)) and np.array_equal(carried, labels[faces.p2p_21])
    n_vertices = coseg.read_mesh(meshes[0]).n_vertices
    with pytest.raises(ValueError, match=f"values have {n_vertices} rows, .* one for each face of the mesh"):
        faces.carry(np.zeros(n_vertices))
    with pytest.raises(ValueError, match=f"values have {len(labels)} rows, .* one for each vertex of"):
        chairs.map(a, b).carry(labels)


def test_the_one_line_of_a_map(daemon: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(daemon.endpoint) as lib:
        lib.collection("only", parts=4).submit(meshes[:2])
        lib.only_collection().wait_idle()
        fmap = lib.map(meshes[0].stem, meshes[1].stem)
        assert fmap.c_12.ndim == 2 and fmap.source == meshes[0].stem
        lib.create("second")
        with pytest.raises(coseg.CosegError, match="there are 2"):
            lib.map(meshes[0].stem, meshes[1].stem)


def test_streams_yield_in_order_and_failures_stay_alone(shared: Daemon, meshes: list[Path]) -> None:
    bad = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n"
    with coseg.Library(shared.endpoint) as lib:
        collection = lib.collection("stream", parts=4)
        n_read = 0
        seen: list[coseg.Added] = []
        ahead = []

        def source() -> object:
            nonlocal n_read
            for mesh in meshes[:6]:
                n_read += 1
                yield mesh
                if n_read == 2:
                    yield "bad", coseg.Encoded("off", bad.encode())
                    yield "unread", "/nowhere/x.off"
                    yield "wrong", coseg.Encoded("step", b"")

        jobs: list[coseg.Job] = []
        for added in collection.add_many(source(), in_flight=4, on_progress=jobs.append):  # type: ignore[arg-type]
            seen.append(added)
            ahead.append(n_read - len(seen))
        names = [m.stem for m in meshes[:6]]
        assert [a.name for a in seen] == [*names[:2], "bad", "unread", "wrong", *names[2:]]
        failed = {a.name: a.error for a in seen if not a.ok}
        assert set(failed) == {"bad", "unread", "wrong"}
        refused = failed["bad"]
        assert isinstance(refused, coseg.InvalidArgument) and refused.reason == "VERTEX_INDEX"
        assert refused.face == 0 or refused.line is not None
        assert isinstance(failed["unread"], OSError)
        assert isinstance(failed["wrong"], coseg.BadMesh)
        assert max(ahead) <= 6, "the stream is read as needed"
        assert jobs and jobs[-1].finished and jobs[-1].progress == 1.0
        assert all(a.stages and a.version >= 1 for a in seen if a.ok)
        again = list(collection.add_many(meshes[:6]))
        assert {a.outcome for a in again} == {"unchanged"}


def test_a_run_is_taken_up_by_its_key(shared: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(shared.endpoint) as lib:
        first = lib.collection("resume", parts=4).add_many(meshes[:5], key="run-1", in_flight=4)
        assert next(first).outcome == "added"
        assert next(first).outcome == "added"
    # That program is gone; another one does the same again.
    with coseg.Library(shared.endpoint) as lib:
        collection = lib.collection("resume", parts=4)
        again = list(collection.add_many(meshes[:5], key="run-1", in_flight=4))
        # Not "unchanged": the jobs of the first run are its answer.
        assert [a.outcome for a in again] == ["added"] * 5
        assert collection.info().n_shapes == 5
        assert {a.outcome for a in collection.add_many(meshes[:5], key="run-2")} == {"unchanged"}


def test_refusals_are_typed(chairs: coseg.Collection, meshes: list[Path]) -> None:
    with pytest.raises(coseg.NotFound) as e:
        chairs.labels("nobody")
    assert (e.value.code, e.value.reason, e.value.retry_after) == ("NOT_FOUND", "NO_SHAPE", None)
    assert "nobody" in e.value.message
    with pytest.raises(coseg.AlreadyExists) as taken:
        chairs.add(meshes[0].stem, meshes[1])
    assert taken.value.reason == "NAME_TAKEN"
    with pytest.raises(coseg.AlreadyExists):
        chairs.library.create("chairs")
    with pytest.raises(coseg.FailedPrecondition) as differs:
        chairs.library.collection("chairs", parts=7).add("x", meshes[0])
    assert differs.value.reason == "COLLECTION_DIFFERS"
    with pytest.raises(coseg.InvalidArgument) as range_error:
        chairs.library.call("wait_idle", wait_ms=10**9)
    assert range_error.value.field == "wait_ms"
    with pytest.raises(coseg.BadMesh, match="vertex 5, but the mesh has 3"):
        chairs.add("x", (np.zeros((3, 3)), [[0, 1, 5]]))
    with pytest.raises(coseg.BadMesh, match="expected real"):
        chairs.add("x", (np.zeros((3, 2)), [[0, 1, 2]]))
    with pytest.raises(ValueError, match="none of its values"):
        chairs.library.collection("x", up="sideways")


def test_corrections_pin_and_are_undone(chairs: coseg.Collection, meshes: list[Path]) -> None:
    collection = fresh(chairs, "corrections", meshes)
    name = meshes[0].stem
    before = collection.labels(name)
    suggestion = collection.suggest()
    assert suggestion is not None and suggestion.shape in {m.stem for m in meshes[:3]}
    wanted = np.full(len(before), -1)
    wanted[:10] = 9
    corrected = collection.correct(name, wanted)
    assert corrected.n_faces == 10 and 0 < corrected.area_share < 1
    assert (collection.labels(name)[:10] == 9).all()
    collection.correct(name, faces=[20, 21], label=8)
    assert (collection.labels(name)[20:22] == 8).all()
    collection.correct(name, part=0, label=1)
    assert collection.name_label(9, "handle").name == "handle"
    collection.merge(8, into=9)
    assert (collection.labels(name)[20:22] == 9).all()
    changes = [collection.undo().change for _ in range(5)]
    assert changes == ["merge", "name", "correct", "correct", "correct"]
    collection.wait_idle()
    assert (collection.labels(name) == before).all()
    with pytest.raises(coseg.FailedPrecondition) as e:
        collection.undo()
    assert e.value.reason == "NOTHING_TO_UNDO"
    with pytest.raises(ValueError, match="give labels"):
        collection.correct(name, label=3)
    with pytest.raises(ValueError, match="expected integers"):
        collection.correct(name, np.zeros(len(before)))
    with pytest.raises(coseg.InvalidArgument) as count:
        collection.correct(name, [1, 2])
    assert count.value.reason == "LABEL_COUNT"
    biggest = max(collection.info().labels, key=lambda label: label.n_shapes)
    assert collection.split(biggest.id).id != biggest.id
    for mesh in meshes[:3]:
        collection.correct(mesh.stem, np.zeros(len(collection.labels(mesh.stem)), np.int64))
    assert collection.suggest() is None


def test_threads_do_not_wait_for_each_other(chairs: coseg.Collection) -> None:
    names = [s.name for s in chairs.shapes()]
    found: list[object] = []
    threads = [threading.Thread(target=lambda n=n: found.append(chairs.labels(n))) for n in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert len(found) == len(names)


def test_jobs_can_be_watched_and_cancelled(daemon: Daemon, lib: coseg.Library, meshes: list[Path]) -> None:
    collection = lib.collection("jobs", parts=4)
    (job_id,) = collection.submit(meshes[:12])
    cancelled = lib.cancel(job_id)
    states = [job for job in lib.watch(job_id)]
    assert states[-1].finished
    assert {i.state for i in states[-1].items} <= {"done", "cancelled"}
    assert "cancelled" in {i.state for i in cancelled.items}
    assert [j.progress for j in states] == sorted(j.progress for j in states)
    assert lib.job(job_id).finished
    with pytest.raises(OSError):
        collection.submit(["/nowhere/x.off"])


def test_a_full_queue_is_waited_for(meshes: list[Path]) -> None:
    small = Daemon(settings={"COSEG__LIMITS__MAX_QUEUED_SHAPES": "2"})
    try:
        with coseg.Library(small.endpoint) as lib, coseg.Library(small.endpoint) as other:
            begin = time.monotonic()
            rival = threading.Thread(target=lambda: list(other.collection("b").add_many(meshes[6:8])))
            rival.start()
            added = list(lib.collection("a").add_many(meshes[:2]))
            rival.join(60)
            assert all(a.ok for a in added)
            assert other.collection("b").info().n_shapes == 2
            n_refused = lib.stats()["n_refused"]
            assert isinstance(n_refused, int) and n_refused > 0
            # The daemon asks for a second each time; impatient clients would be refused far more.
            assert n_refused < 20 * (time.monotonic() - begin)
    finally:
        small.close()


def test_kill_and_restart_while_shapes_stream_in(daemon: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(daemon.endpoint) as lib:
        collection = lib.collection("killed", parts=4, up="+y")
        seen = []
        for added in collection.add_many(meshes[:8], in_flight=6):
            seen.append(added)
            if len(seen) in (2, 5):
                daemon.restart()
        assert [a.name for a in seen] == [m.stem for m in meshes[:8]]
        assert all(a.outcome == "added" for a in seen), seen
        assert collection.info().n_shapes == 8


def test_kill_while_a_call_waits(daemon: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(daemon.endpoint) as lib:
        lib.hello()
        daemon.kill()
        restart = threading.Timer(1.5, daemon.start)
        restart.start()
        assert lib.create("c").info().n_shapes == 0
        restart.join()


def test_an_orderly_restart_is_survived(daemon: Daemon, meshes: list[Path]) -> None:
    with coseg.Library(daemon.endpoint) as lib:
        seen = []
        for added in lib.collection("drained", parts=4).add_many(meshes[:6], in_flight=4):
            seen.append(added)
            if len(seen) == 3:
                assert daemon.stop() == 0
                daemon.start()
        assert [a.outcome for a in seen] == ["added"] * 6


def test_no_daemon_is_told_in_time() -> None:
    begin = time.monotonic()
    with coseg.Library("ipc:///tmp/no-coseg-here/s", timeout=1.2) as lib, pytest.raises(coseg.NoAnswer) as e:
        lib.hello()
    assert 1 < time.monotonic() - begin < 5
    assert "no-coseg-here" in str(e.value) and isinstance(e.value, TimeoutError)


def test_tcp_serves_as_well(meshes: list[Path]) -> None:
    daemon = Daemon(endpoint=f"tcp://127.0.0.1:{free_port()}")
    try:
        with coseg.Library(daemon.endpoint) as lib:
            collection = lib.collection("tcp", parts=4)
            events = collection.events(since=0)
            collection.add("a", meshes[0])
            assert next(events).kind == "collection_created"
            with pytest.raises(coseg.PermissionDenied):
                lib.call("drain")
    finally:
        daemon.close()


def test_messages_beyond_the_limit_are_not_sent(meshes: list[Path]) -> None:
    limits = {"COSEG__LIMITS__MAX_MESSAGE": "64KiB", "COSEG__LIMITS__MAX_SHAPE": "32KiB"}
    daemon = Daemon(settings=limits)
    try:
        with coseg.Library(daemon.endpoint) as lib:
            collection = lib.collection("c")
            with pytest.raises(coseg.BadMesh, match="the limit is 32 KiB"):
                collection.add("large", coseg.Encoded("off", b"x" * 40_000))
            with pytest.raises(coseg.CosegError, match="the limit is 64 KiB"):
                lib.call("create_collection", [b"x" * 70_000], spec={"name": "c"})
            assert lib.collections() == []
    finally:
        daemon.close()


def test_a_shape_is_removed_and_replaced(chairs: coseg.Collection, meshes: list[Path]) -> None:
    collection = fresh(chairs, "removal", meshes)
    name = meshes[0].stem
    assert collection.add(name, meshes[3], replace=True).outcome == "replaced"
    collection.remove(name)
    with pytest.raises(coseg.NotFound):
        collection.shape(name)
    collection.delete()
    assert "removal" not in {c.name for c in collection.library.collections()}
    wait_until(lambda: collection.library.stats()["n_queued"] == 0)
