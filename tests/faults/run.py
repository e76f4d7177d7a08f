#!/usr/bin/env python3
"""Plants the faults that the tests of reliability guard against, and sees each turn its test red.

    tests/faults/run.py                 all of them: one build, then some minutes
    tests/faults/run.py R5 r9-no-heartbeat-numbers    some
    tests/faults/run.py --again R5      with what was built the last time
    tests/faults/run.py --list

A copy of the tree (target/faults/tree) gets all faults of faults.py at once, each asleep until the environment variable
PLANTED_FAULT names it; so one build is enough, and the product has none of it. Each test must be green without a fault and
red with its own. The result is written to target/faults/table.md. CARGO names the cargo to build with.
"""

import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time

import faults

ROOT = pathlib.Path(__file__).resolve().parents[2]
PLACE = ROOT / "target/faults"
TREE = PLACE / "tree"
TARGET = PLACE / "target"
# Kinds of tests in faults.py by the name of their binary.
KINDS = {"it": "it", "coseg": "lib", "coseg_geometry": "geometry"}
# A test that hangs is red too.
LIMIT = 240
SWITCH = """
/// Whether this fault is to be made.
#[doc(hidden)]
#[allow(missing_docs)]
pub fn planted(name: &str) -> bool {
    std::env::var("PLANTED_FAULT").is_ok_and(|planted| planted == name)
}
"""


def run(args, **more):
    return subprocess.run(args, cwd=TREE, text=True, **more)


def copy_tree():
    shutil.rmtree(TREE, ignore_errors=True)
    listed = subprocess.check_output(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True
    )
    for name in listed.splitlines():
        source, target = ROOT / name, TREE / name
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)


def link_built():
    """Starts from the dependencies that are built already: hard links, which cost nothing."""
    built = ROOT / "target/release"
    if TARGET.exists() or not built.exists():
        return
    for part in ["deps", "build", ".fingerprint"]:
        shutil.copytree(built / part, TARGET / "release" / part, copy_function=os.link, symlinks=True)


def plant(fault):
    path = TREE / fault["file"]
    text = path.read_text()
    switch = f'crate::planted("{fault["name"]}")'
    for old, new in fault["edits"]:
        assert text.count(old) >= 1, f'{fault["name"]}: {fault["file"]} has no {old!r}'
        text = text.replace(old, new.replace("FAULT", switch), 1)
    path.write_text(text)


def build():
    """The test binaries, by kind. All faults are in them, so that another choice needs no other build."""
    for lib in (TREE / "src/lib.rs", TREE / "crates/geometry/src/lib.rs"):
        lib.write_text(lib.read_text() + SWITCH)
    # Only these packages quickly and roughly: the dependencies stay as they are built.
    quick = "profile.release.package.coseg.opt-level=1"
    built = run(
        [*os.environ.get("CARGO", "cargo").split(), "test", "--release", "--no-run"]
        + ["--package=coseg", "--package=coseg-geometry", "--lib", "--test", "it"]
        + ["--message-format=json", "--config", quick],
        stdout=subprocess.PIPE,
        env={**os.environ, "CARGO_TARGET_DIR": str(TARGET)},
    )
    found = {}
    for line in built.stdout.splitlines():
        message = json.loads(line)
        if message.get("message", {}).get("level") == "error":
            print(message["message"]["rendered"])
        if message.get("executable") and message.get("profile", {}).get("test"):
            found[KINDS[message["target"]["name"]]] = message["executable"]
    if built.returncode:
        sys.exit("the planted tree does not build")
    return found


def verdict(binaries, test, fault):
    """Whether a test is green, and the last thing it said."""
    kind, name = test
    if kind == "unit":
        return unit(fault)
    env = {**os.environ, "RUST_BACKTRACE": "0"}
    env.pop("PLANTED_FAULT", None)
    if fault:
        env["PLANTED_FAULT"] = fault["name"]
        env.update(fault.get("env", {}))
    pipe = subprocess.PIPE
    args = [binaries[kind], name, "--test-threads=2"]
    done = subprocess.Popen(args, cwd=TREE, text=True, stdout=pipe, stderr=pipe, env=env, start_new_session=True)
    try:
        stdout, stderr = done.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        # With the daemons that it started.
        os.killpg(done.pid, signal.SIGKILL)
        done.communicate()
        return False, f"no end within {LIMIT} s"
    out = stdout + stderr
    ran = re.search(r"test result: \w+\. (\d+) passed; (\d+) failed", out)
    if not ran or int(ran[1]) + int(ran[2]) == 0:
        sys.exit(f"no test is named {name}:\n{out[-2000:]}")
    said = re.search(r"panicked at ([^\n]*)\n([^\n]*)", out)
    return done.returncode == 0, " ".join(said.groups())[:160] if said else ""


def unit(fault):
    """The checks of the unit file, as .ci/run makes them."""
    folder = PLACE / "unit"
    folder.mkdir(parents=True, exist_ok=True)
    text = (ROOT / "systemd/coseg.service").read_text()
    for old, new in fault["edits"] if fault else []:
        assert old in text, old
        text = text.replace(old, new)
    text = text.replace("/usr/bin/coseg", "/bin/true").replace("/etc/coseg/coseg.toml", "/etc/hostname")
    (folder / "coseg.service").write_text(text)
    file = str(folder / "coseg.service")
    for args in (["verify", file], ["security", "--offline=yes", "--threshold=5", file]):
        done = subprocess.run(["systemd-analyze", *args], capture_output=True, text=True)
        said = (done.stderr or done.stdout).strip()
        if done.returncode or (args[0] == "verify" and said):
            return False, said.splitlines()[-1][:160]
    return True, ""


def main():
    wanted = sys.argv[1:]
    if wanted == ["--list"]:
        for fault in faults.ALL:
            print(f'{fault["r"]:4} {fault["name"]:30} {"::".join(fault["test"])}: {fault["what"]}')
        return
    again = "--again" in wanted
    wanted = [w for w in wanted if w != "--again"]
    chosen = [f for f in faults.ALL if not wanted or f["r"] in wanted or f["name"] in wanted]
    if not chosen:
        sys.exit("no such fault")
    begin = time.monotonic()
    kept = PLACE / "binaries.json"
    if again:
        binaries = json.loads(kept.read_text())
    else:
        copy_tree()
        link_built()
        for fault in faults.ALL:
            if fault["test"][0] != "unit":
                plant(fault)
        binaries = build()
        kept.write_text(json.dumps(binaries))
    print(f"built in {time.monotonic() - begin:.0f} s", flush=True)
    rows, missed, green = [], [], {}
    for fault in chosen:
        test = fault["test"]
        if test not in green:
            green[test], said = verdict(binaries, test, None)
            if not green[test]:
                print(f'{"::".join(test)} is red without any fault: {said}', flush=True)
        clock = time.monotonic()
        passed, said = verdict(binaries, test, fault)
        seen = "red" if not passed and green[test] else "NOT SEEN"
        if seen != "red":
            missed.append(fault["name"])
        print(f'{seen:8} {fault["name"]:30} {time.monotonic() - clock:4.0f} s  {said}', flush=True)
        rows.append(f'| {fault["r"]} | {fault["what"]} | `{test[1]}` | {seen} |')
    table = "| | fault | test | seen |\n| --- | --- | --- | --- |\n" + "\n".join(rows) + "\n"
    (PLACE / "table.md").write_text(table)
    print(f"{len(chosen) - len(missed)} of {len(chosen)} faults turned their test red; {time.monotonic() - begin:.0f} s")
    if missed:
        sys.exit("not seen: " + ", ".join(missed))


main()
