# Sourced by the scripts beside it: starts a daemon with the viewer in a folder of its own, and
# prepares a browser. Sets coseg, work, out and url; ends the daemon and removes the folder at the end.
# The first argument of the script is `out`, the folder for screenshots.
#
# Needs target/release/coseg, or COSEG_BIN. Installs Chromium, Node and npm from Debian where they
# are missing.

fail() {
    echo "tests/viewer: $1" >&2
    exit "${2:-2}"
}

coseg=${COSEG_BIN:-$PWD/target/release/coseg}
[ -x "$coseg" ] || fail "$coseg is missing, build it with: cargo build --release"

missing=()
command -v chromium >/dev/null || missing+=(chromium)
command -v node >/dev/null || missing+=(nodejs)
command -v npm >/dev/null || missing+=(npm)
if [ ${#missing[@]} -gt 0 ]; then
    apt-get update -qq >/dev/null &&
        apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null ||
        fail "${missing[*]} cannot be installed; the viewer is not tested without a browser"
fi

work=$(mktemp -d)
daemon=
finish() {
    [ -z "$daemon" ] || kill "$daemon" 2>/dev/null || true
    wait 2>/dev/null || true
    rm -rf "$work"
}
trap finish EXIT
out=${1:-$work/screenshots}
mkdir -p "$out"
out=$(cd "$out" && pwd)

cp tests/viewer/package.json tests/viewer/*.mjs "$work/"
(cd "$work" && npm install --silent --no-audit --no-fund) ||
    fail "playwright-core and axe-core cannot be installed"

export COSEG_BIN="$coseg"
export COSEG_ENDPOINT="ipc://$work/coseg.sock"
"$coseg" serve --library "$work/library" --http 127.0.0.1:0 2>"$work/log" &
daemon=$!
url=
for _ in $(seq 100); do
    url=$(sed -n 's#.*viewer and metrics at \(http://[^ ]*\).*#\1#p' "$work/log" | tail -n 1)
    [ -z "$url" ] || break
    kill -0 "$daemon" 2>/dev/null || { cat "$work/log" >&2; exit 1; }
    sleep 0.1
done
[ -n "$url" ] || { cat "$work/log" >&2; fail "the daemon does not serve" 1; }
