"""How fast shapes go in and labels come out, through the client and through the raw socket.

``python clients/python/bench/throughput.py BINARY`` starts a daemon on a temporary library. It measures the
way there and back: shapes that are there already (`unchanged`), so that labelling does not hide it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zmq

import coseg
from coseg.v1 import job_pb2, message_pb2, shape_pb2

N_SHAPES = 40
N_REPEATS = 25


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def best(work: Callable[[], object], n: int = 3) -> float:
    return min(timed(work) for _ in range(n))


class RawSocket:
    """The least that works."""

    def __init__(self, endpoint: str) -> None:
        self.socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        self.socket.connect(endpoint)
        self.n = 0

    def call(self, request: message_pb2.Request, *frames: bytes) -> list[bytes]:
        self.n += 1
        request.request_id, request.client_id = str(self.n), "raw-bench"
        self.socket.send_multipart([request.SerializeToString(), *frames], copy=False)
        reply = self.socket.recv_multipart()
        assert not message_pb2.Reply.FromString(reply[0]).HasField("error")
        return reply

    def add(self, name: str, *files: tuple[str, bytes]) -> None:
        request = message_pb2.Request()
        request.add_shapes.collection, request.add_shapes.mode = name, job_pb2.ADD_MODE_WAIT
        for i, (shape, _) in enumerate(files):
            encoded = job_pb2.EncodedMesh(format=job_pb2.MESH_FORMAT_OFF)
            encoded.bytes.frame = i
            request.add_shapes.shapes.append(job_pb2.ShapeInput(name=shape, encoded=encoded))
        self.call(request, *(data for _, data in files))

    def labels(self, collection: str, shape: str) -> np.ndarray[tuple[int], np.dtype[np.int32]]:
        get = shape_pb2.GetLabelsRequest(collection=collection, shape=shape)
        header, *raw = self.call(message_pb2.Request(get_labels=get))
        frame = message_pb2.Reply.FromString(header).get_labels.labels.frame
        return np.frombuffer(raw[frame], np.int32)


def large(n_bytes: int) -> tuple[str, bytes]:
    """A corrugated sheet whose OFF file has about that many bytes."""
    n = int((n_bytes / 72) ** 0.5)
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    z = np.sin(x / 40) * np.cos(y / 55) * n / 8
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)[None]).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + n], 1), np.stack([corner + 1, corner + n + 1, corner + n], 1)]
    )
    lines = [f"OFF\n{n * n} {len(faces)} 0"]
    lines += [f"{a} {b} {c:.3f}" for a, b, c in zip(x.ravel(), y.ravel(), z.ravel(), strict=True)]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return "large", "\n".join(lines).encode()


def main() -> None:
    """Prints one JSON object."""
    binary = str(Path(sys.argv[1]).resolve())
    env = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")}
    env |= {"COSEG__LIMITS__MEMORY": "8GiB", "COSEG__LIMITS__MAX_MESSAGE": "512MiB"}
    env |= {"COSEG__LIMITS__MAX_BYTES_PER_CLIENT": "1GiB"}
    env |= {"COSEG__LIMITS__MAX_SHAPE": "256MiB", "COSEG__LOG__LEVEL": "error"}
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="coseg") as folder:
        subprocess.run(
            [binary, "synth", "chair", "--count", str(N_SHAPES), "--faces", "2000", "--out", f"{folder}/m"],
            check=True,
            env=env,
            capture_output=True,
        )
        endpoint = f"ipc://{folder}/s"
        command = [binary, "serve", "--library", f"{folder}/library", "--endpoint", endpoint]
        daemon = subprocess.Popen(command, env=env)
        try:
            with coseg.Library(endpoint) as lib:
                collection = lib.collection("chairs", parts=4, up="+y")
                paths = sorted(Path(folder, "m").glob("*.off"))
                begin = time.perf_counter()
                assert all(a.ok for a in collection.add_many(paths))
                figures["new shapes/s (described, placed)"] = N_SHAPES / (time.perf_counter() - begin)
                collection.wait_idle()
                files = [(p.stem, p.read_bytes()) for p in paths]
                items = [(name, coseg.Encoded("off", data)) for name, data in files]
                raw = RawSocket(endpoint)
                batches = [files[i : i + 16] for i in range(0, len(files), 16)]
                seconds = best(lambda: list(collection.add_many(items)))
                figures["client: known shapes/s"] = N_SHAPES / seconds

                def raw_known() -> None:
                    for batch in batches:
                        raw.add("chairs", *batch)

                seconds = best(raw_known)
                figures["raw: known shapes/s"] = N_SHAPES / seconds
                names = [name for name, _ in files] * N_REPEATS
                n_labels = sum(len(collection.labels(n)) for n in names)
                seconds = best(lambda: [collection.labels(n) for n in names])
                figures["client: label arrays/s"] = len(names) / seconds
                figures["client: labels/s"] = n_labels / seconds
                seconds = best(lambda: [raw.labels("chairs", n) for n in names])
                figures["raw: label arrays/s"] = len(names) / seconds
                figures["raw: labels/s"] = n_labels / seconds
                a, b = paths[0].stem, paths[1].stem
                lib.map(a, b)
                figures["client: a functional map, ms"] = best(lambda: lib.map(b, a, "chairs"), 5) * 1000
                name, data = large(100_000_000)
                figures["large file, MB"] = len(data) / 1e6
                one = lib.collection("large")
                figures["client: large file handed over, s"] = timed(
                    lambda: one.submit([(name, coseg.Encoded("off", data))])
                )
                begin = time.perf_counter()
                one.wait_idle()
                figures["daemon: large file labelled, s"] = time.perf_counter() - begin
                figures["client: large file again, s"] = timed(
                    lambda: one.add(name, coseg.Encoded("off", data))
                )

                def raw_again() -> None:
                    raw.add("large", (name, data))

                figures["raw: large file again, s"] = timed(raw_again)
                labels = one.labels(name)
                figures["large file, faces"] = len(labels)
                figures["client: its labels, ms"] = best(lambda: one.labels(name)) * 1000
                figures["raw: its labels, ms"] = best(lambda: raw.labels("large", name)) * 1000
        finally:
            daemon.kill()
            daemon.wait()
    print(json.dumps({k: round(v, 3) for k, v in figures.items()}, indent=1))


if __name__ == "__main__":
    main()
