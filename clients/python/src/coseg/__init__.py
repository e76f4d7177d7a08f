"""Client of the coseg daemon: consistent labels, spectra and functional maps of 3D shapes.

>>> import coseg
>>> lib = coseg.Library()                                   # doctest: +SKIP
>>> chairs = lib.collection("chairs", parts=4, up="+y")     # doctest: +SKIP
>>> chairs.add("101", "meshes/101.off")                     # doctest: +SKIP
>>> chairs.labels("101")          # int32, one for each face of the file   # doctest: +SKIP

:class:`AsyncLibrary` and :class:`AsyncCollection` are the same for asyncio.
"""

from coseg._async_client import AsyncCollection, AsyncLibrary
from coseg._batch import Item
from coseg._client import Collection, Library
from coseg._options import Curve, default_endpoint
from coseg._wire import Mesh
from coseg.errors import (
    AlreadyExists,
    BadMesh,
    BadReply,
    Cancelled,
    CosegError,
    DataLoss,
    DeadlineExceeded,
    EventLogRewound,
    FailedPrecondition,
    Internal,
    InvalidArgument,
    NoAnswer,
    NotFound,
    PermissionDenied,
    Refused,
    ResourceExhausted,
)
from coseg.types import (
    Added,
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
    Labelling,
    Limits,
    MapQuality,
    Neighbor,
    Part,
    PartMatch,
    PartMatches,
    Shape,
    Snapshot,
    Source,
    Spectrum,
    Suggestion,
    Undone,
)

__version__ = "0.1.0"
__all__ = [
    "Added",
    "AlreadyExists",
    "AsyncCollection",
    "AsyncLibrary",
    "BadMesh",
    "BadReply",
    "Cancelled",
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
    "Hello",
    "Idle",
    "Internal",
    "InvalidArgument",
    "Item",
    "Job",
    "JobItem",
    "Label",
    "Labelling",
    "Library",
    "Limits",
    "MapQuality",
    "Mesh",
    "Neighbor",
    "NoAnswer",
    "NotFound",
    "Part",
    "PartMatch",
    "PartMatches",
    "PermissionDenied",
    "Refused",
    "ResourceExhausted",
    "Shape",
    "Snapshot",
    "Source",
    "Spectrum",
    "Suggestion",
    "Undone",
    "default_endpoint",
]
