#!/usr/bin/env bash
# The viewer in headless Chromium: live against a real daemon with made shapes, and as a file.
#
#   tests/viewer/run.sh [OUT]     screenshots go to OUT (default: a temporary folder)
#   COSEG_VIEWER_PICTURES=docs/images tests/viewer/run.sh
#                                 and makes the pictures of the documents again
#   COSEG_VIEWER_SHAPES=400 tests/viewer/run.sh [OUT]
#                                 and how soon so many chairs appear, live and as a file: COSEG_VIEWER_MS is the limit
#                                 (2000) for the middle one of three rounds. Labelling 400 takes three
#                                 minutes; nothing else should run meanwhile.
#
# Needs target/release/coseg, or COSEG_BIN. Installs Chromium, Node and npm from Debian where they are missing.
set -euo pipefail
cd "$(dirname "$0")/../.."

coseg=${COSEG_BIN:-$PWD/target/release/coseg}
[ -x "$coseg" ] || { echo "tests/viewer: $coseg is missing, build it with: cargo build --release" >&2; exit 2; }

missing=()
command -v chromium >/dev/null || missing+=(chromium)
command -v node >/dev/null || missing+=(nodejs)
command -v npm >/dev/null || missing+=(npm)
if [ ${#missing[@]} -gt 0 ]; then
    if ! { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${missing[@]}"; } >/dev/null; then
        echo "tests/viewer: ${missing[*]} cannot be installed; the viewer is not tested without a browser" >&2
        exit 2
    fi
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
(cd "$work" && npm install --silent --no-audit --no-fund) || { echo "tests/viewer: playwright-core and axe-core cannot be installed" >&2; exit 2; }

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
[ -n "$url" ] || { echo "tests/viewer: the daemon does not serve" >&2; cat "$work/log" >&2; exit 1; }

(cd "$work" && NODE_ENV=test node viewer.mjs empty "$url" "$out")

"$coseg" synth chair --count 14 --faces 3000 --out "$work/chairs" >/dev/null
"$coseg" synth candelabra --count 6 --faces 3000 --out "$work/candelabras" >/dev/null
"$coseg" add "$work/chairs" --collection chairs --parts 4 --up +y --timeout 60 >/dev/null
"$coseg" add "$work/candelabras" --collection candelabras --parts 3 --up +y --timeout 60 >/dev/null
"$coseg" synth chair --count 5 --faces 1000 --out "$work/fallen" >/dev/null
"$coseg" add "$work/fallen" --collection fallen --parts 4 --up -x --timeout 60 >/dev/null 2>"$work/warned"
grep -q 'collections set fallen --up +y' "$work/warned" || { cat "$work/warned"; echo "tests/viewer: no warning of the up axis" >&2; exit 1; }
"$coseg" view chairs -o "$work/chairs.html" --timeout 60

(cd "$work" && COSEG_BIN="$coseg" node viewer.mjs all "$url" "$out" "$work/chairs.html")

if [ -n "${COSEG_VIEWER_PICTURES:-}" ]; then
    pictures=$(cd "$COSEG_VIEWER_PICTURES" && pwd)
    (cd "$work" && COSEG_BIN="$coseg" node viewer.mjs pictures "$url" "$pictures" "$work/chairs")
fi

if [ -n "${COSEG_VIEWER_SHAPES:-}" ]; then
    "$coseg" synth chair --count "$COSEG_VIEWER_SHAPES" --faces 2500 --out "$work/many" >/dev/null 2>&1
    "$coseg" add "$work/many" --collection many --parts 4 --up +y --timeout 60 >/dev/null 2>&1
    "$coseg" wait --collection many --timeout 60 >/dev/null
    "$coseg" view many -o "$work/many.html" --timeout 60
    (cd "$work" && COSEG_BIN="$coseg" node viewer.mjs many "$url" "$out" "$work/many.html")
fi
