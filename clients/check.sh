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

step "Python: style, types, tests"
(
    cd python
    ruff format --check --quiet .
    ruff check --quiet .
    mypy --no-error-summary
    python -m pytest --durations=3
)

step "documents: what they say to type, and the Python that is no program of its own"
python "$ROOT/tests/docs/run.py" "$COSEG_BIN"

step "Python: wheel"
rm -rf "$WORK/wheel"
python -m pip wheel -q --no-deps --no-build-isolation -w "$WORK/wheel" ./python
python - "$WORK"/wheel/*.whl <<'PY'
import sys, zipfile
names = zipfile.ZipFile(sys.argv[1]).namelist()
wanted = ["coseg/py.typed", "coseg/_client.py", "coseg/v1/message_pb2.py", "coseg/v1/message_pb2.pyi"]
assert not (missing := [n for n in wanted if n not in names]), missing
print(sys.argv[1].rsplit("/", 1)[1], len(names), "files")
PY

step "tools for TypeScript"
node_tools

step "TypeScript: types, tests, tarball"
(
    cd "$WORK/typescript"
    npx tsc
    COSEG_GOLDEN="$ROOT/tests/golden" node --test --test-timeout=120000 --test-reporter=dot dist/test/*.test.js
    # The README's program, against a daemon of its own.
    COSEG_ROOT="$ROOT" node dist/test/snippets.js
    npm pack --silent --ignore-scripts | tail -n 1
)

./raw/run.sh
step "clients are well"
