"""Consistent labels, spectra and functional maps of 3D shapes.

With meshes of your own, in this process (:mod:`coseg.geometry`):

>>> import coseg
>>> cat, lion = coseg.read_mesh("cat.off"), coseg.read_mesh("lion.off")    # doctest: +SKIP
>>> cat.spectrum(k=300).eigenvalues                                        # doctest: +SKIP
>>> coseg.functional_map(cat, lion).p2p_21                                 # doctest: +SKIP

By a bundle that ``coseg publish`` wrote, without a daemon (:func:`label`):

>>> coseg.label("cat.off", "animals.coseg").labels                         # doctest: +SKIP

With a daemon that keeps a library of shapes labelled:

>>> lib = coseg.Library()                                   # doctest: +SKIP
>>> chairs = lib.collection("chairs", parts=4, up="+y")     # doctest: +SKIP
>>> chairs.add("101", "meshes/101.off")                     # doctest: +SKIP
>>> chairs.labels("101")          # int32, one for each face of the file   # doctest: +SKIP

:class:`AsyncLibrary` and :class:`AsyncCollection` are the same for asyncio.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from coseg._async_client import AsyncCollection, AsyncLibrary
from coseg._batch import Item
from coseg._bundle import label, label_all
from coseg._client import Collection, Library
from coseg._options import Curve, default_endpoint
from coseg._wire import MeshLike
from coseg.errors import (
    AlreadyExists,
    BadMesh,
    BadReply,
    Cancelled,
    CleanError,
    CosegError,
    DataLoss,
    DeadlineExceeded,
    EventLogRewound,
    FailedPrecondition,
    GeometryError,
    Internal,
    InvalidArgument,
    LaplacianError,
    NoAnswer,
    NotFound,
    ParseError,
    PermissionDenied,
    Refused,
    ResourceExhausted,
    SolveError,
    SpectrumError,
)
from coseg.types import (
    Added,
    BundleFile,
    BundleHead,
    Carrying,
    ChangedLabel,
    Chosen,
    CollectionInfo,
    Corrected,
    Descriptors,
    Encoded,
    Event,
    FunctionalMap,
    Hello,
    Idle,
    Job,
    JobItem,
    Label,
    LabelledMesh,
    Labelling,
    Limits,
    Link,
    Linked,
    MapAgreement,
    MapQuality,
    Neighbor,
    Part,
    PartMatch,
    PartMatches,
    Proposal,
    Proposals,
    Published,
    RetriedJob,
    Shape,
    Snapshot,
    Source,
    Spectrum,
    Suggestion,
    Transferred,
    Undone,
    Unlinked,
    Updated,
    UpEstimate,
)

if TYPE_CHECKING:
    from coseg.geometry import Mesh, functional_map, read_mesh

__version__ = "0.1.0"
__all__ = [
    "Added",
    "AlreadyExists",
    "AsyncCollection",
    "AsyncLibrary",
    "BadMesh",
    "BadReply",
    "BundleFile",
    "BundleHead",
    "Cancelled",
    "Carrying",
    "ChangedLabel",
    "Chosen",
    "CleanError",
    "Collection",
    "CollectionInfo",
    "Corrected",
    "CosegError",
    "Curve",
    "DataLoss",
    "DeadlineExceeded",
    "Descriptors",
    "Encoded",
    "Event",
    "EventLogRewound",
    "FailedPrecondition",
    "FunctionalMap",
    "GeometryError",
    "Hello",
    "Idle",
    "Internal",
    "InvalidArgument",
    "Item",
    "Job",
    "JobItem",
    "Label",
    "LabelledMesh",
    "Labelling",
    "LaplacianError",
    "Library",
    "Limits",
    "Link",
    "Linked",
    "MapAgreement",
    "MapQuality",
    "Mesh",
    "MeshLike",
    "Neighbor",
    "NoAnswer",
    "NotFound",
    "ParseError",
    "Part",
    "PartMatch",
    "PartMatches",
    "PermissionDenied",
    "Proposal",
    "Proposals",
    "Published",
    "Refused",
    "ResourceExhausted",
    "RetriedJob",
    "Shape",
    "Snapshot",
    "SolveError",
    "Source",
    "Spectrum",
    "SpectrumError",
    "Suggestion",
    "Transferred",
    "Undone",
    "Unlinked",
    "UpEstimate",
    "Updated",
    "default_endpoint",
    "functional_map",
    "label",
    "label_all",
    "read_mesh",
]


def __getattr__(name: str) -> Any:
    # Loaded when it is used: a client of a daemon needs no native module.
    if name in ("Mesh", "functional_map", "read_mesh"):
        from coseg import geometry

        return getattr(geometry, name)
    raise AttributeError(f"module 'coseg' has no attribute {name!r}")
