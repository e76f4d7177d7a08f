# Sourced: where the binary is and where tools go; functions that put tools there. Needs nothing but
# Debian and root, or Python 3.10 with venv, Node 20 and npm, whose places are then used.
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
COSEG_BIN="${COSEG_BIN:-$ROOT/target/release/coseg}"
# Kept between runs if it is named, else temporary.
if [ -z "${COSEG_CLIENTS_WORK:-}" ]; then
    COSEG_CLIENTS_WORK="$(mktemp -d)"
    OWN_WORK=1
    trap 'rm -rf "$COSEG_CLIENTS_WORK"' EXIT
fi
WORK="$COSEG_CLIENTS_WORK"
export COSEG_BIN COSEG_CLIENTS_WORK
mkdir -p "$WORK/node"
PATH="$WORK/venv/bin:$WORK/node/node_modules/.bin:$PATH"
export PATH

step() { printf '\n== %s (%ss)\n' "$1" "$SECONDS"; }

# need COMMAND PACKAGE...: installs Debian packages unless the command is there (`-`: in any case).
need() {
    if [ "$1" != - ] && command -v "$1" >/dev/null; then return; fi
    shift
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

# The clients, the protocol and the Rust workspace as a stranger gets them, in $WORK/clean: nothing
# that was made in the tree is among them.
clean_copy() {
    local parts=(clients proto Cargo.toml Cargo.lock README.md LICENSE-APACHE LICENSE-MIT)
    parts+=(benches config crates examples src vendor)
    rm -rf "$WORK/clean"
    mkdir -p "$WORK/clean"
    if git -C "$ROOT" rev-parse --git-dir >/dev/null 2>&1; then
        (
            cd "$ROOT"
            # What is not ignored and still there, committed or not.
            git ls-files -z --cached --others --exclude-standard "${parts[@]}" |
                tar -c --null --files-from - --ignore-failed-read 2>/dev/null
        ) | tar -x -C "$WORK/clean"
    else
        (cd "$ROOT" && cp -r "${parts[@]}" "$WORK/clean")
    fi
}

# The binary and the native module of Python in the folder $COSEG_BUILT, which setup.py takes them
# from: those beside $COSEG_BIN, else what cargo makes (nothing, after a build of the workspace).
native() {
    COSEG_BUILT="$(dirname "$COSEG_BIN")"
    if [ ! -f "$COSEG_BUILT/lib_native.so" ] || [ "$COSEG_BUILT" = "$ROOT/target/release" ]; then
        (cd "$ROOT" && cargo build --release --locked --quiet -p coseg -p coseg-python)
        COSEG_BUILT="$ROOT/target/release"
    fi
    export COSEG_BUILT
}

# The Python package with what its tests need, in $WORK/venv: the wheel that is built from a clean
# copy.
python_tools() {
    if [ ! -x "$WORK/venv/bin/python" ]; then
        need python3 python3 python3-venv
        python3 -m venv "$WORK/venv" 2>/dev/null || {
            apt-get update -qq
            DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends python3-venv >/dev/null
            python3 -m venv "$WORK/venv"
        }
        "$WORK/venv/bin/python" -m pip install -q -r "$ROOT/clients/python/requirements-dev.txt"
    fi
    clean_copy
    native
    rm -rf "$WORK/wheel"
    "$WORK/venv/bin/python" -m pip wheel -q --no-deps -w "$WORK/wheel" "$WORK/clean/clients/python"
    "$WORK/venv/bin/python" -m pip install -q --no-deps --force-reinstall "$WORK"/wheel/*.whl
}

# Node 20 or newer: Debian's may be older, then the one of the package `node` is taken. The
# TypeScript package with its tools is then in $WORK/typescript, and packed in $WORK/npm.
node_tools() {
    need npm nodejs npm
    if ! node -e 'process.exit(parseInt(process.versions.node) < 20 ? 1 : 0)'; then
        npm install --silent --no-audit --no-fund --prefix "$WORK/node" node@20
        hash -r
    fi
    clean_copy
    rm -rf "$WORK/typescript" "$WORK/npm"
    mkdir -p "$WORK/npm"
    ln -s clean/clients/typescript "$WORK/typescript"
    (
        cd "$WORK/typescript"
        npm ci --silent --no-audit --no-fund
        npm pack --silent --pack-destination "$WORK/npm" >/dev/null
    )
}
