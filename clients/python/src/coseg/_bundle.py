"""Labels meshes by a bundle, without a daemon: runs ``coseg label`` of the binary in the wheel."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from coseg import _wire as wire
from coseg import types as t
from coseg._wire import MeshLike
from coseg.errors import BadMesh, CosegError, NotFound, Refused

#: Names the binary in place of the one that was installed with this package.
BINARY_VARIABLE = "COSEG_BIN"
#: Exit codes of ``coseg label`` that come with a result.
_WITH_RESULT = (0, 1)


def label(mesh: MeshLike, bundle: str | os.PathLike[str], *, threads: int | None = None) -> t.LabelledMesh:
    """The labels that a daemon would give to ``mesh`` if it arrived when ``bundle`` was published.

    ``bundle`` is a file of ``coseg publish`` or :meth:`Collection.publish`. No daemon is asked and
    nothing is written but temporary files. Labels are one int32 for each face of the mesh, in its
    order. Raises :class:`BadMesh` or :class:`Refused` if the mesh cannot be labelled, and
    :class:`CosegError` if the bundle cannot be used. Opening the bundle takes some hundredths of a second
    each time: :func:`label_all` opens it once.
    """
    found = label_all({"mesh": mesh}, bundle, threads=threads)["mesh"]
    if isinstance(found, CosegError):
        raise found
    return found


def label_all(
    meshes: Mapping[str, MeshLike] | Iterable[tuple[str, MeshLike]],
    bundle: str | os.PathLike[str],
    *,
    threads: int | None = None,
) -> dict[str, t.LabelledMesh | CosegError]:
    """Labels named meshes as :func:`label` does, on all processors or on ``threads``.

    A mesh that cannot be labelled costs only itself: its value is the error.
    """
    named = list(meshes.items()) if isinstance(meshes, Mapping) else list(meshes)
    found: dict[str, t.LabelledMesh | CosegError] = {}
    with tempfile.TemporaryDirectory(prefix="coseg-label-") as folder:
        out = Path(folder) / "out"
        files: dict[str, Path] = {}
        for at, (name, mesh) in enumerate(named):
            if name in files or name in found:
                raise ValueError(f"two meshes are named {name!r}")
            try:
                files[name] = _file(mesh, Path(folder) / f"{at}")
            except (BadMesh, OSError) as e:
                found[name] = e if isinstance(e, BadMesh) else BadMesh(f"{name}: {e}")
        if files:
            rows = _run(list(files.values()), bundle, out, threads)
            for name, path in files.items():
                row = rows[path.stem]
                error = row.get("error")
                found[name] = _read(out, path.stem) if error is None else _refused(error)
    return {name: found[name] for name, _ in named}


def _file(mesh: MeshLike, stem: Path) -> Path:
    """Writes a mesh to a file as the daemon stores it."""
    writer = wire.FrameWriter()
    shape = wire.shape_input("mesh", mesh, False, writer)
    if shape.WhichOneof("source") == "encoded":
        path = stem.with_suffix(f".{_suffix(shape.encoded.format)}")
        path.write_bytes(writer.frames[shape.encoded.bytes.frame])
        return path
    arrays = shape.arrays
    vertices, faces = (_array(writer, ref) for ref in (arrays.vertices, arrays.faces))
    lines = ["OFF", f"{len(vertices)} {len(faces)} 0"]
    # The shortest decimals that are read as the same bits.
    lines += [" ".join(map(_decimal, row)) for row in vertices.astype(np.float64)]
    lines += [f"{len(row)} " + " ".join(map(str, row)) for row in faces.tolist()]
    path = stem.with_suffix(".off")
    path.write_text("\n".join(lines) + "\n")
    return path


def _decimal(x: np.float64) -> str:
    return np.format_float_positional(x, unique=True, trim="-")


def _suffix(format: Any) -> str:
    return {"gltf": "glb"}.get(name := wire.format_name(format), name)


def _array(writer: wire.FrameWriter, ref: Any) -> np.ndarray[Any, Any]:
    dtype = wire.dtype_of(ref.dtype)
    return np.frombuffer(writer.frames[ref.frame], dtype).reshape(tuple(ref.shape))


def _run(
    files: list[Path], bundle: str | os.PathLike[str], out: Path, threads: int | None
) -> dict[str, dict[str, Any]]:
    command = [_binary(), "label", "--json", "--format", "npy", "--confidence"]
    command += ["--bundle", os.fspath(bundle), "--out", str(out)]
    command += [] if threads is None else ["--threads", str(threads)]
    # Names of files can be more than a command line holds; a folder has any number.
    command.append(str(files[0].parent))
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in _WITH_RESULT or not done.stdout:
        said = done.stderr.strip().removeprefix("coseg: ")
        raise CosegError(said or f"coseg label ended with {done.returncode}")
    return {row["name"]: row for row in json.loads(done.stdout)["shapes"]}


def _read(out: Path, stem: str) -> t.LabelledMesh:
    report = json.loads((out / f"{stem}.report.json").read_text())
    parts = tuple(t.Part(**part) for part in report["parts"])
    sources = tuple(t.Source(**source) for source in report["sources"])
    return t.LabelledMesh(
        labels=np.load(out / f"{stem}.labels.npy").astype(np.int32, copy=False),
        confidence=np.asarray(report["confidence"], np.float32),
        parts=parts,
        missing=tuple(report["missing"]),
        sources=sources,
        report=report["report"],
        area=report["area"],
        content_digest=report["content_digest"],
        n_maps=report["n_maps"],
        reclustered=report["reclustered"],
        bundle=report["bundle"],
        same_processor=report["same_processor"],
    )


def _refused(error: dict[str, str]) -> CosegError:
    return Refused.of(error["code"], error["reason"], error["message"])


def _binary() -> str:
    """The binary ``coseg``: that of the environment, or the installed one."""
    if given := os.environ.get(BINARY_VARIABLE):
        return given
    beside = [sysconfig.get_path("scripts"), str(Path(sys.executable).parent)]
    for folder in beside:
        path = Path(folder) / "coseg"
        if os.access(path, os.X_OK):
            return str(path)
    if found := shutil.which("coseg"):
        return found
    raise NotFound(
        "NOT_FOUND", "UNSPECIFIED", f"no binary coseg is installed; install it, or set {BINARY_VARIABLE}"
    )
