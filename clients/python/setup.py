"""Makes the message classes from the protocol's own files, so that there is one description of it."""

import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

HERE = Path(__file__).parent.resolve()


def proto_root() -> Path:
    """The protocol's folder: beside this file in a source archive, else that of the repository."""
    for root in (HERE / "proto", HERE.parent.parent / "proto"):
        if (root / "coseg" / "v1").is_dir():
            return root
    raise SystemExit("coseg: the folder proto/coseg/v1 is neither here nor two folders above")


def generate(out: Path) -> None:
    """Writes coseg/v1/*_pb2.py and their types below `out`."""
    root = proto_root()
    files = sorted(str(path) for path in (root / "coseg" / "v1").glob("*.proto"))
    command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{root}"]
    out.mkdir(parents=True, exist_ok=True)
    subprocess.run([*command, f"--python_out={out}", f"--pyi_out={out}", *files], check=True)
    (out / "coseg" / "v1" / "__init__.py").write_text('"""The messages of the protocol."""\n')


class BuildWithMessages(build_py):
    """Makes the messages where the package is put together.

    They are no part of the source tree: what is looked for there may be looked for before they are made.
    """

    def run(self) -> None:
        super().run()
        # An editable install is the source tree itself.
        generate(HERE / "src" if self.editable_mode else Path(self.build_lib))


class ArchiveWithProtocol(sdist):
    """Packs the protocol's files too, for there is no repository around an archive."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        shutil.copytree(proto_root(), Path(base_dir) / "proto", dirs_exist_ok=True)


if __name__ == "__main__":
    setup(cmdclass={"build_py": BuildWithMessages, "sdist": ArchiveWithProtocol})
