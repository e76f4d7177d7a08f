#!/usr/bin/env bash
# Makes a Python with Blender as a module, for the tests of the extension and of exported files:
#
#     clients/blender/bpy.sh DIR      # then COSEG_BPY=DIR/bin/python3
#
# DIR becomes a virtual environment with the newest `bpy` for Python 3.11, which python3.11 or python3 must be:
# 370 MB to download, 1 GB on disk. On Debian, as root, the libraries of X11 that Blender links are installed
# if they are missing; nothing is shown.
set -euo pipefail
dir=$1
python=
for candidate in python3.11 python3 /usr/bin/python3; do
    if [ "$("$candidate" -c 'import sys; print(*sys.version_info[:2])' 2>/dev/null)" = "3 11" ]; then
        python=$candidate
        break
    fi
done
[ -n "$python" ] || { echo "bpy 5.0.1 needs Python 3.11, and $(python3 --version) is another one" >&2; exit 1; }
"$python" -m venv "$dir"
# Without the cache of pip, which would keep another copy.
"$dir/bin/python3" -m pip install -q --no-cache-dir bpy==5.0.1
if ! said=$("$dir/bin/python3" -c 'import bpy' 2>&1) && [[ $said == *"cannot open shared object"* ]]; then
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends \
        libgl1 libsm6 libx11-6 libxfixes3 libxi6 libxkbcommon0 libxrender1 >/dev/null
fi
"$dir/bin/python3" -c 'import bpy; print("Blender", bpy.app.version_string)'
