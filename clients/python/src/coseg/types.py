"""What the daemon tells, as plain values. Arrays are numpy arrays of the caller's own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from coseg import _html

Int32 = NDArray[np.int32]
UInt32 = NDArray[np.uint32]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Element = TypeVar("Element", bound=np.generic)

#: What the rows of an array are of: vertices of the mesh as it was sent, its faces, or vertices of the
#: working mesh.
Resolution = Literal["input", "input_faces", "proxy"]
#: Which vertices landmarks are: of the mesh as it was sent, or of the working mesh.
LandmarkResolution = Literal["input", "proxy"]
#: The rows in words.
ROWS: Mapping[str, str] = {
    "input": "vertex of the mesh as it was sent",
    "input_faces": "face of the mesh as it was sent",
    "proxy": "vertex of the working mesh",
}


@dataclass(frozen=True)
class Limits:
    """What the daemon refuses beyond."""

    max_message_bytes: int
    max_frames: int
    max_header_bytes: int
    max_shapes_per_request: int
    max_shape_bytes: int
    max_queued_shapes: int
    max_page: int
    max_wait_ms: int
    max_id_chars: int


@dataclass(frozen=True)
class Hello:
    """Who the daemon is."""

    version: str
    protocol: str
    #: Differs between any two starts of a daemon.
    instance: str
    event_endpoint: str
    #: File formats it reads, such as ``"off"``.
    formats: tuple[str, ...]
    capabilities: tuple[str, ...]
    limits: Limits


@dataclass(frozen=True)
class Label:
    """A label of a collection."""

    id: int
    #: The name a person gave; empty: none.
    name: str
    #: sRGB colour, 0xRRGGBB.
    colour_rgb: int
    #: The label this one was merged into; ``None`` while it is in use.
    merged_into: int | None
    #: Shapes that carry it; 0: out of use.
    n_shapes: int
    #: Mean over all shapes of the share of their area that has it, 0 to 1.
    area_share: float
    #: Whether it is a discovered label that no labelled shape shows, and that nobody has named.
    unclaimed: bool


@dataclass(frozen=True)
class ChangedLabel(Label):
    """A label after a merge or a split."""

    #: Shapes whose labels changed at once.
    n_changed: int


@dataclass(frozen=True)
class UpEstimate:
    """An estimate of which way is up."""

    #: Such as ``"+y"``; ``"unknown"`` if fewer than half of the shapes agree on one: then none is used.
    up: str
    #: Share of the shapes that stand best along the axis that most do; by chance a sixth.
    agreement: float


@dataclass(frozen=True)
class ReviewCounts:
    """Numbers of shapes by the verdict of persons on their labels."""

    unseen: int = 0
    corrected: int = 0
    approved: int = 0
    doubtful: int = 0


@dataclass(frozen=True)
class CollectionInfo:
    """A collection as it stands."""

    name: str
    #: Number of part kinds; 0: estimated.
    n_parts: int
    up: str
    operator: str
    working_faces: int
    #: Number of its newest event.
    sequence: int
    n_shapes: int
    #: Shapes whose labels wait to be recomputed.
    n_stale: int
    labels: tuple[Label, ...]
    #: With ``up="auto"``, once there are shapes.
    up_estimate: UpEstimate | None = None
    #: Set if the up axis is given and at least half of the shapes stand clearly better along one other
    #: axis: that one. The given one is probably a mistake, which ``collection.set(up=...)`` corrects.
    up_disagrees: UpEstimate | None = None
    #: Changes by a person that ``undo`` can take back.
    n_undoable: int = 0
    #: Shapes by the verdict of persons.
    reviews: ReviewCounts = ReviewCounts()

    def _repr_html_(self) -> str:
        return _html.collection(self)


@dataclass(frozen=True)
class Updated:
    """What became of a change of a collection's settings."""

    #: Whether it was another one before; if not, nothing was done.
    changed: bool
    #: Shapes whose labels wait to be recomputed.
    n_stale: int
    #: Number of the collection's newest event after it.
    sequence: int


@dataclass(frozen=True)
class Part:
    """A connected piece of a shape with one label."""

    label: int
    area_share: float
    confidence: float


@dataclass(frozen=True)
class Source:
    """A shape that labels were carried from."""

    shape: str
    version: int
    weight: float


