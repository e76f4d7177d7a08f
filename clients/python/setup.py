"""Builds the wheel: the client with the protocol's messages, the native module and the binary.

The messages come from the protocol's own files, so that there is one description of it. The module
and the binary come from one run of cargo in the repository around this folder, or in the copy of it
that a source archive holds. Two variables change that:

    COSEG_BUILT=DIR   takes `coseg` and `lib_native.so` from DIR; cargo is not run
    COSEG_PURE=1      makes a wheel of Python alone: the client without coseg.geometry and `coseg`
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

# That of setuptools, which is loaded: Python 3.12 has none.
from distutils.command.build_scripts import build_scripts  # isort: skip

HERE = Path(__file__).parent.resolve()
IS_PURE = bool(os.environ.get("COSEG_PURE"))
#: What cargo needs of the repository.
WORKSPACE = ["Cargo.toml", "Cargo.lock", "README.md", "LICENSE-APACHE", "LICENSE-MIT"]
FOLDERS = ["benches", "config", "crates", "examples", "proto", "src", "vendor"]


def workspace() -> Path:
    """The Rust workspace: in a source archive beside this file, else the repository."""
    for root in (HERE / "workspace", HERE.parent.parent):
        if (root / "proto" / "coseg" / "v1").is_dir():
            return root
    raise SystemExit("coseg: the folder proto/coseg/v1 is neither in workspace/ nor two folders above")


def generate(out: Path) -> None:
    """Writes coseg/v1/*_pb2.py and their types below `out`."""
    root = workspace() / "proto"
    files = sorted(str(path) for path in (root / "coseg" / "v1").glob("*.proto"))
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{root}"]
    out.mkdir(parents=True, exist_ok=True)
    subprocess.run([*command, f"--python_out={out}", f"--pyi_out={out}", *files], check=True)
    (out / "coseg" / "v1" / "__init__.py").write_text('"""The messages of the protocol."""\n')


def built() -> Path:
    """The folder with the binary and the native module, which cargo makes unless they are given."""
    if given := os.environ.get("COSEG_BUILT"):
        return Path(given).resolve()
    root = workspace()
    # Both at once: what they share is compiled once.
    subprocess.run(
        ["cargo", "build", "--release", "--locked", "-p", "coseg", "-p", "coseg-python"],
        cwd=root,
        check=True,
    )
    command = ["cargo", "metadata", "--format-version=1", "--no-deps", "--offline"]
    told = subprocess.run(command, cwd=root, check=True, capture_output=True).stdout
    return Path(json.loads(told)["target_directory"]) / "release"


class BuildWithMessages(build_py):
    """Makes the messages where the package is put together.

    They are no part of the source tree: what is looked for there may be looked for before they are made.
    """

    def run(self) -> None:
        super().run()
        # An editable install is the source tree itself.
        generate(HERE / "src" if self.editable_mode else Path(self.build_lib))


class BuildNative(build_ext):
    """Takes the native module from cargo."""

    def build_extension(self, ext: Extension) -> None:
        out = Path(self.get_ext_fullpath(ext.name))
        out.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(built() / "lib_native.so", out)


class BuildBinary(build_scripts):
    """Takes the program `coseg` from cargo: it is no script, so it is not rewritten as one."""

    def run(self) -> None:
        out = Path(self.build_dir)
        out.mkdir(parents=True, exist_ok=True)
        shutil.copy2(built() / "coseg", out / "coseg")

    def get_source_files(self) -> list[str]:
        return []


class ArchiveWithWorkspace(sdist):
    """Packs the Rust workspace too, for there is no repository around an archive."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        root, out = workspace(), Path(base_dir) / "workspace"
        out.mkdir(parents=True, exist_ok=True)
        for name in WORKSPACE:
            shutil.copy2(root / name, out / name)
        leave = shutil.ignore_patterns("target", "__pycache__", "*.binpb")
        for name in FOLDERS:
            shutil.copytree(root / name, out / name, ignore=leave, dirs_exist_ok=True)


if __name__ == "__main__":
    native = {
        "ext_modules": [Extension("coseg._native", sources=[], py_limited_api=True)],
        "scripts": ["coseg"],
        # The stable ABI of Python 3.10 and later.
        "options": {"bdist_wheel": {"py_limited_api": "cp310"}},
    }
    commands = {
        "build_ext": BuildNative,
        "build_py": BuildWithMessages,
        "build_scripts": BuildBinary,
        "sdist": ArchiveWithWorkspace,
    }
    setup(cmdclass=commands, **({} if IS_PURE else native))
