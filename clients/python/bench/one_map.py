"""One map: `lib.map(a, b)` against pyFM's fit and ZoomOut, in one run, in turn.

    pip install pyfmaps==1.3.1 ./clients/python
    python clients/python/bench/one_map.py BINARY cat-00.off lion-00.off [TRUTH]

The meshes are those of pyFM's example. Both have what can be had beforehand: shapes are in the library,
with their spectra; pyFM has processed its meshes (k = 200) and descriptors. Timed is one call after the
other, blocking, with the map as numpy arrays at its end. TRUTH has for each vertex of the second mesh one
of the first; with it the error of pyFM's map is printed as well, as the mean geodesic error in units of
the square root of the area.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from pyFM.functional import FunctionalMapping
from pyFM.mesh import TriMesh

import coseg

ROUNDS = 3


def seconds(work: object) -> float:
    assert callable(work)
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def main() -> None:
    """Prints one JSON object."""
    warnings.simplefilter("ignore")
    binary, first, second = (str(Path(p).resolve()) for p in sys.argv[1:4])
    names = [Path(p).stem for p in (first, second)]
    figures: dict[str, list[float]] = {}

    def note(what: str, value: float) -> None:
        figures.setdefault(what, []).append(value)

    meshes = []
    for path in (first, second):
        mesh = TriMesh.load(path, area_normalize=True, center=True)
        note("pyFM: process(k=200) of one mesh, s", seconds(lambda mesh=mesh: mesh.process(k=200)))
        meshes.append(mesh)
    model = FunctionalMapping(*meshes)
    # As in its README.
    model.preprocess(descr_type="WKS", subsample_step=2, k_process=200)
    weights = {"w_descr": 1e0, "w_lap": 1e-1, "w_dcomm": 1e0, "w_orient": 1e0}
    env = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")} | {"COSEG__LOG__LEVEL": "error"}
    with tempfile.TemporaryDirectory(prefix="coseg") as folder:
        endpoint = f"ipc://{folder}/s"
        command = [binary, "serve", "--library", f"{folder}/library", "--endpoint", endpoint]
        daemon = subprocess.Popen(command, env=env)
        try:
            with coseg.Library(endpoint, timeout=120) as lib:
                note("coseg: both shapes added and labelled, s", seconds(lambda: add(lib, [first, second])))
                for _ in range(ROUNDS):

                    def fit() -> None:
                        model.fit(K=30, **weights, verbose=False)

                    def zoomout() -> None:
                        model.FM = model.zoomout_refine(nit=16, step=5, verbose=False)
                        figures_p2p.append(model.get_p2p(model.FM))

                    def back() -> None:
                        lib.map(*names[::-1], resolution="proxy")

                    figures_p2p: list[np.ndarray] = []
                    note("pyFM: fit, s", seconds(fit))
                    note("pyFM: ZoomOut to 110 and the pointwise map, s", seconds(zoomout))
                    note("coseg: lib.map, s", seconds(lambda: lib.map(*names, resolution="proxy")))
                    note("coseg: the same at all vertices, s", seconds(lambda: lib.map(*names)))
                    note("coseg: lib.map the other way, s", seconds(back))
        finally:
            daemon.kill()
            daemon.wait()
    out = {k: [round(x, 4) for x in v] for k, v in figures.items()}
    theirs = np.median(
        np.add(figures["pyFM: fit, s"], figures["pyFM: ZoomOut to 110 and the pointwise map, s"])
    )
    ours = np.median(figures["coseg: lib.map, s"])
    print(
        json.dumps(
            out
            | {"medians: pyFM, coseg, quotient": [round(float(x), 4) for x in (theirs, ours, theirs / ours)]},
            indent=1,
        )
    )
    if len(sys.argv) > 4:
        truth = np.loadtxt(sys.argv[4], dtype=int)
        distance = meshes[0].geodesic_matrix(method="dijkstra")
        error = distance[figures_p2p[-1], truth].mean() / np.sqrt(meshes[0].area)
        print(f"mean geodesic error of pyFM's map: {error:.3f}")


def add(lib: coseg.Library, paths: list[str]) -> None:
    pair = lib.collection("pair")
    assert all(added.ok for added in pair.add_many(paths))
    pair.wait_idle()


if __name__ == "__main__":
    main()
