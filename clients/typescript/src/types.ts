/** What the client takes and returns. */

import type {
  GetPartCorrespondenceReply,
  MapAgreement as WireMapAgreement,
  MapQuality as WireMapQuality,
  Neighbor as WireNeighbor,
} from "./gen/coseg/v1/analysis_pb.js";
import type { Collection as WireCollection, LabelInfo, UpdateCollectionReply } from "./gen/coseg/v1/collection_pb.js";
import type { CorrectLabelsReply, SuggestNextReply, UndoReply } from "./gen/coseg/v1/correction_pb.js";
import type { NextQuestionReply } from "./gen/coseg/v1/question_pb.js";
import type { HelloReply, StatsReply } from "./gen/coseg/v1/daemon_pb.js";
import type { Event as WireEvent } from "./gen/coseg/v1/event_pb.js";
import type { Job as WireJob, WaitIdleReply } from "./gen/coseg/v1/job_pb.js";
import type { Shape as WireShape } from "./gen/coseg/v1/shape_pb.js";
import type { Curve } from "./transport.js";
import type { Matrix, Plain } from "./wire.js";

/** Who the daemon is. */
export type Hello = Plain<HelloReply>;
/** The daemon's counters. */
export type Stats = Plain<StatsReply>;
/** A collection as it stands. */
export type CollectionInfo = Plain<WireCollection>;
/** A label of a collection. */
export type Label = Plain<LabelInfo>;
/** A shape as it stands. */
export type Shape = Plain<WireShape>;
/** Shapes that were accepted together. Its id is exact. */
export type Job = Omit<Plain<WireJob>, "jobId"> & { readonly jobId: bigint };
/** Something that happened to a collection; `kind.case` says what. */
export type Event = Plain<WireEvent>;
/** A job whose failed shapes were queued again, and how many were. */
export type RetriedJob = Job & { readonly nQueued: number };
/** A label after a merge or a split, and on how many shapes labels changed at once. */
export type ChangedLabel = Label & { readonly nChanged: number };
/** A correction that is durable; the job carries it to the other shapes. */
export type Corrected = Omit<Plain<CorrectLabelsReply>, "jobId"> & { readonly jobId: bigint };
/** Which part of one shape matches which part of another. */
export type PartMatches = Plain<GetPartCorrespondenceReply>;
/** A shape and how far it is. */
export type Neighbor = Plain<WireNeighbor>;
/** How good a functional map is; what it does not say of its kind of map is undefined. */
export type MapQuality = Plain<WireMapQuality>;
/** How a map agrees with those by way of other shapes of its collection. */
export type MapAgreement = Plain<WireMapAgreement>;
/** What was undone. */
export type Undone = Plain<UndoReply>;
/** What became of a change of a collection's settings, and how many shapes wait to be relabelled. */
export type Updated = Plain<UpdateCollectionReply>;
/** The shape whose labelling by a person would help most. */
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
/** Whether a collection has anything left to do. */
export type Idle = Plain<WaitIdleReply>;

/** The labels of a shape, one for each face of its file, in the file's order; −1: unlabelled. */
export interface Labelling {
  readonly version: number;
  readonly labels: Int32Array;
  /** Probability of each label, if it was asked for. */
  readonly confidence?: Float32Array;
}

/** What became of one shape that was added. */
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
  /** Of the maps those that do not agree with the maps between the shapes they come from. */
  readonly nInconsistent: number;
  /** Milliseconds by stage, in order. */
  readonly stages: Readonly<Record<string, number>>;
}

/** Eigenpairs on a shape's working mesh, scaled to area 1. */
export interface Spectrum {
  /** (k), ascending, 0 included. In input units: divide by `area`. */
  readonly eigenvalues: Float64Array;
  /** (n, b) the first b ≤ k eigenvectors as columns, mass-orthonormal. */
  readonly eigenvectors?: Matrix<Float32Array>;
  /** (n) lumped mass of each vertex. */
  readonly mass?: Float32Array;
  readonly area: number;
}

