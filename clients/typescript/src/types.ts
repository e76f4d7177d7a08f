/** The types that the client takes and returns. */

import type {
  GetPartCorrespondenceReply,
  MapAgreement as WireMapAgreement,
  MapQuality as WireMapQuality,
  Neighbor as WireNeighbor,
} from "./gen/coseg/v1/analysis_pb.js";
import type { BundleFile as WireBundleFile, PublishReply } from "./gen/coseg/v1/bundle_pb.js";
import type { Collection as WireCollection, LabelInfo, UpdateCollectionReply } from "./gen/coseg/v1/collection_pb.js";
import type { CorrectLabelsReply, SuggestNextReply, UndoReply } from "./gen/coseg/v1/correction_pb.js";
import type { ChooseProposalReply, ListProposalsReply } from "./gen/coseg/v1/proposal_pb.js";
import type { NextQuestionReply } from "./gen/coseg/v1/question_pb.js";
import type { HelloReply, StatsReply } from "./gen/coseg/v1/daemon_pb.js";
import type { Event as WireEvent } from "./gen/coseg/v1/event_pb.js";
import type { Link as WireLink } from "./gen/coseg/v1/link_pb.js";
import type { Job as WireJob, WaitIdleReply } from "./gen/coseg/v1/job_pb.js";
import type { Shape as WireShape } from "./gen/coseg/v1/shape_pb.js";
import type { Curve } from "./transport.js";
import type { Matrix, Plain } from "./wire.js";

/** The daemon's description of itself. */
export type Hello = Plain<HelloReply>;
/** The daemon's counters. */
export type Stats = Plain<StatsReply>;
/** The present state of a collection. */
export type CollectionInfo = Plain<WireCollection>;
/** A label of a collection. */
export type Label = Plain<LabelInfo>;
/** The present state of a shape. */
export type Shape = Plain<WireShape>;
/** Shapes that were accepted together. Its id is exact. */
export type Job = Omit<Plain<WireJob>, "jobId"> & { readonly jobId: bigint };
/** A change of a collection; `kind.case` names its kind. */
export type Event = Plain<WireEvent>;
/** A job whose failed shapes were queued again, with their number. */
export type RetriedJob = Job & { readonly nQueued: number };
/** A label after a merge or a split, and the number of shapes whose labels changed immediately. */
export type ChangedLabel = Label & { readonly nChanged: number };
/** A durable correction; the job propagates it to the other shapes. */
export type Corrected = Omit<Plain<CorrectLabelsReply>, "jobId"> & { readonly jobId: bigint };
/** A part of one shape and the matching part of another. */
export type PartMatches = Plain<GetPartCorrespondenceReply>;
/** A shape and its distance. */
export type Neighbor = Plain<WireNeighbor>;
/** The quality of a functional map; figures that do not apply to its kind of map are undefined. */
export type MapQuality = Plain<WireMapQuality>;
/** The agreement of a map with maps by way of other shapes of its collection. */
export type MapAgreement = Plain<WireMapAgreement>;
/** The undone change. */
export type Undone = Plain<UndoReply>;
/**
 * The result of a change of a collection's settings, and the number of shapes that wait to be
 * relabelled.
 */
