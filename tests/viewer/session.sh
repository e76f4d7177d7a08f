#!/usr/bin/env bash
# A person's minute with 20 made vases in the viewer, in headless Chromium: what she pressed, what
# changed, and the accuracy against the known labels.
#
#   tests/viewer/session.sh OUT   writes session.md, session.json and a picture after each press to
#                                 OUT, and all of them on one sheet, session.png
#
# Needs target/release/coseg, or COSEG_BIN. Installs Chromium, Node and npm from Debian where they
# are missing.
set -euo pipefail
cd "$(dirname "$0")/../.."
[ $# = 1 ] || { sed -n '2,7s/^# \?//p' "$0" >&2; exit 2; }
. tests/viewer/serve.sh

"$coseg" synth container --count 20 --faces 3000 --out "$work/vases" >/dev/null
"$coseg" add "$work/vases" --collection vases --parts 4 --up +y --timeout 60 >/dev/null
"$coseg" wait --collection vases --timeout 60 >/dev/null
(cd "$work" && node session.mjs "$url" "$out" "$work/vases")
