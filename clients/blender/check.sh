#!/usr/bin/env bash
# Tests the extension in Blender without a window. COSEG_BPY names a Python 3.11 with `bpy`, which is too large to
# be installed for this (360 MB to download), with the client and pytest; without one only the style is checked.
# COSEG_BIN names the binary (target/release/coseg).
set -euo pipefail
cd "$(dirname "$0")"
export COSEG_BIN=${COSEG_BIN:-$(realpath ../../target/release/coseg)}
ruff=$(command -v ruff || true)
[ -z "$ruff" ] || { "$ruff" format --check --quiet . && "$ruff" check --quiet .; }
blender=${COSEG_BPY:-python3}
if ! "$blender" -c 'import bpy' 2>/dev/null; then
    echo "skipped: the Blender extension needs a Python with bpy, such as COSEG_BPY=venv/bin/python3"
    exit 0
fi
"$blender" -m pytest -q tests
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"$blender" build.py --out "$work" --binary "$COSEG_BIN"
validator=$("$blender" -c 'import bpy; print(bpy.utils.system_resource("SCRIPTS"))')/addons_core/bl_pkg/cli/blender_ext.py
"$blender" "$validator" validate "$work"/*.zip
# Of the zip alone, not of the client that the tests import.
env -u PYTHONPATH "$blender" -I tests/installed.py "$work"/*.zip