export type Updated = Plain<UpdateCollectionReply>;
/** The proposals of a collection: divisions of its shapes into labels, of which a person can choose one. */
export type Proposals = Plain<ListProposalsReply>;
/** The result of choosing a proposal. */
export type Chosen = Plain<ChooseProposalReply>;
/** An array file that a bundle contains. */
export type BundleFile = Plain<WireBundleFile>;
/** The beginning of a bundle, and the array files that follow it. */
export type BundleHead = Omit<Plain<PublishReply>, "head"> & { readonly head: Uint8Array };
/** A bundle that was written. */
export type Published = Omit<BundleHead, "head" | "files">;
/** The shape that is most worth labelling by hand. */
export type Suggestion = Plain<SuggestNextReply>;
/** A person's verdict on the labels of a shape. */
export type Verdict = "unseen" | "corrected" | "approved" | "doubtful";
/** The part whose label is worth most to ask a person for; `faces` are its polygons. */
export type Question = Omit<Plain<NextQuestionReply>, "faces"> & { readonly faces: Uint32Array };
/** An answer to a question: a label by id or name, the name of one that may be new, or why the part is passed over. */
export type Answer = { label: number | string } | { named: string } | { skip: true } | { cutWrongly: true };
/** What an answer did: the label that the part has now, and the correction that this made. */
export interface Answered {
  readonly label?: number;
  readonly corrected?: Corrected;
}
/** A part of a shape, by its number. */
export interface PartOfShape {
  readonly shape: string;
  readonly part: number;
}
/** What a link demands of the labels of two parts. */
export type Demand = "same" | "differ";
/** A link between two parts, which are named as they were when they were linked. */
export type Link = Omit<Plain<WireLink>, "kind" | "a" | "b"> & {
  readonly kind: Demand;
  readonly a: PartOfShape;
  readonly b: PartOfShape;
};
/** A link that was made or removed; `changed` is false if the same link was there. */
export interface Linked {
  readonly link: Link;
  readonly changed: boolean;
  /** Shapes whose labels wait to be recomputed. */
  readonly nStale: number;
  /** Number of the collection's newest event after it. */
  readonly sequence: number;
  /** The job that propagates it; 0 if none does. */
  readonly jobId: bigint;
}
/** Whether a collection has work left. */
export type Idle = Plain<WaitIdleReply>;

/** The labels of a shape, one for each face of its file, in the file's order; −1: unlabelled. */
export interface Labelling {
  readonly version: number;
  readonly labels: Int32Array;
  /** Probability of each label, if it was requested. */
  readonly confidence?: Float32Array;
}

/** The result of adding one shape. */
export interface Added {
  readonly name: string;
  readonly outcome: "added" | "unchanged" | "replaced" | "failed" | "cancelled";
  /** Whether the shape is in the collection. */
  readonly ok: boolean;
  readonly error?: Error;
  /** Version of its labels. */
  readonly version: number;
  /** Number of the collection's newest event after it. */
  readonly sequence: number;
  /** Functional maps that were computed for it. */
  readonly nMaps: number;
  /** Stored shapes whose labels were recomputed with it. */
  readonly nRelabelled: number;
  /** Number of these maps that disagree with the maps between their source shapes. */
  readonly nInconsistent: number;
  /** Milliseconds by stage, in order. */
  readonly stages: Readonly<Record<string, number>>;
}

/**
 * What the rows of an array are of: vertices of the mesh as sent, its faces, or vertices of the
 * working mesh.
 */
export type Resolution = "input" | "input_faces" | "proxy";

/** Which vertices landmarks are: of the meshes as sent, or of the working meshes. */
export type LandmarkResolution = "input" | "proxy";

/** Eigenpairs on a shape's working mesh, scaled to area 1; rows as requested. */
export interface Spectrum {
  /** (k), ascending, 0 included. In input units: divide by `area`. */
  readonly eigenvalues: Float64Array;
  /** (n, b) the first b ≤ k eigenvectors as columns, mass-orthonormal on the working mesh. */
  readonly eigenvectors?: Matrix<Float32Array>;
  /** (n) lumped mass of each row. */
  readonly mass?: Float32Array;
  readonly area: number;
}

/**
 * The working mesh of a shape and the data from which its segmentation is computed; see the
 * protocol.
 */
export interface Descriptors {
  readonly vertices: Matrix<Float32Array>;
  readonly faces: Matrix<Uint32Array>;
  readonly faceDescriptors: Matrix<Float32Array>;
  readonly patches: Uint32Array;
  readonly faceMap: Uint32Array;
  readonly polygonArea: Float32Array;
  readonly signature: Float32Array;
}

