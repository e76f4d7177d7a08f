"""Builds the extension for Blender: build.py [--platform NAME] [--binary COSEG] [--coseg WHEEL] [--out DIR].

The zip holds the package, the wheels of what it imports for the Pythons of Blender 4.2 and later, and the
daemon's program, if one is given. Wheels of pyzmq and protobuf come from the package registry by pip; where
protobuf has none for the platform, the one in Python alone. That of coseg is built from clients/python, or
given. numpy comes with Blender. To install the zip: Preferences, Get Extensions, Install from Disk.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PACKAGE = HERE / "coseg_blender"
#: Pythons of Blender: 4.2 to 5.0 have 3.11, 5.1 has 3.13.
PYTHONS = ("3.11", "3.13")
#: What the client imports, as clients/python/pyproject.toml says. pyzmq 27 has a wheel of the stable ABI for
#: 3.13 beside one of 3.11 alone, of which Blender takes the latter to say that 3.13 is not served; 26 has one
#: for each.
REQUIREMENTS = ("pyzmq>=26.2,<27", "protobuf>=6.31.1,<8")
#: Blender's names of platforms, and pip's. The daemon runs on Linux; others connect to one.
PLATFORMS = {
    "linux-x64": ("manylinux_2_28_x86_64", "manylinux2014_x86_64"),
    "macos-arm64": ("macosx_11_0_arm64",),
    "macos-x64": ("macosx_11_0_x86_64",),
    "windows-x64": ("win_amd64",),
    "windows-arm64": ("win_arm64",),
}


def pip(*arguments: str) -> None:
    """Runs pip, which says why if it fails."""
    subprocess.run([sys.executable, "-m", "pip", *arguments, "--quiet"], check=True)


def wheels(folder: Path, platform: str, coseg: Path | None) -> list[Path]:
    """The wheels that the extension needs on a platform."""
    if coseg is None:
        # A build leaves files beside the sources.
        ignored = shutil.ignore_patterns("build", "*.egg-info", "__pycache__")
        for source in ("clients/python", "proto"):
            shutil.copytree(ROOT / source, folder / "source" / source, ignore=ignored)
        # Of Python alone: the program comes along by itself.
        os.environ["COSEG_PURE"] = "1"
        pip("wheel", "--no-deps", "--wheel-dir", str(folder), str(folder / "source/clients/python"))
    else:
        (folder / coseg.name).write_bytes(coseg.read_bytes())
    for python in PYTHONS:
        platforms = [word for tag in PLATFORMS[platform] for word in ("--platform", tag)]
        pip(
            "download",
            "--no-deps",
            "--only-binary=:all:",
            *("--python-version", python, *platforms, "--dest", str(folder)),
            *REQUIREMENTS,
        )
    return sorted(folder.glob("*.whl"))


def program(binary: Path | None, found: list[Path]) -> bytes | None:
    """The daemon's program: as given, or from the wheel that brings it."""
    if binary is not None:
        return binary.read_bytes()
    for path in found:
        with zipfile.ZipFile(path) as wheel:
            for name in wheel.namelist():
                if name.endswith(".data/scripts/coseg"):
                    return wheel.read(name)
    return None


def manifest(names: list[str], platform: str | None) -> str:
    """The manifest with the wheels, and the platform if something in the zip is bound to one."""
    text = (PACKAGE / "blender_manifest.toml").read_text()
    added = f'platforms = ["{platform}"]\n' if platform else ""
    if names:
        added += "wheels = [\n" + "".join(f'  "./wheels/{name}",\n' for name in names) + "]\n"
    marker = "# build.py adds the platforms and wheels.\n"
    if marker not in text:
        raise SystemExit(f"blender_manifest.toml has lost the line {marker!r}")
    return text.replace(marker, added)


def main() -> None:
    """Writes the zip and prints its path and size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "dist", help="folder for the zip")
    parser.add_argument("--platform", choices=PLATFORMS, default="linux-x64", help="of Blender")
    parser.add_argument("--coseg", type=Path, help="wheel of the client, in place of building one")
    parser.add_argument("--binary", type=Path, help="the daemon's program to bring along")
    parser.add_argument("--no-wheels", action="store_true", help="for a Blender whose Python has the client")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        found = [] if args.no_wheels else wheels(Path(folder), args.platform, args.coseg)
        binary = program(args.binary, found)
        is_bound = binary is not None or any(not path.name.endswith("-any.whl") for path in found)
        platform = args.platform if is_bound else None
        target = args.out / f"coseg-blender-{platform or 'any'}.zip"
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as out:
            out.writestr("blender_manifest.toml", manifest([path.name for path in found], platform))
            for path in sorted(PACKAGE.glob("*.py")):
                out.write(path, path.name)
            for path in found:
                out.write(path, f"wheels/{path.name}")
            if binary is not None:
                info = zipfile.ZipInfo("bin/coseg")
                info.external_attr = 0o755 << 16
                out.writestr(info, binary, zipfile.ZIP_DEFLATED)
    print(f"{target}: {target.stat().st_size / 1e6:.1f} MB, {len(found)} wheels")


if __name__ == "__main__":
    main()
