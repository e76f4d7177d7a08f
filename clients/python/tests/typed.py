# pyright: strict
"""What a program with strict types may write; checked by mypy and pyright, not run."""

import numpy as np
from numpy.typing import NDArray

import coseg
from coseg import geometry as g

mesh = coseg.Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
s: g.Spectrum = mesh.spectrum(3, progress=lambda stage, done, expected: print(stage, done, expected))
values: NDArray[np.float64] = s.hks()
f: g.FunctionalMap = coseg.functional_map(s, mesh, orientation="keep")
vertex = int(f.p2p_21[0])
c: NDArray[np.float64] = g.zoomout(s, s, f.c_12, step=1, rounds=1)
found = g.pointwise(s, s, c, direction="1->2", exact=True)
print(f.quality.coverage, f.transfer(values, on="vertices"), mesh.clean().report["n_polygons"])
print(mesh.segment(2).max(), mesh.describe().hks.mean(), s.certificate.is_proved, s.mesh)
mesh.picture(values[:, 0]).save("picture.png")
try:
    coseg.read_mesh("none.off")
except coseg.ParseError as error:
    print(error.kind, error.line)
