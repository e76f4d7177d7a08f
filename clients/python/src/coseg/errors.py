"""What can go wrong: every failure is a :class:`CosegError`.

A refusal by the daemon is a :class:`Refused` of the class that belongs to its code, so that
``except coseg.NotFound`` does what it says.
"""

from __future__ import annotations

from typing import ClassVar

from coseg.v1 import error_pb2


class CosegError(Exception):
    """Anything that this package raises by itself."""


class NoAnswer(CosegError, TimeoutError):
    """No sign of life from a daemon at the endpoint for as long as was asked to wait."""

    def __init__(self, endpoint: str, timeout: float) -> None:
        super().__init__(f"no answer from {endpoint} within {timeout:g} s; is a daemon running there?")
        self.endpoint = endpoint
        self.timeout = timeout


class BadReply(CosegError):
    """The daemon's reply cannot be understood."""


class BadMesh(CosegError, ValueError):
    """What was given as a mesh is none; nothing was sent."""


class GeometryError(CosegError, ValueError):
    """A mesh, or what was asked of it, has no answer; raised in this process, not by a daemon."""

    #: Name of the case, such as ``"VertexOutOfRange"`` or ``"NotConverged"``.
    kind: str
    #: For people: the value and the limit.
    message: str
    #: Face of the mesh, from 0.
    face: int | None = None
    #: Vertex of the mesh, from 0.
    vertex: int | None = None
    #: Line of the text file, from 1.
    line: int | None = None

    def __init__(self, kind: str, message: str, location: dict[str, int] | None = None) -> None:
        super().__init__(message)
        self.kind, self.message = kind, message
        self._location = location or {}
        for name, index in self._location.items():
            setattr(self, name, index)

    def __reduce__(self) -> tuple[type[GeometryError], tuple[str, str, dict[str, int]]]:
        return type(self), (self.kind, self.message, self._location)


class ParseError(GeometryError):
    """A file is no mesh."""


class CleanError(GeometryError):
    """No triangle of a mesh can be measured."""


class LaplacianError(GeometryError):
    """A mesh has no Laplacian; ``mesh.clean()`` mends what can be mended."""


class SpectrumError(GeometryError):
    """There is no spectrum, or it could not be proved complete."""


class SolveError(GeometryError):
    """Functions and weights do not determine a map."""


class EventLogRewound(CosegError):
    """A collection's log ends before events that were seen: another library is served there now."""


class Refused(CosegError):
    """The daemon refused a request, or one shape of a job."""

    #: Name of the code, such as ``"NOT_FOUND"``.
    code: str
    #: Name of the reason within the code, such as ``"NO_SHAPE"``; values are only ever added.
    reason: str
    #: For people: the value and the limit.
    message: str
    #: Path of the field of the request, such as ``"shapes[3].name"``.
    field: str | None = None
    #: Face (polygon) of the mesh, from 0.
    face: int | None = None
    #: Vertex of the mesh, from 0.
    vertex: int | None = None
    #: Offset in bytes into the file.
    byte_offset: int | None = None
    #: Line of the text file, from 1.
    line: int | None = None
    #: The job that goes on although the request's deadline passed.
    job_id: int | None = None
    #: Seconds after which the same request may succeed; ``None``: repeating it is useless.
    retry_after: float | None = None

    _classes: ClassVar[dict[str, type[Refused]]] = {}

    def __init_subclass__(cls) -> None:
        name = "".join("_" + c if c.isupper() else c.upper() for c in cls.__name__).lstrip("_")
        Refused._classes[name] = cls

    def __init__(self, code: str, reason: str, message: str) -> None:
        super().__init__(f"{message} ({code}/{reason})")
        self.code, self.reason, self.message = code, reason, message

    @staticmethod
    def of(code: str, reason: str, message: str) -> Refused:
        """The exception for a code."""
        return Refused._classes.get(code, Refused)(code, reason, message)

    @staticmethod
    def from_wire(error: error_pb2.Error) -> Refused:
        """The exception for an error of the protocol."""
        code = _name(error_pb2.ErrorCode, "ERROR_CODE_", error.code)
        reason = _name(error_pb2.ErrorReason, "ERROR_REASON_", error.reason)
        refused = Refused.of(code, reason, error.message)
        subject = error.WhichOneof("subject")
        if subject is not None:
            setattr(refused, subject, getattr(error, subject))
        if error.retry_after_ms:
            refused.retry_after = error.retry_after_ms / 1000
        return refused


def _name(enum: object, prefix: str, value: int) -> str:
    # A newer daemon may send values that this version does not know.
    known = enum.DESCRIPTOR.values_by_number.get(value)  # type: ignore[attr-defined]
    return str(known.name).removeprefix(prefix) if known else str(value)


class InvalidArgument(Refused):
    """The request or the mesh is wrong, whatever the state of the library."""


class NotFound(Refused):
    """What the request names does not exist."""


class AlreadyExists(Refused):
    """What the request would create exists and differs."""


class FailedPrecondition(Refused):
    """The request is right, but not in this state of the library or the daemon."""


class ResourceExhausted(Refused):
    """The daemon is at a limit; see ``retry_after``."""


class DeadlineExceeded(Refused):
    """The request's deadline passed; a change that was begun still happens."""


class Cancelled(Refused):
    """A client cancelled the work."""


class PermissionDenied(Refused):
    """The configuration, the transport or the client's role does not allow it."""


class DataLoss(Refused):
    """Stored data is damaged: ``coseg check`` names it."""


class Internal(Refused):
    """A fault of the daemon."""
