"""Types what the documents say to type, top to bottom, against a real daemon, and fails where a command does.

    python3 tests/docs/run.py COSEG [DOCUMENT...]

Every document gets a home of its own with six chairs in `meshes`, and labels of one in `labels.txt`; but the README's is
empty, as its reader's is: there every file, shape and daemon comes from a command further up. Commands are the lines of
`sh` blocks, and of blocks indented by four spaces. `coseg serve` is put in the background and replaces the daemon that ran
before, which in the README must have been stopped. What is not typed as it stands is in the tables below, each with a reason; an entry that
nothing needs any more is a failure too. Python and TypeScript of the documents that clients/check.sh does not run
as programs are run here, if this Python has the client.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

#: Not typed here: a pattern that the whole command matches, and why, or what types it.
EXCEPTIONS = {
    r"cargo install --path \. .*": "builds for minutes; tests/stranger/run.sh --install types it",
    r"cargo (build|test|run) .*": "is what .ci/run does before this; `coseg demo` is typed as it is installed",
    r"cargo install cargo-deb .*|packaging/build\.sh": "tests/package/run.sh types it",
    r"pip install './clients/python\[usd\]'|coseg usd .*": "needs OpenUSD; clients/python/tests/test_usd.py types it",
    r"python3 clients/blender/build\.py .*": "fetches wheels; clients/blender/check.sh types it",
    r"packaging/container\.sh .*": "tests/package/container.sh runs it",
    r"sudo .*": "changes this machine; tests/package/run.sh does the same in a Debian of its own",
    r"pip install \./clients/python|npm ci && .*": "clients/check.sh types it",
    r"python tests/golden/record\.py .*": "would rewrite the recorded conversations, which tests/it/golden.rs replays",
    r"python3 -m venv venv && .*scikit-sparse.*": "builds SuiteSparse's wrapper for minutes, for the next lines only",
    r"venv/bin/python comparisons/spectrum\.py .*": "measures for an hour",
    r"perf .*": "needs the kernel's leave to sample",
    r"coseg describe million\.off .*": "takes a minute and 3.6 GB; so does the mesh of the line before",
    r"python3 -c .*meshes\.bumpy\(1_000_000\).*": "makes the mesh of the next line, with numpy",
}
#: Typed otherwise: what is replaced, by what, and why. `{free}` is a free port.
INSTEAD = {
    "127.0.0.1:8640": ("127.0.0.1:{viewer}", "the port may be taken on this machine"),
    "tcp://0.0.0.0:7421": ("tcp://0.0.0.0:{daemon}", "the port may be taken on this machine"),
    "tcp://host:7421": ("tcp://127.0.0.1:{daemon}", "`host` stands for the reader's"),
    "--data DIR [--category NAME] [--orders 3] [--exemplars 0,1,3,5] [--up +y] [--estimate]": (
        "--data benchmark --orders 1 --up +y --estimate --no-baselines",
        "a synopsis; on four made chairs",
    ),
    "--faces 1000000": ("--faces 100000", "a tenth of the faces, in a tenth of the time"),
}
#: Refused, and that is right: the command, what it must answer, and why.
REFUSED = {
    "coseg retry 7": ('no job named "7"', "no shape of a seventh job has failed here; tests/it/daemon/isolation.rs retries one that did"),
}
#: Go on for ever; they must live for two seconds, and end on an interrupt.
ENDLESS = ("coseg top", "coseg watch")
#: Read from the top by somebody who has nothing yet.
FROM_NOTHING = ("README.md",)
#: Typed before a document that goes on where another one left off.
BEFORE = {
    document: "coseg add meshes --collection chairs --parts 4 --up +y"
    for document in ("docs/formats.md", "docs/viewer.md")
}
#: Who runs the Python and TypeScript of a document as it stands.
PROGRAMS = {"python": "clients/python/tests/test_examples.py", "ts": "clients/typescript/test/snippets.ts"}
#: Python that is run here, with what it is given: arguments, and names it takes as known.
HERE = {"docs/protocol.md": "python", "docs/format.md": "python"}
COMMAND = re.compile(r"(sudo|coseg|coseg-bench|cargo|pip|npm|python3?|venv/\S+|perf|packaging/\S+|tests/\S+|clients/\S+|export) ")


def blocks(text: str) -> list[tuple[str, int, list[str]]]:
    """Fenced blocks with their language, and indented ones as `sh`, each with the line it begins at."""
    found, language, lines, begin, before = [], None, [], 0, ""
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("```"):
            if language is None:
                language, lines, begin = line[3:].strip(), [], number + 1
            else:
                found.append((language, begin, lines))
                language = None
        elif language is not None:
            lines.append(line)
        elif line.startswith("    ") and (before == "" or before == "indented"):
            if before != "indented":
                found.append(("sh", number, []))
            found[-1][2].append(line[4:])
            before = "indented"
            continue
        before = line.strip()
    return found


def commands(first: int, lines: list[str]) -> list[tuple[int, str]]:
    """One for each command, which may go over several lines while a quotation is open."""
    found: list[tuple[int, str]] = []
    whole, begin = "", first
    for number, line in enumerate(lines, first):
        # A comment begins at a # after a space.
        line = re.sub(r"\s+#\s.*$", "", line)
        begin = begin if whole else number
        whole = f"{whole}\n{line}" if whole else line
        if whole.count("'") % 2 or whole.endswith("\\"):
            continue
        typed, whole = whole.strip(), ""
        if typed and not typed.startswith("#"):
            found.append((begin, typed))
    return found


def free_ports(n: int) -> list[int]:
    """Ports whose successors are free as well, for events."""
    ports: list[int] = []
    while len(ports) < n:
        with socket.socket() as one, socket.socket() as next_one:
            one.bind(("127.0.0.1", 0))
            port = one.getsockname()[1]
            try:
                next_one.bind(("127.0.0.1", port + 1))
            except (OSError, OverflowError):
                continue
            if all(abs(port - other) > 1 for other in ports):
                ports.append(port)
    return ports


class World:
    """A home, and the daemon in it."""

    def __init__(self, coseg: Path, meshes: Path | None) -> None:
        self.home = Path(tempfile.mkdtemp(prefix="docs"))
        #: Nothing is there, and nothing is started, that the document has not said to.
        self.is_strict = meshes is None
        if meshes is not None:
            shutil.copytree(meshes, self.home, dirs_exist_ok=True)
        (self.home / "bin").symlink_to(coseg.parent)
        (self.home / "run").mkdir(mode=0o700)
        for folder in ("clients", "tests", "packaging", "comparisons", "target"):
            if (ROOT / folder).exists():
                (self.home / folder).symlink_to(ROOT / folder)
        keep = {k: v for k, v in os.environ.items() if k in ("PATH", "LANG", "RUSTUP_HOME", "VIRTUAL_ENV")}
        self.env = keep | {
            "HOME": str(self.home),
            "PATH": f"{self.home}/bin:{keep['PATH']}",
            "XDG_RUNTIME_DIR": str(self.home / "run"),
            "NO_COLOR": "1",
        }
        if not self.is_strict:
            self.env["COSEG__SERVER__LIBRARY"] = str(self.home / "shapes")
        self.viewer, self.port = free_ports(2)
        self.daemon: subprocess.Popen[bytes] | None = None
        self.served = "coseg serve --library shapes"

    def serve(self, command: str) -> None:
        self.stop()
        self.served = command
        log = self.home / "daemon.log"
        env = {k: v for k, v in self.env.items() if k not in ("COSEG_SERVER_KEY", "COSEG_CLIENT_KEY")}
        with log.open("wb") as out:
            self.daemon = subprocess.Popen(
                ["bash", "-c", f"exec {command.removesuffix('&').strip()}"], cwd=self.home, env=env, stderr=out, stdout=out
            )
        for _ in range(400):
            if " serving " in log.read_text():
                return
            if self.daemon.poll() is not None:
                break
            time.sleep(0.05)
        raise RuntimeError(log.read_text())

    def stop(self) -> None:
        if self.daemon is not None:
            self.daemon.terminate()
            self.daemon.wait(60)
        self.daemon = None

    def close(self) -> None:
        self.stop()
        shutil.rmtree(self.home)

    def run(self, command: str) -> tuple[int, str]:
        """Status and output of a command; `serve` and those that go on for ever are seen to live."""
        for old, (new, _) in INSTEAD.items():
            if old in command:
                used.add(old)
            command = command.replace(old, new.format(viewer=self.viewer, daemon=self.port))
        if command.startswith("export "):
            for name, value in (word.split("=", 1) for word in command.split()[1:]):
                self.env[name] = value
            return 0, ""
        if command.startswith("coseg serve"):
            if self.is_strict and self.daemon is not None:
                return 1, "a daemon runs already, which the reader would hear: the document does not stop it"
            self.serve(command)
            return 0, ""
        if command.startswith("coseg stop"):
            done = self.bash(command)
            if self.daemon is not None and done[0] == 0:
                self.daemon.wait(60)
                self.daemon = None
            return done
        if command.startswith(ENDLESS):
            going = subprocess.Popen(
                ["bash", "-c", f"exec {command}"], cwd=self.home, env=self.env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
            )
            time.sleep(2)
            if going.poll() is not None:
                return 1, f"ended by itself: {going.communicate()[0].decode()}"
            going.send_signal(signal.SIGINT)
            return (0 if going.wait(10) in (0, 130, -signal.SIGINT) else 1), going.communicate()[0].decode()
        return self.bash(command)

    def bash(self, command: str) -> tuple[int, str]:
        try:
            done = subprocess.run(
                ["bash", "-c", command], cwd=self.home, env=self.env, stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=300, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return 124, "it takes longer than five minutes"
        return done.returncode, done.stdout.decode(errors="replace")


used: set[str] = set()
#: Subcommands that some document types.
typed: set[str] = set()


def fixture(coseg: Path, folder: Path) -> None:
    """What the documents take as there: meshes/101.off and so on, labels.txt, chair.off, a folder for `bench`."""

    def synth(*arguments: str) -> None:
        subprocess.run([coseg, "synth", *arguments], check=True, capture_output=True)

    synth("chair", "--count", "6", "--faces", "2000", "--out", str(folder / "made"))
    (folder / "meshes").mkdir()
    for i, mesh in enumerate(sorted((folder / "made").glob("*.off"))):
        shutil.copy(mesh, folder / "meshes" / f"{101 + i}.off")
    shutil.copy(folder / "made" / "chair-001.labels.txt", folder / "labels.txt")
    shutil.copy(folder / "meshes" / "101.off", folder / "chair.off")
    shutil.rmtree(folder / "made")
    synth("chair", "--count", "4", "--faces", "1000", "--out", str(folder / "benchmark" / "chairs"))
    subprocess.run([sys.executable, ROOT / "comparisons" / "pieces.py", folder / "pieces"], check=True)


def run_document(world: World, document: str) -> list[str]:
    faults = []
    if document in BEFORE:
        world.serve(world.served)
        status, output = world.run(BEFORE[document])
        if status:
            return [f"{document}: {BEFORE[document]}: {output}"]
    for language, first, lines in blocks((ROOT / document).read_text()):
        if language == "python" and HERE.get(document) == "python":
            continue
        if language in PROGRAMS:
            if document not in (ROOT / PROGRAMS[language]).read_text():
                faults.append(f"{document}:{first}: {language} that {PROGRAMS[language]} does not run")
            continue
        if language != "sh" or not any(COMMAND.match(f"{c} ") for _, c in commands(first, lines)):
            continue
        for number, command in commands(first, lines):
            why = next((p for p in EXCEPTIONS if re.fullmatch(p, command, re.DOTALL)), None)
            if why is not None:
                used.add(why)
                print(f"  --   {document}:{number}: {command.splitlines()[0]}")
                continue
            needs_none = world.is_strict or command.startswith("coseg check --repair")
            if world.daemon is None and command.startswith("coseg ") and not needs_none:
                world.serve(world.served)
            begin = time.monotonic()
            typed.update(re.findall(r"\bcoseg ([a-z]+)", command))
            status, output = world.run(command)
            verdict = "ok"
            if command in REFUSED:
                used.add(command)
                if status == 0 or REFUSED[command][0] not in output:
                    verdict = "FAIL"
            elif status != 0:
                verdict = "FAIL"
            print(f"  {verdict:4} {document}:{number}: {command.splitlines()[0]} ({time.monotonic() - begin:.1f} s)", flush=True)
            if verdict == "FAIL":
                faults.append(f"{document}:{number}: {command}\nended with {status}:\n{output.strip()}")
    return faults


def run_programs(world: World, document: str) -> list[str]:
    """The Python of docs/protocol.md as a program that prints labels, that of docs/format.md on files of a library."""
    if HERE.get(document) is None:
        return []
    if importlib.util.find_spec("coseg") is None:
        print(f"  --   {document}: Python; this one has no client: run by clients/check.sh's Python")
        return []
    parts = ["\n".join(lines) for language, _, lines in blocks((ROOT / document).read_text()) if language == "python"]
    faults = []
    world.serve(world.served)
    if document == "docs/protocol.md":
        endpoint = f"ipc://{world.home}/run/coseg/coseg.sock"
        (world.home / "snippet.py").write_text("\n".join(parts))
        status, output = world.bash(f"{sys.executable} snippet.py {endpoint} meshes/101.off")
        expected = world.bash("coseg labels example --collection things --json")[1]
        if status or output.strip().replace(" ", "") not in expected.replace(" ", "").replace("\n", ""):
            faults.append(f"{document}: its Python ended with {status}: {output[:2000]}")
    else:
        world.bash("coseg add meshes/101.off --collection chairs && coseg describe chair.off --full --out full.safetensors")
        path = next((world.home / "shapes" / "objects").glob("*/*.safetensors"))
        known = f"import sys\npath = {str(path)!r}\n"
        # The name of the example's file stands for one that is there.
        code = "\n".join(parts).replace('"objects/ab/abcd….safetensors"', "path").replace("path = path", "")
        code = code.replace("W = scipy", f"import scipy.sparse\na = load_file('{world.home}/full.safetensors')\nW = scipy")
        (world.home / "snippet.py").write_text(known + code + "\nassert W.shape == A.shape and abs(W).sum() > 0\nassert eigenvectors.ndim == 2\n")
        status, output = world.bash(f"{sys.executable} snippet.py")
        if status:
            faults.append(f"{document}: its Python ended with {status}: {output[:2000]}")
    print(f"  {'FAIL' if faults else 'ok':4} {document}: its Python")
    return faults


def main() -> int:
    coseg = Path(sys.argv[1]).resolve()
    # A shell ignores interrupts in what it starts in the background, and children inherit that; one who types does not.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    every = ["README.md", "CHANGELOG.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").glob("*.md"))]
    every += sorted(str(p.relative_to(ROOT)) for p in (ROOT / "clients").glob("*/README.md"))
    documents = sys.argv[2:] or every
    faults: list[str] = []
    with tempfile.TemporaryDirectory(prefix="docs") as made:
        fixture(coseg, Path(made))
        for document in documents:
            print(document, flush=True)
            world = World(coseg, None if document in FROM_NOTHING else Path(made))
            try:
                faults += run_document(world, document)
                faults += run_programs(world, document)
            except RuntimeError as error:
                faults.append(f"{document}: the daemon does not start: {error}")
            finally:
                world.close()
    if documents == every:
        stale = [k for k in [*EXCEPTIONS, *INSTEAD, *REFUSED] if k not in used]
        faults += [f"tests/docs/run.py: nothing needs {k!r} any more" for k in stale]
        listed = subprocess.run([coseg, "--help"], check=True, capture_output=True, text=True).stdout
        listed = listed.split("Commands:")[1].split("Options:")[0]
        # usd is among the exceptions.
        there = set(re.findall(r"^  ([a-z]+) ", listed, re.MULTILINE)) - {"help", "usd"}
        faults += [f"no document types coseg {name}" for name in sorted(there - typed)]
        print("\nnot typed as they stand:")
        for pattern, why in EXCEPTIONS.items():
            print(f"  {pattern}: {why}")
        for old, (new, why) in INSTEAD.items():
            print(f"  {old} -> {new}: {why}")
        for command, (_, why) in REFUSED.items():
            print(f"  {command}: {why}")
    for fault in faults:
        print(f"\nFAIL {fault}")
    print(f"\n{len(documents)} documents, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