/** The map that transfers functions on shape 1 (`from`) to functions on shape 2 (`to`). */
export interface FunctionalMap {
  readonly from: string;
  readonly to: string;
  /** (k2, k1) coefficients on shape 1 to coefficients on shape 2. */
  readonly c12: Matrix<Float32Array>;
  /** (n2) for each vertex of shape 2 one of shape 1; `resolution` says of what. */
  readonly p2p21: Uint32Array;
  readonly quality: MapQuality;
  /** (n2) 1 for each vertex of shape 2 that has a counterpart on shape 1, else 0. */
  readonly matched: Uint32Array;
  /**
   * For part maps: (n2) probability that a label transferred there is right; 0 without counterpart.
   */
  readonly confidence?: Float32Array;
  /** For part maps, if it was requested: the agreement with the others of the collection. */
  readonly agreement?: MapAgreement;
  /**
   * The best map of the other orientation, which exchanges left and right, if it was requested and
   * exists.
   */
  readonly alternative?: FunctionalMap;
  /**
   * Cost of that map over the cost of this one; near 1, the shapes hardly determine which map is
   * right.
   */
  readonly alternativeCost?: number;
  /** Number of vertices (or faces) of shape 1; 0 if the daemon is too old to set it. */
  readonly n1: number;
  /** What `p2p21` is of. */
  readonly resolution: Resolution;
}

/** Options of a map between points. */
export interface Points {
  /**
   * Corresponding vertices, `from` first: of the meshes as sent or of the working meshes, as
   * `landmarkResolution` says.
   */
  readonly landmarks?: readonly (readonly [number, number])[];
  /**
   * Which vertices landmarks are: of the meshes as sent ("input") or of the working meshes
   * ("proxy"), whatever the rows of the reply are of. Without it "proxy" if the resolution is
   * "proxy", else "input".
   */
  readonly landmarkResolution?: LandmarkResolution;
  /**
   * The orientation of a map between shapes that have a reflection; by default the map keeps
   * orientation unless it is then much worse.
   */
  readonly orientation?: "keep" | "reverse";
  /** Rows and columns of `c12` (100, or fewer if the shapes have fewer eigenfunctions). */
  readonly k?: number;
  /** Whether to return the best map of the other orientation too. */
  readonly alternative?: boolean;
}

/** What the rows are of. */
export interface Rows {
  readonly resolution?: Resolution;
}

/**
 * Options for a map between points, or for the part map with its agreement with the other stored
 * maps. A resolution alone is for the part map.
 */
export type MapOptions = (Points | { readonly agreement: boolean }) & Rows;

/** Values transferred from the faces or vertices of one shape to those of another. */
export interface Transferred<T> {
  /** One row for each face or vertex of `to`; −1 or NaN without counterpart. */
  readonly values: T;
  /** Quality of the map that transferred them. */
  readonly quality: MapQuality;
}

/** The labels of all shapes of a collection at one moment, by name. */
export interface Snapshot {
  /** Sequence number of the newest event that is contained; later events are not. */
  readonly sequence: number;
  readonly shapes: ReadonlyMap<string, Labelling>;
}

/** Settings of a new collection. */
export interface Settings {
  /** Number of part kinds; estimated if omitted. */
  readonly parts?: number;
  /** The axis that points up. */
  readonly up?: "+x" | "-x" | "+y" | "-y" | "+z" | "-z" | "unknown" | "auto";
  /** The Laplacian. */
  readonly operator?: "tufted" | "cotan" | "mesh-laplace";
  /** Number of faces of the working mesh (default: the daemon's). */
  readonly workingFaces?: number;
}

/** How to reach the daemon. */
export interface Options {
  /**
   * `ipc://PATH` or `tcp://HOST:PORT`; else `$COSEG_ENDPOINT`, else the socket of this user's
   * daemon.
   */
  readonly endpoint?: string;
  /**
   * Seconds without any answer until {@link NoAnswer} (30). Work that takes longer while the daemon
   * is alive does not count; a daemon that restarts in this time gets the same requests again.
   */
  readonly timeout?: number;
  /**
   * Keys of an encrypted connection; by default those in the files `$COSEG_SERVER_KEY` and
   * `$COSEG_CLIENT_KEY`, if set.
   */
  readonly curve?: Curve;
  /** Together with a request's id the idempotency key of changes; generated if omitted. */
  readonly clientId?: string;
}