/** The working mesh of a shape and what its segmentation is computed from; see the protocol. */
export interface Descriptors {
  readonly vertices: Matrix<Float32Array>;
  readonly faces: Matrix<Uint32Array>;
  readonly faceDescriptors: Matrix<Float32Array>;
  readonly patches: Uint32Array;
  readonly faceMap: Uint32Array;
  readonly polygonArea: Float32Array;
  readonly signature: Float32Array;
}

/** The map that carries functions on shape 1 (`from`) to functions on shape 2 (`to`). */
export interface FunctionalMap {
  readonly from: string;
  readonly to: string;
  /** (k2, k1) coefficients on shape 1 to coefficients on shape 2. */
  readonly c12: Matrix<Float32Array>;
  /** (n2) for each vertex of shape 2's working mesh one of shape 1's. */
  readonly p2p21: Uint32Array;
  readonly quality: MapQuality;
  /** (n2) 1 where something of shape 1 corresponds to the vertex of shape 2's working mesh, else 0. */
  readonly matched: Uint32Array;
  /** Of maps for parts: (n2) probability that a label carried there is right; 0 where nothing corresponds. */
  readonly confidence?: Float32Array;
  /** Of maps for parts, if it was asked for: whether it agrees with the others of the collection. */
  readonly agreement?: MapAgreement;
  /** The best map of the other orientation, left for right, if it was asked for and there is one. */
  readonly alternative?: FunctionalMap;
  /** What that costs over what this one does: near 1, the shapes themselves hardly say which is meant. */
  readonly alternativeCost?: number;
  /** Vertices of shape 1's working mesh; 0 from a daemon that does not say. */
  readonly n1: number;
}

/** How a map between points is made. */
export interface Points {
  /** Vertices of the working meshes that correspond, `from` first. */
  readonly landmarks?: readonly (readonly [number, number])[];
  /** Which of the maps between shapes that have a reflection: without, the one that keeps it unless that is much worse. */
  readonly orientation?: "keep" | "reverse";
  /** Rows and columns of `c12` (100, or as many as both shapes have). */
  readonly k?: number;
  /** Find the best map of the other orientation too. */
  readonly alternative?: boolean;
}

/** A map between points, or that for parts with how it agrees with the other kept maps. */
export type MapOptions = Points | { readonly agreement: boolean };

/** Values that were carried from the faces of one shape to those of another. */
export interface Transferred<T> {
  /** One row for each face of `to`; −1 or NaN where nothing corresponds. */
  readonly values: T;
  /** How good the map is that carried them. */
  readonly quality: MapQuality;
}

/** The labels of all shapes of a collection as of one moment, by name. */
export interface Snapshot {
  /** Events with a larger number come on top. */
  readonly sequence: number;
  readonly shapes: ReadonlyMap<string, Labelling>;
}

/** Settings of a collection that is created. */
export interface Settings {
  /** Number of part kinds; estimated if it is not given. */
  readonly parts?: number;
  /** The axis that points up. */
  readonly up?: "+x" | "-x" | "+y" | "-y" | "+z" | "-z" | "unknown" | "auto";
  /** Which Laplacian. */
  readonly operator?: "tufted" | "cotan" | "mesh-laplace";
  /** Faces of the working mesh (the daemon's default). */
  readonly workingFaces?: number;
}

/** How to reach the daemon. */
export interface Options {
  /** `ipc://PATH` or `tcp://HOST:PORT`; else `$COSEG_ENDPOINT`, else the socket of this user's daemon. */
  readonly endpoint?: string;
  /**
   * Seconds without any sign of life until {@link NoAnswer} (30). Work that takes longer while the daemon
   * lives does not count; a daemon that restarts in this time gets the same requests again.
   */
  readonly timeout?: number;
  /** Keys of an encrypted connection; else those of the files `$COSEG_SERVER_KEY` and `$COSEG_CLIENT_KEY`, if set. */
  readonly curve?: Curve;
  /** With a request's id the key under which changes have one effect; made up if it is not given. */
  readonly clientId?: string;
}
