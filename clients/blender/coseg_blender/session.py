"""The connection to a daemon. Its work runs in a thread; results are taken up in Blender's own, by a timer.

Nothing of ``bpy`` may be touched outside Blender's thread, so work gets plain values and returns them.
"""

from __future__ import annotations

import os
import queue
import shutil
import stat
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import IO, Any

import bpy

import coseg
from coseg.types import Question

#: Seconds between looks at work that is under way.
INTERVAL = 0.1
#: Seconds between steps of Blender's own work, in which it draws and takes input, and of such steps.
PAUSE, SLICE = 0.01, 0.05
#: Seconds that a daemon may take to start.
STARTUP = 30.0
#: Seconds that Blender waits at its end for work that is under way.
PATIENCE = 2.0


class Worker:
    """A thread that does one thing after the other. Blender's end does not wait for it."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="coseg", daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], Any]) -> Future[Any]:
        """Does ``work`` after what was submitted before."""
        future: Future[Any] = Future()
        self._queue.put((work, future))
        return future

    def _run(self) -> None:
        while not self._is_over.is_set():
            work, future = self._queue.get()
            try:
                future.set_result(work())
            except Exception as e:
                future.set_exception(e)

    def end(self) -> bool:
        """Ends the thread after what it does now; whether it has ended."""
        self._is_over.set()
        self._queue.put((lambda: None, Future()))
        self._thread.join(PATIENCE)
        return not self._thread.is_alive()


class Session:
    """One daemon, and what is asked of it, one thing after the other."""

    def __init__(self) -> None:
        # A bound method is another object each time, by which a timer would not be found again.
        self._timer = self._tick
        #: Libraries with a request under way, which may not be closed.
        self._abandoned: list[coseg.Library] = []
        self._reset()

    def _reset(self) -> None:
        self.library: coseg.Library | None = None
        #: What goes on, and what went wrong last, for the panel.
        self.doing = ""
        #: How far it is, such as "3 of 20"; set by the thread.
        self.progress = ""
        self.error = ""
        self.message = ""
        #: The question that was asked last, until it is answered.
        self.question: Question | None = None
        #: Labels of the collection, for menus.
        self.labels: list[coseg.Label] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._worker: Worker | None = None
        self._waiting: list[tuple[str, Future[Any], Callable[[Any], Iterator[str] | None]]] = []
        #: What is left to do with the first result, if that is done in steps.
        self._steps: Iterator[str] | None = None

    def submit(
        self, doing: str, work: Callable[[], Any], done: Callable[[Any], Iterator[str] | None]
    ) -> None:
        """Does ``work`` in the thread, then ``done`` with its result in Blender's. An iterator that this
        returns is taken step by step, with time for Blender between them; it yields how far it is."""
        if self._worker is None:
            self._worker = Worker()
        self.error = self.message = ""
        self._waiting.append((doing, self._worker.submit(work), done))
        self.doing = self.doing or doing
        if not bpy.app.timers.is_registered(self._timer):
            # Persistent: it goes on when another file is opened.
            bpy.app.timers.register(self._timer, first_interval=INTERVAL, persistent=True)

    def _tick(self) -> float | None:
        self.pump()
        if not self._waiting:
            return None
        return INTERVAL if self._steps is None else PAUSE

    def pump(self) -> bool:
        """Takes up what has finished; whether anything is still under way."""
        end = time.monotonic() + SLICE
        while self._waiting and self._waiting[0][1].done() and time.monotonic() < end:
            try:
                if self._step():
                    continue
            except Exception as e:  # An error of any kind is shown, and what comes next goes on.
                self.error = str(e) or type(e).__name__
            self._waiting.pop(0)
            self._steps, self.progress = None, ""
            if bpy.ops.ed.undo_push.poll():
                # Otherwise the next undo would take labels away together with what a person did.
                bpy.ops.ed.undo_push(message="coseg")
        self.doing = self._waiting[0][0] if self._waiting else ""
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()
        return bool(self._waiting)

    def _step(self) -> bool:
        """Takes up the first result, or a step of that; whether there are more steps."""
        if self._steps is None:
            _, future, done = self._waiting[0]
            self._steps = done(future.result())
        if self._steps is None:
            return False
        self.progress = next(self._steps, "")
        return self.progress != ""

    def connect(self, endpoint: str, folder: str) -> None:
        """Connects to the daemon at ``endpoint``, or starts one with its library in ``folder``. Runs in the
        thread."""
        endpoint = endpoint or coseg.default_endpoint()
        if self.library is not None:
            self.library.close()
            self.library = None
        library = coseg.Library(endpoint, timeout=1)
        try:
            library.hello()
        except coseg.NoAnswer:
            library.close()
            self._start(endpoint, folder)
            library = coseg.Library(endpoint, timeout=STARTUP)
            library.hello()
        self.library = library

    def _start(self, endpoint: str, folder: str) -> None:
        binary = daemon_binary()
        if binary is None:
            raise coseg.CosegError(
                f"no daemon answers at {endpoint}, and there is no coseg program to start one: put it on the "
                "PATH, or name the endpoint of a daemon"
            )
        Path(folder).mkdir(parents=True, exist_ok=True)
        command = [str(binary), "serve", "--library", folder, "--endpoint", endpoint, "--log-level", "error"]
        # A file, since nobody would read a pipe.
        with tempfile.TemporaryFile() as log:
            self._process = subprocess.Popen(command, stderr=log, stdin=subprocess.DEVNULL)
            self._wait(self._process, endpoint, log)

    def _wait(self, process: subprocess.Popen[bytes], endpoint: str, log: IO[bytes]) -> None:
        """Waits until a daemon answers."""
        end = time.monotonic() + STARTUP
        while time.monotonic() < end:
            if process.poll() is not None:
                log.seek(0)
                text = log.read().decode(errors="replace").strip()
                raise coseg.CosegError(f"the daemon did not start: {text}")
            with coseg.Library(endpoint, timeout=1) as library:
                try:
                    library.hello()
                    return
                except coseg.NoAnswer:
                    pass
        raise coseg.CosegError(f"the daemon did not answer within {STARTUP:.0f} s")

    def collection(self, name: str, parts: int = 0) -> coseg.Collection:
        """The collection of that name, upright as Blender has it if it is new. Runs in the thread."""
        if self.library is None:
            raise coseg.CosegError("connect to a daemon first")
        try:
            self.library.collection(name).info()
            return self.library.collection(name)
        except coseg.NotFound:
            return self.library.collection(name, parts=parts or None, up="+z")

    def close(self) -> None:
        """Ends the connection, and the daemon if it was started here."""
        if bpy.app.timers.is_registered(self._timer):
            bpy.app.timers.unregister(self._timer)
        if self._process is not None and self._process.poll() is None:
            # What is accepted is durable, and goes on with the next start.
            self._process.terminate()
        is_at_rest = self._worker is None or self._worker.end()
        if self.library is not None:
            if is_at_rest:
                self.library.close()
            else:
                self._abandoned.append(self.library)
        if self._process is not None:
            self._process.wait(timeout=STARTUP)
        self._reset()


def daemon_binary() -> Path | None:
    """The program that comes with the extension, or the one on the path."""
    bundled = Path(__file__).parent / "bin" / "coseg"
    if bundled.is_file():
        # Archives are unpacked without permissions.
        if not os.access(bundled, os.X_OK):
            bundled.chmod(bundled.stat().st_mode | stat.S_IXUSR)
        return bundled
    found = os.environ.get("COSEG_BIN") or shutil.which("coseg")
    return Path(found) if found else None


current = Session()
