#!/usr/bin/env python3
"""Times what a person waits for, from the request to durable labels, through a real daemon.

    cargo build --release
    python3 benches/latency.py [--only NAME ...] [COSEG ...]

COSEG is the program to measure (target/release/coseg); with several, each is measured in turn, so that
two versions can be compared in one run. Meshes are made by `coseg synth`. The machine must be idle.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import statistics
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

FACES = "1000"


class Daemon:
    """A daemon with a library of its own, and the commands that talk to it."""

    def __init__(self, coseg: str, folder: Path) -> None:
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.port: int = s.getsockname()[1]
        self.coseg = coseg
        self.folder = folder
        self.env = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")}
        self.env |= {"COSEG_ENDPOINT": f"ipc://{folder}/socket", "NO_COLOR": "1"}
        serve = [coseg, "serve", "--library", str(folder / "library"), "--http", f"127.0.0.1:{self.port}"]
        self.process = subprocess.Popen(serve, env=self.env, stderr=subprocess.DEVNULL)
        end = time.monotonic() + 30
        while subprocess.run([coseg, "ls"], env=self.env, capture_output=True, check=False).returncode != 0:
            if time.monotonic() > end:
                raise SystemExit("the daemon does not answer")

    def run(self, *words: str) -> tuple[float, str]:
        """Seconds that a command takes, and what it prints."""
        start = time.monotonic()
        done = subprocess.run([self.coseg, *words], env=self.env, check=True, capture_output=True, text=True)
        return time.monotonic() - start, done.stdout

    def made(self, family: str, count: int) -> list[Path]:
        """New meshes, each with its labels beside it."""
        out = self.folder / family
        self.run("synth", family, "--count", str(count), "--faces", FACES, "--out", str(out))
        return sorted(out.glob("*.off"))

    def add(self, files: list[Path], collection: str, *words: str) -> float:
        return self.run("add", *map(str, files), "--collection", collection, "--timeout", "3600", *words)[0]

    def correct(self, file: Path, collection: str) -> tuple[float, float]:
        """Milliseconds until the labels of the shape itself, and those of all shapes, are durable."""
        words = ["correct", file.stem, str(file.with_suffix(".labels.txt")), "--collection", collection]
        said = json.loads(self.run(*words, "--timeout", "3600", "--json")[1].strip().splitlines()[-1])
        return said["first_ms"], said["all_ms"]

    def stage(self, name: str) -> tuple[float, float]:
        """Seconds of all shapes in a stage, and their number."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/metrics") as answer:
            text: str = answer.read().decode()
        of = re.compile(rf'coseg_stage_duration_seconds_(sum|count)\{{stage="{name}"\}} (\S+)')
        found = {kind: float(value) for kind, value in of.findall(text)}
        return found.get("sum", 0.0), found.get("count", 0.0)


def place_and_correct(daemon: Daemon) -> None:
    files = daemon.made("chair", 100)
    daemon.add(files[:50], "chairs", "--parts", "4")
    before = daemon.stage("place")
    daemon.add(files[50:], "chairs")
    after = daemon.stage("place")
    mean = (after[0] - before[0]) / (after[1] - before[1])
    print(f"  place, mean of shapes 51-100: {1000 * mean:.0f} ms")
    for nth, file in (("first", files[3]), ("second", files[17])):
        first, everything = daemon.correct(file, "chairs")
        print(f"  correct, {nth} time: the shape {first:.0f} ms, all of 100 {everything / 1000:.2f} s")


def many(daemon: Daemon) -> None:
    files = daemon.made("chair", 3000)
    daemon.add(files, "chairs", "--parts", "4", "--working-faces", "200")
    for nth, file in (("first", files[3]), ("second", files[17])):
        first, everything = daemon.correct(file, "chairs")
        print(f"  correct, {nth} time: the shape {first:.0f} ms, all of 3,000 {everything / 1000:.1f} s")


def recluster(daemon: Daemon) -> None:
    for family, count, parts in (("chair", 40, 3), ("animal", 20, 11)):
        before = daemon.stage("recluster")[0]
        seconds = daemon.add(daemon.made(family, count), family, "--parts", str(parts))
        clustering = daemon.stage("recluster")[0] - before
        print(f"  stream of {count}, k = {parts}: {seconds:.1f} s, re-clusterings {clustering:.1f} s of it")


def during_import(daemon: Daemon) -> None:
    files = daemon.made("chair", 40)
    daemon.add(files, "chairs", "--parts", "4")
    imported = [str(f) for f in daemon.made("bird", 400)]
    words = [daemon.coseg, "add", *imported, "--collection", "birds", "--parts", "3", "--timeout", "3600"]
    running = subprocess.Popen(words, env=daemon.env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    waits = []
    for file in files[:24:3]:
        time.sleep(2)
        waits.append(daemon.correct(file, "chairs"))
    if running.poll() is not None:
        raise SystemExit("the import ended before the corrections did")
    running.kill()
    running.wait()
    firsts, alls = zip(*waits, strict=True)
    print(
        f"  correct during an import: the shape {statistics.median(firsts):.0f} ms, at most {max(firsts):.0f}; "
        f"all of 40 {statistics.median(alls) / 1000:.2f} s, at most {max(alls) / 1000:.2f}"
    )


MEASUREMENTS = {
    "place_and_correct": place_and_correct,
    "recluster": recluster,
    "during_import": during_import,
    "many": many,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("coseg", nargs="*", default=["target/release/coseg"])
    parser.add_argument("--only", action="append", choices=MEASUREMENTS, metavar="NAME", help=", ".join(MEASUREMENTS))
    chosen = parser.parse_args()
    for name in chosen.only or MEASUREMENTS:
        for coseg in chosen.coseg:
            print(f"{name}, {coseg}", flush=True)
            with tempfile.TemporaryDirectory(prefix="latency") as folder:
                daemon = Daemon(str(Path(coseg).resolve()), Path(folder))
                try:
                    MEASUREMENTS[name](daemon)
                finally:
                    daemon.process.terminate()
                    daemon.process.wait()


if __name__ == "__main__":
    main()
