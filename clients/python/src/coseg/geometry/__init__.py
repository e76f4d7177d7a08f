"""Spectra, descriptors and functional maps of meshes of your own, in this process.

>>> import coseg
>>> cat, lion = coseg.read_mesh("cat.off"), coseg.read_mesh("lion.off")    # doctest: +SKIP
>>> s = cat.spectrum(k=300)             # proved complete                  # doctest: +SKIP
>>> h, w = s.hks(), s.wks()             # (n, 100) each                    # doctest: +SKIP
>>> f = coseg.functional_map(cat, lion)                                    # doctest: +SKIP
>>> f.transfer(h)                       # at the vertices of the lion      # doctest: +SKIP

Arrays are of the meshes as given: nothing is simplified, welded or renumbered. The same input gives
the same output on any number of threads. Long calls leave the interpreter to other threads, and
Ctrl-C ends them. Every error is a :class:`coseg.GeometryError` that names the face or vertex.
"""

from coseg._pixels import Picture
from coseg.geometry._blocks import (
    fit,
    functional,
    icp,
    landmark_probes,
    pointwise,
    precise,
    signature_probes,
    zoomout,
)
from coseg.geometry._description import Description
from coseg.geometry._geodesics import Geodesics
from coseg.geometry._maps import FunctionalMap, MapQuality, functional_map
from coseg.geometry._mesh import Cleaned, Mesh, read_mesh
from coseg.geometry._operators import Laplacian
from coseg.geometry._precise import PreciseMap
from coseg.geometry._spectrum import Certificate, Spectrum, spectrum

__all__ = [
    "Certificate",
    "Cleaned",
    "Description",
    "FunctionalMap",
    "Geodesics",
    "Laplacian",
    "MapQuality",
    "Mesh",
    "Picture",
    "PreciseMap",
    "Spectrum",
    "fit",
    "functional",
    "functional_map",
    "icp",
    "landmark_probes",
    "pointwise",
    "precise",
    "read_mesh",
    "signature_probes",
    "spectrum",
    "zoomout",
]
