#!/usr/bin/env bash
# Tests the extension in Blender without a window. COSEG_BPY names a Python 3.11 with `bpy`, which bpy.sh makes;
# without one only the style is checked. COSEG_BIN names the binary (target/release/coseg); COSEG_CLIENTS_WORK
# a folder to keep tools in.
set -euo pipefail
cd "$(dirname "$0")"
source ../setup.sh
if command -v ruff >/dev/null; then
    ruff format --check --quiet .
    ruff check --quiet .
fi
if [ -z "${COSEG_BPY:-}" ]; then
    echo "skipped: the Blender extension needs COSEG_BPY, a Python with bpy: clients/blender/bpy.sh makes one"
    exit 0
fi
[ -d "$WORK/wheel" ] || python_tools
work=$WORK/blender
rm -rf "$work"
mkdir "$work"
# What the tests import, in a folder that only they see, and the numpy that Blender has.
"$COSEG_BPY" -m pip freeze | grep -i '^numpy==' >"$work/constraints.txt"
"$COSEG_BPY" -m pip install -q --target "$work/client" -c "$work/constraints.txt" "$WORK"/wheel/*.whl pytest==9.2.0
PYTHONPATH=$work/client "$COSEG_BPY" -m pytest -q tests
"$COSEG_BPY" build.py --out "$work" --binary "$COSEG_BIN"
validator=$("$COSEG_BPY" -c 'import bpy; print(bpy.utils.system_resource("SCRIPTS"))')/addons_core/bl_pkg/cli/blender_ext.py
"$COSEG_BPY" "$validator" validate "$work"/*.zip
# Of the zip alone, not of the client that the tests import.
"$COSEG_BPY" -I tests/installed.py "$work"/*.zip
