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

# The Python package with what its tests need, in $WORK/venv.
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
    "$WORK/venv/bin/python" -m pip install -q --no-deps --no-build-isolation -e "$ROOT/clients/python"
}

# Node 20 or newer: Debian's may be older, then the one of the package `node` is taken.
node_tools() {
    need npm nodejs npm
    if ! node -e 'process.exit(parseInt(process.versions.node) < 20 ? 1 : 0)'; then
        npm install --silent --no-audit --no-fund --prefix "$WORK/node" node@20
        hash -r
    fi
    # node_modules stays outside the tree.
    rm -rf "$WORK/typescript"
    cp -r "$ROOT/clients/typescript" "$WORK/typescript"
    rm -rf "$WORK/typescript/node_modules" "$WORK/typescript/dist" "$WORK/typescript/src/gen"
    (
        cd "$WORK/typescript"
        npm ci --silent --no-audit --no-fund
        COSEG_PROTO="$ROOT/proto" npm run --silent generate
    )
}