@dataclass(frozen=True)
class LabelledMesh:
    """The labels of a mesh by a bundle: those that the daemon would have given to it then."""

    #: (n,) label of each face of the mesh, in its order.
    labels: Int32
    #: (n,) probability of the label of each face, 0 to 1.
    confidence: Float32
    #: Connected pieces of one label, largest first.
    parts: tuple[Part, ...]
    #: Labels in use in the collection that no face has, in ascending order.
    missing: tuple[int, ...]
    #: The shapes that voted for the labels.
    sources: tuple[Source, ...]
    #: What cleaning found and did, by name.
    report: dict[str, int]
    #: Surface area in squared input units.
    area: float
    #: BLAKE3 of the file, hexadecimal.
    content_digest: str
    #: Number of functional maps that were computed.
    n_maps: int
    #: If the mesh clustered the collection again: whether the labels that were found are new ones.
    reclustered: bool | None
    #: Names the content of the bundle.
    bundle: str
    #: Whether the bundle was published on this kind of processor.
    same_processor: bool


@dataclass(frozen=True)
class BundleFile:
    """An array file that a bundle contains."""

    #: The shape that it describes.
    shape: str
    #: BLAKE3 of the file, hexadecimal.
    blake3: str
    #: Its bytes.
    length: int


@dataclass(frozen=True)
class BundleHead:
    """The beginning of a bundle, and the array files that follow it."""

    #: The bytes.
    head: bytes
    #: The array files in their order, each followed by zeros up to a multiple of 64 bytes.
    files: tuple[BundleFile, ...]
    #: Names the content of the bundle.
    bundle: str
    #: Sequence number of the collection.
    sequence: int
    #: Epoch of its labels.
    epoch: int
    #: Bytes of the whole bundle.
    n_bytes: int
    #: Whether the next shape clusters the collection again, perhaps with other labels than now.
    clusters_next: bool


@dataclass(frozen=True)
class Published:
    """A bundle that was written."""

    #: Names the content of the bundle.
    bundle: str
    #: Sequence number of the collection.
    sequence: int
    #: Epoch of its labels.
    epoch: int
    #: Bytes of the file.
    n_bytes: int
    #: Whether the next shape clusters the collection again, perhaps with other labels than now.
    clusters_next: bool


@dataclass(frozen=True)
class Review:
    """A person's verdict on the labels of a shape: ``"unseen"``, ``"corrected"``, ``"approved"`` or
    ``"doubtful"``."""

    state: str
    #: Who gave it; may be empty.
    by: str
    #: When, in milliseconds since 1970; 0: unknown.
    unix_ms: int


@dataclass(frozen=True)
class Shape:
    """A shape as it stands."""

    name: str
    #: Position in the order of arrival, from 1; never reused.
    ordinal: int
    #: Version of its labels, from 1.
    version: int
    #: Whether its labels wait to be recomputed.
    stale: bool
    #: Polygons of the input.
    n_polygons: int
    area: float
    #: BLAKE3 of the original bytes, hexadecimal.
    content_digest: str
    stored_bytes: int
    #: What cleaning found and did: counts by name, such as ``"n_boundary_edges"``.
    report: Mapping[str, object]
    parts: tuple[Part, ...]
    sources: tuple[Source, ...]
    review: Review

    def _repr_html_(self) -> str:
        return _html.shape(self)


@dataclass(frozen=True)
class Labelling:
    """The labels of a shape, one for each face of its file, in the file's order."""

    version: int
    #: (n_polygons,) label, −1: unlabelled.
    labels: Int32
    #: (n_polygons,) probability of the label, if it was asked for.
    confidence: Float32 | None = None

    def _repr_html_(self) -> str:
        return _html.labelling(self)


@dataclass(frozen=True)
class Encoded:
    """The bytes of a mesh file and their format, such as ``"off"``."""

    format: str
    data: bytes


