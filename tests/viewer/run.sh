#!/usr/bin/env bash
# The viewer in headless Chromium: live against a real daemon with made shapes, and as a file.
#
#   tests/viewer/run.sh [OUT]     screenshots go to OUT (default: a temporary folder)
#   COSEG_VIEWER_PICTURES=docs/images tests/viewer/run.sh
#                                 and makes the pictures of the documents again
#   COSEG_VIEWER_SHAPES=400 tests/viewer/run.sh [OUT]
#                                 and how soon so many chairs appear, live and as a file:
#                                 COSEG_VIEWER_MS is the limit (2000) for the middle one of three
#                                 rounds. Labelling 400 takes three minutes; nothing else should run
#                                 meanwhile.
#   COSEG_VIEWER_SOURCES=$PWD/src/viewer COSEG_VIEWER_ONLY=stroke tests/viewer/run.sh [OUT]
#                                 tries the sources of the live page without a build, and only the
#                                 tests whose name contains a word
#
# Needs target/release/coseg, or COSEG_BIN. Installs Chromium, Node and npm from Debian where they
# are missing.
set -euo pipefail
cd "$(dirname "$0")/../.."
. tests/viewer/serve.sh

[ -n "${COSEG_VIEWER_ONLY:-}" ] || (cd "$work" && node viewer.mjs empty "$url" "$out")

"$coseg" synth chair --count 14 --faces 3000 --out "$work/chairs" >/dev/null
"$coseg" synth candelabra --count 6 --faces 3000 --out "$work/candelabras" >/dev/null
"$coseg" add "$work/chairs" --collection chairs --parts 4 --up +y --timeout 60 >/dev/null
"$coseg" add "$work/candelabras" --collection candelabras --parts 3 --up +y --timeout 60 >/dev/null
"$coseg" synth chair --count 5 --faces 1000 --out "$work/fallen" >/dev/null
"$coseg" add "$work/fallen" --collection fallen --parts 4 --up -x --timeout 60 >/dev/null 2>"$work/warned"
grep -q 'collections set fallen --up +y' "$work/warned" ||
    { cat "$work/warned" >&2; fail "no warning of the up axis" 1; }
"$coseg" synth chair --count 2 --faces 1000 --out "$work/pair" >/dev/null
"$coseg" add "$work/pair" --collection pair --parts 3 --timeout 60 >/dev/null
"$coseg" view chairs -o "$work/chairs.html" --timeout 60

(cd "$work" && node viewer.mjs all "$url" "$out" "$work/chairs.html")

if [ -n "${COSEG_VIEWER_PICTURES:-}" ]; then
    pictures=$(cd "$COSEG_VIEWER_PICTURES" && pwd)
    (cd "$work" && node viewer.mjs pictures "$url" "$pictures" "$work/chairs")
fi

if [ -n "${COSEG_VIEWER_SHAPES:-}" ]; then
    "$coseg" synth chair --count "$COSEG_VIEWER_SHAPES" --faces 2500 --out "$work/many" >/dev/null 2>&1
    "$coseg" add "$work/many" --collection many --parts 4 --up +y --timeout 60 >/dev/null 2>&1
    "$coseg" wait --collection many --timeout 60 >/dev/null
    "$coseg" view many -o "$work/many.html" --timeout 60
    (cd "$work" && node viewer.mjs many "$url" "$out" "$work/many.html")
fi
