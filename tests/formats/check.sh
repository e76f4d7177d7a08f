#!/usr/bin/env bash
# Files of other programs in, files of coseg out and read by other programs: trimesh, plyfile, USD,
# three.js and the glTF validator. Needs Python with venv, Node with npm, and their package registries.
#
#     tests/formats/check.sh [COSEG]
set -euo pipefail
cd "$(dirname "$0")/../.."
coseg=$(realpath "${1:-target/release/coseg}")
here=$PWD/tests/formats
work=$(mktemp -d)
trap '[ -z "${daemon:-}" ] || { kill "$daemon"; wait "$daemon"; } 2>/dev/null || true; rm -rf "$work"' EXIT

python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q numpy trimesh plyfile usd-core pillow
npm install --silent --no-audit --no-fund --prefix "$work" gltf-validator@latest three@0.170 >/dev/null
cp "$here"/*.mjs "$work/"

"$coseg" synth chair --count 3 --faces 1500 --out "$work/made"
"$work/venv/bin/python" "$here/make.py" "$work/made" "$work/in"
export COSEG_ENDPOINT="ipc://$work/s"
"$coseg" serve --library "$work/library" --log-level error &
daemon=$!
for _ in $(seq 100); do "$coseg" stats >/dev/null 2>&1 && break; sleep 0.1; done
"$coseg" add "$work/in" --collection all --parts 4 --up +z
for format in labels seg npy json ply obj glb usda; do
    "$coseg" export --format "$format" --out "$work/out"
done
"$work/venv/bin/python" "$here/check.py" "$work/in" "$work/out"
node "$work/validate.mjs" "$work/out/parts.json" "$work"/out/*.glb
# The package is large, so that it is not installed for this; COSEG_BPY names a Python that has it.
if [ -n "${COSEG_BPY:-}" ]; then
    "$COSEG_BPY" "$here/blender.py" "$work/out"
else
    echo "skipped: reading with Blender needs COSEG_BPY, a Python with bpy: clients/blender/bpy.sh makes one"
fi

# Every messy file through the socket, and spoilt ones with their reasons.
if [ -n "${COSEG_TEST_DATA:-}" ] && [ -d "$COSEG_TEST_DATA/messy" ]; then
    python3 "$here/messy.py" "$coseg" "$COSEG_TEST_DATA/messy" "$work/messy.md"
fi