@dataclass(frozen=True)
class Added:
    """What became of one shape that was added."""

    name: str
    #: ``"added"``, ``"unchanged"``, ``"replaced"``, ``"failed"`` or ``"cancelled"``.
    outcome: str
    #: Why it failed.
    error: Exception | None = None
    #: Version of its labels.
    version: int = 0
    #: Number of the collection's newest event after it.
    sequence: int = 0
    #: Functional maps that were computed for it.
    n_maps: int = 0
    #: Stored shapes whose labels were recomputed with it.
    n_relabelled: int = 0
    #: Of the maps those that do not agree with the maps between the shapes they come from.
    n_inconsistent: int = 0
    #: Milliseconds by stage, in order.
    stages: Mapping[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Whether the shape is in the collection."""
        return self.outcome in ("added", "unchanged", "replaced")


@dataclass(frozen=True)
class JobItem:
    """One shape of a job."""

    #: Position in the job, from 0.
    index: int
    name: str
    #: ``"queued"``, ``"running"``, ``"done"``, ``"failed"`` or ``"cancelled"``.
    state: str
    #: While it is running: the stage.
    stage: str
    #: When it is over: what became of it.
    result: Added | None
    #: How often the work on it ended its worker process so far; after 3 times it has failed.
    attempts: int


@dataclass(frozen=True)
class Carrying:
    """How far a correction is carried to the other shapes of its collection."""

    #: Shapes to which it is carried; 0 once a later change has taken its place.
    n_shapes: int
    #: Those that wait for it.
    n_left: int


@dataclass(frozen=True)
class Job:
    """Shapes that were accepted together, or a correction that is carried to the other shapes."""

    id: int
    collection: str
    items: tuple[JobItem, ...]
    #: Changes with every change of the job.
    revision: int
    finished: bool
    #: Share that is done, 0 to 1.
    progress: float
    #: Where a correction is carried: how far that is.
    carrying: Carrying | None = None


@dataclass(frozen=True, kw_only=True)
class RetriedJob(Job):
    """A job whose failed shapes were queued again."""

    #: How many were.
    n_queued: int


@dataclass(frozen=True)
class Spectrum:
    """Eigenpairs of W φ = λ A φ on a shape's working mesh, scaled to area 1; rows as asked for."""

    #: (k,) ascending, 0 included. In input units: divide by ``area``.
    eigenvalues: Float64
    #: (n, b) the first b ≤ k eigenvectors as columns, mass-orthonormal on the working mesh.
    eigenvectors: Float32 | None
    #: (n,) lumped mass of each row; sums to 1.
    mass: Float32 | None
    #: Surface area in squared input units.
    area: float

    def _repr_html_(self) -> str:
        return _html.spectrum(self)


@dataclass(frozen=True)
class Descriptors:
    """The working mesh of a shape and what its segmentation is computed from."""

    #: (n, 3) centred, total area 1, in the input's orientation.
    vertices: Float32
    #: (m, 3).
    faces: UInt32
    #: (m, d).
    face_descriptors: Float32
    #: (m,) patch of each face.
    patches: UInt32
    #: (n_polygons,) for each polygon of the input its face here.
    face_map: UInt32
    #: (n_polygons,) share of the total area of each polygon of the input.
    polygon_area: Float32
    #: (g,) by which neighbours are ranked.
    signature: Float32

    def _repr_html_(self) -> str:
        return _html.descriptors(self)


@dataclass(frozen=True)
class MapQuality:
    """How good a functional map is."""

    #: Mean squared descriptor difference between matched vertices.
    descriptor_residual: float
    #: ‖CᵀC − I‖ / √k; 0 for an isometry.
    orthogonality: float
    #: Share of the source's area that is hit.
    coverage: float
    #: Share of the entries of C with magnitude below 0.1.
    near_zero: float
    #: Of maps between points: mean distance between a vertex of the source and where it comes back to, in
    #: units of the square root of the area.
    round_trip: float | None = None
    #: Of maps between points: Dirichlet energy of the carried coordinates over that of the target's own;
    #: near 1 is smooth, large is torn.
    smoothness: float | None = None
    #: Of maps between points: −1 (reverses orientation) to 1 (keeps it).
    orientation: float | None = None
    #: Of maps between points: the mean geodesic error to expect, in units of the square root of the area,
    #: with a reflection of the whole forgiven.
    expected_error: float | None = None
    #: Share of the target's area to which something corresponds.
    matched: float | None = None
    #: Of maps for parts: mean squared descriptor difference between a vertex of the target and what its
    #: match is matched with; large where many vertices crowd onto one.
    descriptor_return: float | None = None
    #: Of maps for parts: share of the area on which a carried label is expected to be right.
    confidence: float | None = None


@dataclass(frozen=True)
class MapAgreement:
    """How a map agrees with those by way of other shapes of its collection."""

    #: Triangles of kept maps that it is part of; of fewer than 2 nothing follows.
    n_triangles: int
    #: Median over these of how far the map by way of the third shape is from the direct one; 0: the same,
    #: 1.4: nothing in common.
    departure: float
    #: Whether that is more than can be expected of maps of this collection.
    inconsistent: bool


@dataclass(frozen=True)
class FunctionalMap:
    """The map that carries functions on shape 1 to functions on shape 2."""

    source: str
    target: str
    #: (k2, k1) coefficients on shape 1 to coefficients on shape 2, in the bases of ``spectrum``.
    c_12: Float32
    #: (n2,) for each vertex of shape 2 one of shape 1; of what, :attr:`resolution` says.
    p2p_21: UInt32
    quality: MapQuality
    #: (n2,) whether something of shape 1 corresponds to each vertex of shape 2.
    matched: Bool
    #: Of maps for parts: (n2,) probability that a label carried there is right; 0 where nothing corresponds.
    confidence: Float32 | None = None
    #: Of maps for parts, if it was asked for: whether it agrees with the others of the collection.
    agreement: MapAgreement | None = None
    #: The best map of the other orientation, left for right, if it was asked for and there is one.
    alternative: FunctionalMap | None = None
    #: What that costs over what this one does: near 1, the shapes themselves hardly say which is meant.
    alternative_cost: float | None = None
    #: Vertices (or faces) of shape 1: so many values :meth:`carry` takes. 0: a daemon that does not say.
    n1: int = 0
    #: What ``p2p_21`` is of: ``"input"``, vertices of the meshes as they were sent, ``"input_faces"``, their
    #: faces, or ``"proxy"``, vertices of the working meshes.
    resolution: Resolution = "proxy"

    def carry(self, values: NDArray[Element]) -> NDArray[Element]:
        """Carries values at the vertices of shape 1, (n1, …), to those of shape 2, (n2, …): of the meshes
        that :attr:`resolution` says, or at their faces.

        Raises :class:`ValueError` if there are not n1 of them: values at something else, or of the other
        shape, would be carried without a word, and mean nothing.
        """
        array = np.asarray(values)
        n = len(array) if array.ndim else 0
        # Of a daemon that does not say how many there are, only that there are at least those that are named.
        least = self.n1 or int(self.p2p_21.max()) + 1
        if n < least or (self.n1 and n != self.n1):
            raise ValueError(
                f"values have {n} rows, but {self.source!r} has {least}, one for each "
                f"{ROWS[self.resolution]}; `hks` and `spectrum(…).eigenvectors` have as many with "
                f"resolution={self.resolution!r}"
            )
        carried: NDArray[Element] = array[self.p2p_21]
        return carried

    def _repr_html_(self) -> str:
        return _html.functional_map(self)


@dataclass(frozen=True)
class Transferred:
    """Values that were carried from the faces or vertices of one shape to those of another."""

    #: One row for each face or vertex of the target; −1 or NaN where nothing corresponds.
    values: np.ndarray[Any, Any]
    #: How good the map is that carried them.
    quality: MapQuality


@dataclass(frozen=True)
class PartMatch:
    """A pair of matching parts: indices into ``Shape.parts``, and their labels."""

    part_a: int
    part_b: int
    label_a: int
    label_b: int
    #: Intersection over union of their areas under the map.
    overlap: float


@dataclass(frozen=True)
class PartMatches:
    """Matching parts, largest overlap first, and how good the map is that says so."""

    matches: tuple[PartMatch, ...]
    quality: MapQuality


@dataclass(frozen=True)
class Neighbor:
    """A shape and how far it is; 0: equal."""

    shape: str
    distance: float


@dataclass(frozen=True)
class Corrected:
    """A correction that is durable."""

    version: int
    sequence: int
    #: Faces of the shape that a person labelled, now or before, and the share of its area.
    n_faces: int
    area_share: float
    #: Share of its area whose label changed.
    changed_share: float
    #: Shapes to which it is still to be carried.
    n_stale: int
    #: The job that carries it: ``lib.watch(job_id)`` tells how far it is.
    job_id: int


@dataclass(frozen=True)
class Link:
    """A link between two parts, each a shape and the number that its part had when it was linked."""

    id: int
    #: ``"same"`` or ``"differ"``: what it demands of the labels.
    kind: str
    a: tuple[str, int]
    b: tuple[str, int]
    #: Who made it; may be empty.
    by: str
    #: When, in milliseconds since 1970.
    unix_ms: int
    #: Whether the present labels are as demanded.
    holds: bool
    #: Whether labels that persons gave contradict it; then it demands nothing.
    overruled: bool


@dataclass(frozen=True)
class Linked:
    """A link that was made."""

    link: Link
    #: Whether anything changed: not if the same link was there.
    changed: bool
    #: Shapes whose labels wait to be recomputed.
    n_stale: int
    #: Number of the collection's newest event after it.
    sequence: int
    #: The job that propagates it; 0 if none does.
    job_id: int


@dataclass(frozen=True)
class Unlinked:
    """A link that was removed."""

    #: As it was.
    link: Link
    #: Shapes whose labels wait to be recomputed.
    n_stale: int
    #: Number of the collection's newest event after it.
    sequence: int
    #: The job that propagates it; 0 if none does.
    job_id: int


@dataclass(frozen=True)
class Undone:
    """What was undone: ``"correct"``, ``"answer"``, ``"approve"``, ``"doubt"``, ``"name"``,
    ``"merge"``, ``"split"``, ``"up"``, ``"choose"``, ``"same"``, ``"differ"`` or ``"unlink"``."""

    change: str
    #: What it changed: a shape, a label, an axis, a proposal or two parts.
    subject: str
    #: Changes that can still be undone.
    n_left: int
    sequence: int


@dataclass(frozen=True)
class Proposal:
    """A division of the shapes of a collection into labels, which a person can choose."""

    #: From 1, coarse to fine.
    n: int
    n_labels: int
    #: Its value among divisions with as many labels; higher is better.
    value: float
    #: Whether it is the labels in force.
    in_force: bool
    #: 1 minus the normalised mutual information with the labels in force; 0: the same division.
    differs: float


@dataclass(frozen=True)
class Proposals:
    """The proposals of a collection."""

    #: From coarse to fine; while new ones are made, the previous ones.
    proposals: tuple[Proposal, ...]
    #: Distinguishes them from those made before or later.
    set: str
    #: Steps of making new ones, and how many of them are done; both 0 if none are made.
    n_steps: int
    n_done: int
    #: Shapes that they divide.
    n_shapes: int
    #: Names of those that are still there, in the order of their arrival.
    shapes: tuple[str, ...]


@dataclass(frozen=True)
class Chosen:
    """What choosing a proposal did."""

    n_labels: int
    #: Shapes whose labels still follow from it.
    n_stale: int
    sequence: int


@dataclass(frozen=True)
class OfferedLabel:
    """A label that may be the answer to a question."""

    label: int
    #: Empty if it has none.
    name: str
    probability: float
    #: Whether a person has used it; if not, it was discovered.
    used: bool


@dataclass(frozen=True)
class Question:
    """The part whose label is worth most to ask a person for."""

    shape: str
    #: Its number among the parts into which questions divide the shape.
    part: int
    #: (n,) its polygons.
    faces: UInt32
    #: Its share of the shape's area.
    area_share: float
    #: Probability that its likeliest label is wrong.
    doubt: float
    #: Area that the answer is expected to decide, in shapes.
    gain: float
    likeliest: tuple[OfferedLabel, ...]
    #: Parts in which a person has labelled something.
    n_answered: int


@dataclass(frozen=True)
class Answered:
    """What an answer did."""

    #: The label that the part has now, if it has one by the answer.
    label: int | None
    corrected: Corrected | None


@dataclass(frozen=True)
class Suggestion:
    """The shape whose labelling by a person would help most."""

    shape: str
    #: Relative to the other shapes; 1 is the mean.
    gain: float
    #: Share of its area whose label is uncertain.
    uncertainty: float
    n_nearest: int
    reason: str
    n_corrected: int


@dataclass(frozen=True)
class Idle:
    """Whether a collection has anything left to do."""

    idle: bool
    n_queued: int
    n_stale: int


@dataclass(frozen=True)
class Snapshot:
    """The labels of all shapes of a collection as of one moment, by name."""

    #: Events with a larger number come on top.
    sequence: int
    shapes: Mapping[str, Labelling]


@dataclass(frozen=True)
class Event:
    """Something that happened to a collection."""

    #: Position in the collection's log, from 1, without gaps.
    sequence: int
    collection: str
    #: Name of the kind, such as ``"labels_changed"``.
    kind: str
    #: The fields of the kind as plain values, such as ``{"shape": "101", "version": 2, …}``.
    data: Mapping[str, object]

    @property
    def shape(self) -> str | None:
        """The shape it is about."""
        name = self.data.get("shape")
        return name if isinstance(name, str) else None
