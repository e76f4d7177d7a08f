"""The client, for asyncio. The blocking one is made from this file by ``tools/make_sync.py``."""

from __future__ import annotations

import itertools
import os
import uuid
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from coseg import _wire as wire
from coseg import types as t
from coseg._async_transport import AsyncSubscription, AsyncTransport
from coseg._batch import Batch, Item, batches
from coseg._link import Frame
from coseg._options import Curve, default_endpoint, new_client_id, reachable
from coseg._size import beyond
from coseg._wire import FrameWriter, MeshLike, Raw
from coseg.errors import BadReply, CosegError, EventLogRewound, NoAnswer, Refused
from coseg.v1 import collection_pb2, event_pb2, message_pb2

#: Longest single wait in the daemon, in milliseconds: so long a change of mind takes to be noticed.
WAIT_MS = 1_000
#: Seconds without a heartbeat after which a subscription is renewed; they come once a second.
SILENCE_S = 3.0
#: Seconds between tries while a daemon drains and another has not taken its place.
DRAINING_RETRY_S = 0.5
HEARTBEAT_TOPIC = b"\0"
#: Array files of a bundle begin at multiples of so many bytes.
BUNDLE_ALIGNMENT = 64


class AsyncLibrary:
    """A connection to a daemon, and the library that it keeps.

    ``endpoint``
        ``ipc://PATH`` or ``tcp://HOST:PORT``; by default ``$COSEG_ENDPOINT``, else the socket of this
        user's daemon.
    ``timeout``
        Seconds without any sign of life from a daemon until :class:`coseg.NoAnswer` is raised. Work
        that takes longer while the daemon lives does not count; a daemon that restarts in this time
        gets the same requests again, which have one effect.
    ``curve``
        Keys of an encrypted connection; by default those of the files that ``$COSEG_SERVER_KEY`` and
        ``$COSEG_CLIENT_KEY`` name, if they do.
    ``client_id``
        With a request's id the key under which changes have one effect; made up if it is not given.

    That somebody listens at the endpoint shows with the first request.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout: float = 30.0,
        curve: Curve | None = None,
        client_id: str | None = None,
    ) -> None:
        self.endpoint = endpoint or default_endpoint()
        self.client_id = client_id or new_client_id()
        self._transport = AsyncTransport(self.endpoint, timeout, curve or Curve.from_env())
        self._numbers = itertools.count(1)
        # Request ids of two programs under one client id must differ.
        self._run = uuid.uuid4().hex[:12]
        self._hello: t.Hello | None = None

    async def __aenter__(self) -> AsyncLibrary:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connection."""
        await self._transport.close()

    async def call(
        self,
        body: str,
        frames: Sequence[Frame] = (),
        *,
        client_id: str | None = None,
        request_id: str | None = None,
        deadline_ms: int = 0,
        **fields: Any,
    ) -> tuple[Any, Raw]:
        """Sends any request of the protocol: ``await lib.call("get_job", job_id=7)``.

        A daemon that is at a limit is asked again after the delay it names, one that drains until
        another has taken its place; other refusals are raised.
        """
        if self._hello is None and body != "hello":
            await self.hello()
        request = message_pb2.Request(
            request_id=request_id or f"{self._run}-{next(self._numbers)}",
            client_id=client_id or self.client_id,
            deadline_ms=deadline_ms,
        )
        getattr(request, body).SetInParent()
        for name, value in fields.items():
            _assign(getattr(request, body), name, value)
        message: list[Frame] = [request.SerializeToString(), *frames]
        self._check_size(message)
        while True:
            reply, raw = await self._transport.exchange(request.request_id, message)
            try:
                return wire.result(reply, body), Raw(raw)
            except Refused as e:
                if e.retry_after is not None:
                    await self._transport.sleep(e.retry_after)
                elif e.reason == "DRAINING":
                    await self._transport.sleep(DRAINING_RETRY_S)
                else:
                    raise

    def _check_size(self, message: Sequence[Frame]) -> None:
        # A frame beyond the limit would end the connection without a word.
        if self._hello is not None:
            n_bytes, limit = sum(map(len, message)), self._hello.limits.max_message_bytes
            if n_bytes > limit:
                raise CosegError(beyond("the message has", n_bytes, limit, "limits.max_message"))

    # -- the daemon -----------------------------------------------------------------------------

    async def hello(self) -> t.Hello:
        """Who the daemon is."""
        reply, _ = await self.call("hello")
        self._hello = wire.hello(reply)
        return self._hello

    async def stats(self) -> dict[str, object]:
        """The daemon's counters, by name."""
        reply, _ = await self.call("stats")
        return wire.plain(reply)

    async def drain(self) -> int:
        """Stops the daemon when the work in hand is done; only over ``ipc``. How many accepted shapes are
        not placed yet: those not begun are resumed at the next start."""
        reply, _ = await self.call("drain")
        return int(reply.n_queued)

    # -- collections ----------------------------------------------------------------------------

    async def collections(self) -> list[t.CollectionInfo]:
        """All collections, by name."""
        reply, _ = await self.call("list_collections")
        return [wire.collection(c) for c in reply.collections]

    async def create(
        self,
        name: str,
        *,
        parts: int | None = None,
        up: str | None = None,
        operator: str | None = None,
        working_faces: int = 0,
    ) -> AsyncCollection:
        """Creates a collection: the number of part kinds (estimated without), the axis that points up
        (``"+y"``), the Laplacian (``"tufted"``), faces of the working mesh."""
        spec = wire.collection_spec(name, parts, up, operator, working_faces)
        await self.call("create_collection", spec=spec)
        return self.collection(name)

    def collection(
        self, name: str, *, parts: int | None = None, up: str | None = None, operator: str | None = None
    ) -> AsyncCollection:
        """The collection of that name. The first shape added creates it, with these settings, if it is
        missing; a collection that has others is refused then."""
        spec = wire.collection_spec("", parts, up, operator, 0)
        return AsyncCollection(self, name, spec)

    async def only_collection(self) -> AsyncCollection:
        """The only collection there is."""
        names = [c.name for c in await self.collections()]
        if len(names) != 1:
            raise CosegError(f"name a collection: there are {len(names)} ({', '.join(names)})")
        return self.collection(names[0])

    async def map(
        self,
        source: str,
        target: str,
        collection: str | None = None,
        **options: Any,
    ) -> t.FunctionalMap:
        """The functional map that carries functions on ``source`` to functions on ``target``. The
        collection need not be named if there is only one; options are those of its ``map``."""
        within = self.collection(collection) if collection else await self.only_collection()
        return await within.map(source, target, **options)

    # -- jobs -----------------------------------------------------------------------------------

    async def job(self, job_id: int) -> t.Job:
        """A job as it stands."""
        reply, _ = await self.call("get_job", job_id=job_id)
        return wire.job(reply.job)

    async def watch(self, job_id: int) -> AsyncIterator[t.Job]:
        """A job each time it has changed, until it is finished; also across restarts of the daemon."""
        revision = 0
        while True:
            reply, _ = await self.call("watch_job", job_id=job_id, revision=revision, wait_ms=WAIT_MS)
            job = wire.job(reply.job)
            if job.revision != revision or job.finished:
                yield job
            if job.finished:
                return
            if job.revision == revision:
                # A daemon that drains answers at once.
                await self._transport.sleep(0.02)
            revision = job.revision

    async def cancel(self, job_id: int) -> t.Job:
        """Cancels the shapes of a job that are not placed yet."""
        reply, _ = await self.call("cancel_job", job_id=job_id)
        return wire.job(reply.job)

    async def jobs(self, *, failed: bool = False, collection: str = "") -> AsyncIterator[t.Job]:
        """Jobs, the newest first; with ``failed`` those of which a shape failed, each with its failed
        shapes alone."""
        before = 0
        while True:
            reply, _ = await self.call("list_jobs", failed=failed, collection=collection, before=before)
            for message in reply.jobs:
                yield wire.job(message)
            if not reply.more:
                return
            before = reply.jobs[-1].job_id

    async def retry(self, job_id: int) -> t.RetriedJob:
        """Queues the failed shapes of a job again, once what made them fail is mended. With keys that
        needs the role ``admin``."""
        reply, _ = await self.call("retry_job", job_id=job_id)
        return wire.retried(reply)


