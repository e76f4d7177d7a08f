"""Installs the zip in a fresh Blender, as a person does, and labels a mesh by the daemon that it brings:
installed.py ZIP."""

from __future__ import annotations

import os
import sys
import tempfile
import time
import zipfile
from pathlib import Path

with tempfile.TemporaryDirectory() as folder:
    os.environ["BLENDER_USER_RESOURCES"] = folder
    import bpy

    bpy.ops.preferences.addon_enable(module="bl_pkg")
    from bl_pkg.bl_extension_utils import python_versions_from_wheels

    with zipfile.ZipFile(sys.argv[1]) as archive:
        wheels = [name for name in archive.namelist() if name.endswith(".whl")]
    # Blender refuses an extension whose wheels do not name its Python.
    assert python_versions_from_wheels(wheels) == {(3, 11), (3, 13)}, wheels
    done = bpy.ops.extensions.package_install_files(
        filepath=str(Path(sys.argv[1]).resolve()), repo="user_default", enable_on_install=True
    )
    assert done == {"FINISHED"}, done
    module = "bl_ext.user_default.coseg"
    assert module in bpy.context.preferences.addons
    import coseg

    assert coseg.__file__.startswith(folder), coseg.__file__
    session = sys.modules[f"{module}.session"]
    assert session.daemon_binary().parent.name == "bin"
    bpy.context.scene.coseg.endpoint = f"ipc://{folder}/s"

    def run(operator: object) -> None:
        """Runs an operator and takes up its result."""
        assert operator() == {"FINISHED"}  # type: ignore[operator]
        end = time.monotonic() + 120
        while session.current.pump():
            assert time.monotonic() < end
            time.sleep(0.02)
        assert not session.current.error, session.current.error

    run(bpy.ops.coseg.connect)
    bpy.ops.mesh.primitive_monkey_add()
    bpy.context.scene.coseg.parts = 2
    run(bpy.ops.coseg.send)
    mesh = bpy.context.view_layer.objects.active.data
    labels = {value.value for value in mesh.attributes["coseg_label"].data}
    assert labels == {0, 1}, labels
    assert list((Path(folder) / "extensions").rglob("library"))
    bpy.ops.preferences.addon_disable(module=module)
    print(f"Blender {bpy.app.version_string} installs {Path(sys.argv[1]).name}, and labels a mesh with it")
