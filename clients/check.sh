#!/usr/bin/env bash
# Lints the protocol and tests the clients against the daemon: on a fresh Debian with root, or with Python 3.11
# and Node 20. COSEG_BIN names the binary (target/release/coseg); COSEG_CLIENTS_WORK a folder to keep tools in.
set -euo pipefail
cd "$(dirname "$0")"
source ./setup.sh
[ -x "$COSEG_BIN" ] || { echo "$COSEG_BIN is missing: cargo build --release" >&2; exit 1; }

step "tools for Python"
python_tools

step "protocol: lint, and nothing broken since the last release"
buf lint "$ROOT/proto"
# What released versions said, as images: `buf build proto --exclude-source-info -o proto/released/VERSION.binpb`.
for image in "$ROOT"/proto/released/*.binpb; do
    buf breaking "$ROOT/proto" --against "$image"
    echo "nothing is broken since $(basename "$image" .binpb)"
done
if git -C "$ROOT" rev-parse --git-dir >/dev/null 2>&1; then
    # And since the last tag; before the first one, since the commit before.
    since=$(git -C "$ROOT" describe --tags --abbrev=0 2>/dev/null ||
        git -C "$ROOT" rev-parse -q --verify 'HEAD~1' || git -C "$ROOT" rev-parse HEAD)
    mkdir -p "$WORK/released"
    rm -rf "$WORK/released/proto"
    git -C "$ROOT" archive "$since" proto | tar -x -C "$WORK/released"
    buf breaking "$ROOT/proto" --against "$WORK/released/proto"
fi

step "Python: wheel and source archive, in an environment of their own"
(
    "$WORK/venv/bin/python" - "$WORK"/wheel/*.whl <<'PY'
import os, sys, zipfile
names = zipfile.ZipFile(sys.argv[1]).namelist()
wanted = ["py.typed", "_client.py", "v1/__init__.py", "v1/message_pb2.py", "v1/message_pb2.pyi"]
wanted += ["_native.abi3.so", "_native.pyi", "geometry/__init__.py"]
assert not (missing := [n for n in wanted if f"coseg/{n}" not in names]), missing
assert any(n.endswith(".data/scripts/coseg") for n in names), names
assert "-cp310-abi3-" in sys.argv[1], sys.argv[1]
n_bytes = os.path.getsize(sys.argv[1])
assert n_bytes < 40_000_000, n_bytes
assert sum("/licenses/LICENSE-" in n for n in names) == 2, names
print(sys.argv[1].rsplit("/", 1)[1], len(names), "files,", n_bytes, "bytes")
PY
    rm -rf "$WORK/archive" "$WORK/stranger"
    (cd "$WORK/clean/clients/python" && python -c '
import sys
from setuptools.build_meta import build_sdist
build_sdist(sys.argv[1])' "$WORK/archive" >/dev/null)
    python3 -m venv "$WORK/stranger"
    cd "$WORK/stranger"
    # The archive holds the workspace that it is built from: here only its manifests are read, and
    # what cargo has built already is taken.
    tar -x -C "$WORK/archive" -f "$WORK"/archive/*.tar.gz
    (cd "$WORK"/archive/coseg-*/workspace && cargo metadata --no-deps --offline --format-version 1 >/dev/null)
    for package in "$WORK"/archive/*.tar.gz "$WORK"/wheel/*.whl; do
        bin/python -m pip install -q --force-reinstall "$package"
        # Nothing of Rust is on the path.
        env -i HOME="$PWD" PATH="$PWD/bin:/usr/bin:/bin" bash -ec '
            python -c "import coseg; from coseg.v1 import message_pb2; print(coseg.__file__)"
            python -c "import coseg; print(coseg.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))"
            coseg --version'
    done
    env -i HOME="$PWD" PATH="$PWD/bin:/usr/bin:/bin" coseg demo | tail -n 3
    # The client alone, where there is no module for the platform.
    rm -rf "$WORK/pure"
    COSEG_PURE=1 "$WORK/venv/bin/python" -m pip wheel -q --no-deps -w "$WORK/pure" "$WORK/clean/clients/python"
    bin/python -m pip install -q --force-reinstall --no-deps "$WORK"/pure/coseg-*-py3-none-any.whl
    bin/python -c '
import coseg
coseg.Library("ipc:///nowhere").close()
try:
    coseg.Mesh
except ImportError as error:
    print(error)
else:
    raise SystemExit("the pure client has a native module")'
)

step "Python: style, types, tests"
(
    cd python
    ruff format --check --quiet .
    ruff check --quiet .
    # Types of the sources and of the messages beside them.
    clean="$WORK/clean/clients/python"
    python -m grpc_tools.protoc -I"$ROOT/proto" --python_out="$clean/src" \
        --pyi_out="$clean/src" "$ROOT"/proto/coseg/v1/*.proto
    touch "$clean/src/coseg/v1/__init__.py"
    (cd "$clean" && mypy --no-error-summary)
    # What a caller sees, from outside: the stub against the module, and strict programs.
    python -m mypy.stubtest coseg._native
    (cd "$WORK/stranger" && cp "$clean/tests/typed.py" . && mypy --strict typed.py && pyright --level error typed.py)
    # Against the installed wheel: what is tested is what a stranger gets.
    python -m pytest --durations=3
)

step "documents: what they say to type, and the Python that is no program of its own"
python "$ROOT/tests/docs/run.py" "$COSEG_BIN"

step "tools for TypeScript"
node_tools

step "TypeScript: types, tests"
(
    cd "$WORK/typescript"
    COSEG_GOLDEN="$ROOT/tests/golden" node --test --test-timeout=120000 --test-reporter=dot dist/test/*.test.js
    # The README's program, against a daemon of its own.
    COSEG_ROOT="$ROOT" node dist/test/snippets.js
)

step "TypeScript: the tarball in a project of its own"
(
    rm -rf "$WORK/project"
    mkdir "$WORK/project"
    cd "$WORK/project"
    npm init -y >/dev/null
    npm install --silent --no-audit --no-fund "$WORK"/npm/*.tgz
    ls node_modules/coseg/LICENSE-MIT node_modules/coseg/LICENSE-APACHE
    node --input-type=module -e '
        import { Library } from "coseg";
        import { RequestSchema } from "coseg/v1/message";
        new Library({ endpoint: "ipc:///nowhere" }).close();
        console.log(RequestSchema.typeName);'
)

./raw/run.sh

step "Blender: the extension"
PATH="$WORK/venv/bin:$PATH" ./blender/check.sh
step "clients are well"