class AsyncCollection:
    """One collection of a library; made by :meth:`AsyncLibrary.collection`."""

    def __init__(self, library: AsyncLibrary, name: str, spec: collection_pb2.CollectionSpec) -> None:
        self.library = library
        self.name = name
        self._spec = spec

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.library.endpoint!r})"

    async def _call(self, body: str, frames: Sequence[Frame] = (), **fields: Any) -> tuple[Any, Raw]:
        return await self.library.call(body, frames, collection=self.name, **fields)

    async def info(self) -> t.CollectionInfo:
        """As it stands, with its labels."""
        reply, _ = await self._call("describe_collection")
        return wire.collection(reply.collection)

    async def set(self, *, up: str) -> t.Updated:
        """Changes which way is up, such as ``"+z"``: labels are found again along the new axis, and faces
        that were labelled by hand keep theirs. Shapes that are left to do follow in the background:
        :meth:`wait_idle`. Can be undone."""
        reply, _ = await self._call("update_collection", up=wire.up_value(up))
        return wire.flat(t.Updated, reply)

    async def delete(self) -> None:
        """Deletes the collection with its shapes, labels and events."""
        await self._call("delete_collection")

    # -- adding ---------------------------------------------------------------------------------

    async def add(self, name: str, mesh: MeshLike, *, replace: bool = False) -> t.Added:
        """Adds a shape and waits until it is labelled. A refusal is raised.

        A mesh is the path of a file, :class:`coseg.Encoded` bytes, ``(vertices, faces)``, or an object
        that has both, such as a ``trimesh.Trimesh``.
        """
        async for added in self.add_many([(name, mesh)], replace=replace):
            if added.error is not None:
                raise added.error
            return added
        raise BadReply("a finished job without its shape")

    async def submit(
        self, shapes: Iterable[Item], *, replace: bool = False, key: str | None = None
    ) -> list[int]:
        """Hands shapes over and returns the ids of their jobs as soon as the daemon has them durably.
        One that cannot be read is raised, after those before it were handed over."""
        jobs = []
        async for _, _, job_id in self._send(shapes, replace, key, in_flight=64, strict=True):
            jobs.append(job_id)
        return jobs

    async def add_many(
        self,
        shapes: Iterable[Item],
        *,
        replace: bool = False,
        key: str | None = None,
        in_flight: int = 64,
        on_progress: Callable[[t.Job], None] | None = None,
    ) -> AsyncIterator[t.Added]:
        """Streams shapes in, and yields what became of each, in order.

        ``shapes`` are paths, named after their stems, or pairs of a name and a mesh; it is read as
        needed, and at most about ``in_flight`` shapes are under way. One that fails is yielded with its
        ``error``, and the others go on.

        A daemon that is restarted gets the same requests again. If *this* program may die and be run
        again, give the run a ``key``: with the same key and the same shapes, a second run takes up the
        jobs of the first instead of adding anything twice, for at least 24 hours. Also without a key,
        a shape that is there with the same bytes is ``"unchanged"``.
        """
        under_way: deque[tuple[Batch, int]] = deque()
        n_under_way = 0
        async for batch, n, job_id in self._send(shapes, replace, key, in_flight, strict=False):
            under_way.append((batch, job_id))
            n_under_way += n
            while n_under_way > in_flight - min(n, in_flight // 4):
                oldest, job_id = under_way.popleft()
                n_under_way -= len(oldest.request.shapes)
                async for added in self._finish(oldest, job_id, on_progress):
                    yield added
        while under_way:
            oldest, job_id = under_way.popleft()
            async for added in self._finish(oldest, job_id, on_progress):
                yield added

    async def _send(
        self, shapes: Iterable[Item], replace: bool, key: str | None, in_flight: int, *, strict: bool
    ) -> AsyncIterator[tuple[Batch, int, int]]:
        limits = (await self.library.hello()).limits
        run = key or uuid.uuid4().hex
        create = self._spec
        for index, batch in enumerate(batches(self.name, shapes, limits, in_flight, replace, create)):
            job_id, n = 0, len(batch.request.shapes)
            if n:
                reply, _ = await self.library.call(
                    "add_shapes",
                    batch.writer.frames,
                    client_id=f"add-many-{run}",
                    request_id=batch.request_id(index),
                    **{f.name: v for f, v in batch.request.ListFields()},
                )
                job_id = reply.job_id
            for result in batch.results:
                if strict and result is not None and result.error is not None:
                    raise result.error
            if n or not strict:
                # The bytes are the daemon's now.
                batch.writer.frames.clear()
                yield batch, n, job_id

    async def _finish(
        self, batch: Batch, job_id: int, on_progress: Callable[[t.Job], None] | None
    ) -> AsyncIterator[t.Added]:
        ready: deque[t.Added] = deque()
        results = deque(batch.results)
        n_taken = 0
        if batch.request.shapes:
            async for job in self.library.watch(job_id):
                if on_progress is not None:
                    on_progress(job)
                # Shapes are placed in order, but those that fail may be over before.
                while n_taken < len(job.items) and job.items[n_taken].result is not None:
                    ready.append(job.items[n_taken].result)  # type: ignore[arg-type]
                    n_taken += 1
                while results and (results[0] is not None or ready):
                    yield results.popleft() or ready.popleft()
        for result in results:
            if result is None:
                raise BadReply(f"job {job_id} is finished without all of its shapes")
            yield result

    async def wait_idle(self, timeout: float | None = None) -> t.Idle:
        """Waits until no shape is to be placed and no label to be recomputed, at most ``timeout``
        seconds."""
        left_ms = float("inf") if timeout is None else timeout * 1000
        while True:
            wait_ms = int(min(WAIT_MS, max(0.0, left_ms)))
            reply, _ = await self._call("wait_idle", wait_ms=wait_ms)
            left_ms -= wait_ms
            if reply.idle or left_ms <= 0:
                return wire.flat(t.Idle, reply)
            await self.library._transport.sleep(0.02)

    # -- shapes ---------------------------------------------------------------------------------

    async def shapes(
        self, *, label: int | str | None = None, review: str | None = None
    ) -> AsyncIterator[t.Shape]:
        """All shapes in the order of their arrival, or those that carry a label, by its id or name, or
        those with a verdict, such as ``"approved"``."""
        token = ""
        fields: dict[str, Any] = {} if label is None else {"label": await self._label(label)}
        if review is not None:
            fields["review"] = wire.review_state(review)
        while True:
            reply, _ = await self._call("list_shapes", page_token=token, **fields)
            for shape in reply.shapes:
                yield wire.shape(shape)
            token = reply.next_page_token
            if not token:
                return

    async def shape(self, name: str) -> t.Shape:
        """One shape: its parts, what cleaning found, where its labels come from."""
        reply, _ = await self._call("get_shape", shape=name)
        return wire.shape(reply.shape)

    async def labels(self, name: str, *, version: int = 0) -> t.Int32:
        """(n_polygons,) one label for each face of the bytes that were sent, in their order; −1:
        unlabelled."""
        return (await self.labelling(name, version=version)).labels

    async def labelling(self, name: str, *, version: int = 0, confidence: bool = False) -> t.Labelling:
        """Labels with their version and, if wanted, their probabilities."""
        fields: dict[str, Any] = {"version": version, "confidence": confidence}
        reply, raw = await self._call("get_labels", shape=name, **fields)
        return wire.labelling(reply, raw)

    async def snapshot(self) -> t.Snapshot:
        """The labels of all shapes as of one moment; ``events(since=snapshot.sequence)`` goes on."""
        reply, raw = await self._call("labels_snapshot")
        return wire.snapshot(reply, raw)

    async def original(self, name: str) -> t.Encoded:
        """The bytes of a shape as they were sent; of arrays, an OFF file with the same values."""
        reply, raw = await self._call("get_original", shape=name)
        return t.Encoded(wire.format_name(reply.format), raw.file(reply.bytes))

    async def publish(self, path: str | os.PathLike[str]) -> t.Published:
        """Writes everything that labels a new shape now to the file ``path``, for :func:`coseg.label`.

        The file is replaced when it is whole. Raises :class:`coseg.FailedPrecondition` (NOT_PUBLISHABLE)
        if the collection has too few labelled shapes, or shapes wait to be relabelled: :meth:`wait_idle`
        waits for them.
        """
        head = await self.bundle_head()
        target = Path(path)
        part = target.with_name(f"{target.name}.{os.getpid()}.part")
        try:
            with part.open("wb") as file:
                file.write(head.head)
                for wanted in head.files:
                    found = await self.array_file(wanted.shape, wanted.blake3)
                    if len(found) != wanted.length:
                        text = f"array file of {wanted.shape!r}: {len(found)} bytes, not {wanted.length}"
                        raise BadReply(text)
                    file.write(found)
                    file.write(bytes(-len(found) % BUNDLE_ALIGNMENT))
                file.flush()
                os.fsync(file.fileno())
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        return t.Published(head.bundle, head.sequence, head.epoch, head.n_bytes, head.clusters_next)

    async def bundle_head(self) -> t.BundleHead:
        """The beginning of the file that :meth:`publish` writes, and the array files that follow it."""
        reply, raw = await self._call("publish")
        files = tuple(wire.flat(t.BundleFile, file) for file in reply.files)
        return wire.flat(t.BundleHead, reply, head=raw.file(reply.head), files=files)

    async def array_file(self, name: str, blake3: str) -> bytes:
        """The array file of a shape, which must have this BLAKE3; docs/format.md describes it."""
        reply, raw = await self._call("get_array_file", shape=name, blake3=blake3)
        return raw.file(reply.bytes)

    async def remove(self, name: str) -> None:
        """Removes a shape."""
        await self._call("remove_shape", shape=name)

    async def portraits(self, names: Sequence[str], *, detail: str = "proxy", proposal: int = 0) -> bytes:
        """At most 256 shapes in the compact form that the viewer draws, which docs/viewer.md describes:
        ``"proxy"``, ``"surface"`` or ``"functions"``. With the number of a proposal, the proxy has its
        classes in place of the labels."""
        fields: dict[str, Any] = {"detail": wire.portrait_detail(detail), "proposal": proposal}
        reply, raw = await self._call("get_portraits", shapes=names, **fields)
        return raw.file(reply.pack)

    # -- analysis -------------------------------------------------------------------------------

    async def spectrum(
        self, name: str, *, eigenvectors: bool = False, resolution: t.Resolution = "input"
    ) -> t.Spectrum:
        """Eigenvalues and, if wanted, eigenvectors and mass: a row for each vertex of the mesh as it was
        sent. ``resolution`` is ``"input"``, ``"input_faces"`` (a row for each of its faces) or ``"proxy"``
        (for each vertex of the working mesh, where the eigenvectors are orthonormal; the others are
        interpolated, and NaN at vertices without a face)."""
        wanted = wire.resolution(resolution)
        reply, raw = await self._call(
            "get_spectrum", shape=name, eigenvectors=eigenvectors, resolution=wanted
        )
        if eigenvectors:
            wire.check_resolution(reply.resolution, resolution)
        return wire.spectrum(reply, raw)

    async def hks(self, name: str, *, resolution: t.Resolution = "input") -> t.Float32:
        """(n, t) heat kernel signature: a row for each vertex of the mesh as it was sent, or as
        ``resolution`` says: see :meth:`spectrum`."""
        reply, raw = await self._call("get_hks", shape=name, resolution=wire.resolution(resolution))
        wire.check_resolution(reply.resolution, resolution)
        hks: t.Float32 = raw.array(reply.hks)
        return hks

    async def descriptors(self, name: str) -> t.Descriptors:
        """The working mesh and what the segmentation is computed from."""
        reply, raw = await self._call("get_descriptors", shape=name)
        return wire.descriptors(reply, raw)

    async def map(
        self,
        source: str,
        target: str,
        *,
        agreement: bool = False,
        points: bool = False,
        landmarks: Iterable[tuple[int, int]] = (),
        orientation: str | None = None,
        k: int = 0,
        alternative: bool = False,
        resolution: t.Resolution = "input",
        landmark_resolution: t.LandmarkResolution | None = None,
    ) -> t.FunctionalMap:
        """The functional map that carries functions on ``source`` to functions on ``target``, and the
        pointwise map, which goes the other way: from the vertices of one mesh as it was sent to those of
        the other, or as ``resolution`` says (see :meth:`spectrum`). ``c_12`` is the same at each.

        By default it is the map by which labels are carried, which is kept; ``agreement`` says how it
        agrees with the other kept maps. With ``points``, or any option after it, it is made for points,
        now, in about 0.1 s, and its quality has the error to expect; ``landmarks`` are pairs of vertices
        that correspond, of the meshes as they were sent (with ``landmark_resolution="proxy"``, or with
        ``resolution="proxy"`` and no other word, of the working meshes), ``orientation`` is ``"keep"`` or
        ``"reverse"`` (without: the one that keeps it, unless that is much worse), ``k`` the size of
        ``c_12`` (without: 100), and ``alternative`` asks for the best map of the other orientation too.
        """
        # `from` is a word of the language.
        fields: dict[str, Any] = {"from": source, "to": target, "resolution": wire.resolution(resolution)}
        of = landmark_resolution or ("proxy" if resolution == "proxy" else "input")
        asked = _point_options(landmarks, orientation, k, alternative, of)
        if points or asked:
            fields["points"] = asked
        if agreement:
            fields["agreement"] = True
        reply, raw = await self._call("get_functional_map", **fields)
        wire.check_resolution(reply.resolution, resolution)
        return wire.functional_map(source, target, reply, raw)

    async def transfer(
        self,
        values: ArrayLike,
        source: str,
        target: str,
        *,
        landmarks: Iterable[tuple[int, int]] = (),
        orientation: str | None = None,
        k: int = 0,
        resolution: t.Resolution = "input_faces",
        landmark_resolution: t.LandmarkResolution | None = None,
    ) -> np.ndarray[Any, Any]:
        """Carries values at the faces of ``source`` to those of ``target``, by a map between points:
        integers ``(n,)`` are voted on, numbers ``(n, …)`` averaged. With ``resolution="input"`` values are
        at the vertices of the meshes as they were sent: integers are those of the vertex that corresponds,
        numbers are interpolated; with ``"proxy"`` at those of the working meshes. Other options are those
        of :meth:`map`."""
        options: dict[str, Any] = {"landmarks": landmarks, "orientation": orientation, "k": k}
        options |= {"resolution": resolution, "landmark_resolution": landmark_resolution}
        return (await self.transferred(values, source, target, **options)).values

    async def transferred(
        self,
        values: ArrayLike,
        source: str,
        target: str,
        *,
        landmarks: Iterable[tuple[int, int]] = (),
        orientation: str | None = None,
        k: int = 0,
        resolution: t.Resolution = "input_faces",
        landmark_resolution: t.LandmarkResolution | None = None,
    ) -> t.Transferred:
        """What :meth:`transfer` gives, with the quality of the map."""
        rows = wire.resolution(resolution)
        array, writer = np.asarray(values), FrameWriter()
        if array.ndim == 0 or array.size == 0 or array.dtype.kind not in "biuf":
            raise ValueError(
                f"values are {array.dtype}{array.shape}, expected numbers (n, …), a row for each"
                f" {t.ROWS[resolution]}"
            )
        if array.dtype.kind in "iu":
            ref = writer.array(_integers(array, np.int32, "values"))
        else:
            ref = writer.array(array.astype(np.float32).reshape(len(array), -1))
        fields: dict[str, Any] = {"from": source, "to": target, "values": ref}
        of = landmark_resolution or ("proxy" if resolution == "proxy" else "input")
        fields["points"] = asked = _point_options(landmarks, orientation, k, False, of)
        fields["resolution"] = rows
        reply, raw = await self._call("transfer_function", writer.frames, **fields)
        # A daemon that is too old takes landmarks for vertices of the working meshes.
        wire.check_resolution(
            reply.resolution, resolution, unset=None if "landmarks" in asked else "input_faces"
        )
        carried: np.ndarray[Any, Any] = raw.array(reply.values)
        return t.Transferred(carried.reshape(-1, *array.shape[1:]), wire.map_quality(reply.quality))

    async def match_parts(self, a: str, b: str) -> t.PartMatches:
        """Which part of ``a`` matches which part of ``b``."""
        reply, _ = await self._call("get_part_correspondence", shape_a=a, shape_b=b)
        return wire.part_matches(reply)

    async def nearest(self, name: str, limit: int = 5) -> list[t.Neighbor]:
        """The shapes most like one shape, nearest first."""
        reply, _ = await self._call("nearest", shape=name, limit=limit)
        return [wire.flat(t.Neighbor, n) for n in reply.neighbors]

    # -- a person's corrections -----------------------------------------------------------------

    async def correct(
        self,
        name: str,
        labels: ArrayLike | None = None,
        *,
        faces: ArrayLike | None = None,
        part: int | None = None,
        label: int | str | None = None,
        closed: bool | None = None,
    ) -> t.Corrected:
        """Labels faces of a shape by hand: ``labels`` for all of them (−1 leaves one alone), or one
        ``label`` (id or name) for some ``faces`` or one ``part``. They never change again by themselves;
        other shapes follow in the background: :meth:`wait_idle`. With ``closed=True`` there are no labels
        but those that persons used; with ``False`` discovered labels that no labelled shape shows are
        labels too; ``None`` leaves that as it is."""
        writer = FrameWriter()
        fields: dict[str, Any]
        if labels is not None and faces is None and part is None and label is None:
            fields = {"labels": writer.array(_integers(labels, np.int32, "labels"))}
        elif label is not None and faces is not None and labels is None and part is None:
            ref = writer.array(_integers(faces, np.uint32, "faces"))
            fields = {"faces": {"faces": ref, "label": await self._label(label)}}
        elif label is not None and part is not None and labels is None and faces is None:
            fields = {"part": {"part": part, "label": await self._label(label)}}
        else:
            raise ValueError("give labels, or faces and label, or part and label")
        if closed is not None:
            fields["closed"] = closed
        reply, _ = await self._call("correct_labels", writer.frames, shape=name, **fields)
        return wire.flat(t.Corrected, reply)

    async def name_label(self, label: int | str, name: str) -> t.Label:
        """Gives a label, named by its id or the name it has, a name."""
        reply, _ = await self._call("name_label", label=await self._label(label), name=name)
        return wire.label(reply.label)

    async def merge(self, label: int | str, into: int | str) -> t.ChangedLabel:
        """Makes one label of two: faces of ``label`` carry ``into`` from now on. Both by id or name."""
        label, into = await self._label(label), await self._label(into)
        reply, _ = await self._call("merge_labels", label=label, into=into)
        return wire.changed_label(reply)

    async def split(self, label: int | str) -> t.ChangedLabel:
        """Makes two labels of one, by id or name, and returns the new one."""
        reply, _ = await self._call("split_label", label=await self._label(label))
        return wire.changed_label(reply)

    async def _label(self, label: int | str) -> int:
        """The id of a label; text that is all digits is one, other text the name of a label in use."""
        if not isinstance(label, str):
            return int(label)
        if label.isascii() and label.isdigit():
            return int(label)
        in_use = [known for known in (await self.info()).labels if known.merged_into is None]
        found = [known.id for known in in_use if label and known.name == label]
        if len(found) != 1:
            ids = ", ".join(map(str, found))
            text = f"{len(found)} labels are named {label!r}, say which by its id: {ids}"
            raise ValueError(text if found else f"no label of {self.name!r} is named {label!r}")
        return found[0]

    async def undo(self) -> t.Undone:
        """Takes back the newest correction, name, merge, split, link, change of the up axis or choice."""
        reply, _ = await self._call("undo")
        return wire.flat(t.Undone, reply)

    async def ask(self, *, passed: bool = False) -> t.Question | None:
        """The part whose label is worth most to ask a person for, or ``None`` if there is none; with
        ``passed`` also among those that were passed over."""
        try:
            reply, raw = await self._call("next_question", passed=passed)
        except Refused as e:
            if e.reason == "NOTHING_TO_ASK":
                return None
            raise
        return wire.question(reply, raw)

    async def answer(
        self,
        name: str,
        part: int,
        label: int | str | None = None,
        *,
        new: str | None = None,
        skip: bool = False,
        cut_wrongly: bool = False,
        by: str = "",
    ) -> t.Answered:
        """Answers a question: the part has a ``label`` (id or name), or one of the ``new`` name, or it
        is passed over, because it is skipped or cut wrongly."""
        given: dict[str, Any] = {}
        if label is not None:
            given["label"] = await self._label(label)
        if new is not None:
            given["named"] = new
        if skip:
            given["skip"] = True
        if cut_wrongly:
            given["cut_wrongly"] = True
        if len(given) != 1:
            raise ValueError("give one of label, new, skip and cut_wrongly")
        reply, _ = await self._call("answer_question", shape=name, part=part, by=by, **given)
        return wire.answered(reply)

    async def approve(self, name: str, *, doubtful: bool = False, by: str = "") -> t.Corrected | None:
        """Takes all present labels of a shape as a person's; ``doubtful`` only notes that something is
        wrong with them."""
        state = wire.review_state("doubtful" if doubtful else "approved")
        reply, _ = await self._call("review_shape", shape=name, state=state, by=by)
        return wire.flat(t.Corrected, reply.corrected) if reply.HasField("corrected") else None

    async def same(self, a: tuple[str, int], b: tuple[str, int], *, by: str = "") -> t.Linked:
        """Demands that two parts, each a shape and the number of its part, have the same label."""
        return await self._link("same", a, b, by)

    async def differ(self, a: tuple[str, int], b: tuple[str, int], *, by: str = "") -> t.Linked:
        """Demands that two parts, each a shape and the number of its part, have different labels."""
        return await self._link("differ", a, b, by)

    async def _link(self, kind: str, a: tuple[str, int], b: tuple[str, int], by: str) -> t.Linked:
        one, other = wire.part_of_shape(a), wire.part_of_shape(b)
        reply, _ = await self._call("link_parts", kind=wire.link_kind(kind), a=one, b=other, by=by)
        return wire.linked(reply)

    async def unlink(self, id: int) -> t.Unlinked:
        """Removes the link with this id."""
        reply, _ = await self._call("unlink_parts", id=id)
        return wire.flat(t.Unlinked, reply, link=wire.link(reply.link))

    async def links(self, shape: str = "") -> list[t.Link]:
        """Links between parts, the oldest first; with ``shape`` only those of its parts."""
        reply, _ = await self._call("list_links", shape=shape)
        return [wire.link(link) for link in reply.links]

    async def suggest(self) -> t.Suggestion | None:
        """The shape whose labelling by a person would help most, or ``None`` if there is none."""
        try:
            reply, _ = await self._call("suggest_next")
        except Refused as e:
            if e.reason == "NOTHING_TO_SUGGEST":
                return None
            raise
        return wire.flat(t.Suggestion, reply)

    async def proposals(self) -> t.Proposals:
        """Divisions of the shapes into labels, from coarse to fine, of which :meth:`choose` makes one
        the labels. They are made in the background: ``n_steps`` is 0 once they are those for the
        present labels."""
        reply, _ = await self._call("list_proposals")
        return wire.proposals(reply)

    async def proposed_labels(self, n: int) -> dict[str, t.Int32]:
        """The class of each face of each shape in proposal ``n``, by the names of the shapes that it
        divides, at most 40. Classes become label ids when it is chosen."""
        reply, raw = await self._call("get_proposal", n=n)
        return {found.shape: raw.array(found.labels) for found in reply.shapes}

    async def choose(self, n: int, *, set: str = "") -> t.Chosen:
        """Makes proposal ``n`` the labels; all shapes follow, and :meth:`undo` restores the labels
        before. ``set``, if given, must be that of the present proposals."""
        reply, _ = await self._call("choose_proposal", n=n, set=set)
        return wire.flat(t.Chosen, reply)

    # -- events ---------------------------------------------------------------------------------

    async def events_since(self, sequence: int, *, limit: int = 0) -> list[t.Event]:
        """Events of the log after ``sequence``, in order: all, or at most ``limit``."""
        found: list[t.Event] = []
        while True:
            # A page at a time; 0 is the most that the daemon gives.
            page = min(limit - len(found), 1_000) if limit else 0
            reply, _ = await self._call("events_since", sequence=sequence, limit=page)
            found += map(wire.event, reply.events)
            if not reply.more or (limit and len(found) >= limit):
                return found
            sequence = found[-1].sequence

    async def events(
        self, since: int | None = None, *, patience: float | None = None
    ) -> AsyncIterator[t.Event]:
        """Events in order, each once and none left out: those after ``since`` (by default those from
        now on), then as they happen, without end.

        What the event socket drops, for a slow reader or while it was not connected, is read from the
        log. A daemon that is restarted is waited for, at most ``patience`` seconds (``None``: for ever);
        then :class:`coseg.NoAnswer` is raised.
        """
        seen = since if since is not None else (await self.info()).sequence
        while True:
            hello = await self._patiently(patience)
            endpoint = reachable(hello.event_endpoint, self.library.endpoint)
            topics = [self.name.encode() + b"\0", HEARTBEAT_TOPIC]
            async with self.library._transport.subscribe(endpoint, topics) as subscription:
                async for event in self._follow(subscription, seen):
                    seen = event.sequence
                    yield event

    async def _follow(self, subscription: AsyncSubscription, seen: int) -> AsyncIterator[t.Event]:
        """Events after ``seen`` until the subscription falls silent."""
        newest: int | None = None
        while True:
            if newest is None or newest > seen:
                # The log has what came before the subscription, and what it dropped.
                try:
                    missed = await self.events_since(seen)
                except NoAnswer:
                    return
                for event in missed:
                    seen = event.sequence
                    yield event
            body = await subscription.receive(SILENCE_S)
            if body is None:
                return
            message = event_pb2.Event.FromString(body)
            if message.HasField("heartbeat"):
                logs = {c.collection: c.sequence for c in message.heartbeat.collections}
                newest = logs.get(self.name, seen)
                if newest < seen:
                    text = f"the log of {self.name!r} ends with event {newest}, but event {seen} was seen"
                    raise EventLogRewound(text)
            elif message.sequence == seen + 1:
                seen = newest = message.sequence
                yield wire.event(message)
            else:
                newest = max(newest or 0, message.sequence)

    async def _patiently(self, patience: float | None) -> t.Hello:
        """Hello of a daemon that may be away."""
        waited = 0.0
        while True:
            try:
                return await self.library.hello()
            except NoAnswer:
                waited += self.library._transport.timeout
                if patience is not None and waited >= patience:
                    raise


def _point_options(
    landmarks: Iterable[tuple[int, int]],
    orientation: str | None,
    k: int,
    alternative: bool,
    landmark_resolution: t.LandmarkResolution,
) -> dict[str, Any]:
    """What is asked of a map between points; nothing if all is as usual."""
    pairs = [{"from": int(source), "to": int(target)} for source, target in landmarks]
    asked = {
        "landmarks": pairs,
        "orientation": wire.orientation(orientation),
        "k": k,
        "alternative": alternative,
        "landmark_resolution": wire.landmark_resolution(landmark_resolution) if pairs else 0,
    }
    return {name: value for name, value in asked.items() if value}


def _integers(values: ArrayLike, dtype: type[np.generic], what: str) -> np.ndarray[Any, Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise ValueError(f"{what} are {array.dtype}{array.shape}, expected integers (n,)")
    bounds = np.iinfo(dtype)  # type: ignore[type-var]
    if array.size and not bounds.min <= int(array.min()) <= int(array.max()) <= bounds.max:
        raise ValueError(f"{what} go from {array.min()} to {array.max()}, beyond {np.dtype(dtype)}")
    return array.astype(dtype)


def _assign(message: Any, name: str, value: Any) -> None:
    # Keyword arguments cannot be names of the language, and assignment does not take messages.
    message.MergeFrom(type(message)(**{name: value}))
