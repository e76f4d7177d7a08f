/** The client: a library of shapes kept by a daemon, and its collections. */

import { randomUUID } from "node:crypto";
import { setTimeout as sleep } from "node:timers/promises";
import { create, fromBinary, toBinary, type MessageInitShape } from "@bufbuild/protobuf";
import { batches, type Batch, type Item } from "./batch.js";
import { BadReply, CosegError, EventLogRewound, NoAnswer, Refused, refused } from "./errors.js";
import type { GetFunctionalMapReply } from "./gen/coseg/v1/analysis_pb.js";
import { CollectionSpecSchema, Operator, Up, type CollectionSpec } from "./gen/coseg/v1/collection_pb.js";
import type { Collection as WireCollection, LabelInfo } from "./gen/coseg/v1/collection_pb.js";
import type { CorrectLabelsReply, SuggestNextReply, UndoReply } from "./gen/coseg/v1/correction_pb.js";
import type { HelloReply, StatsReply } from "./gen/coseg/v1/daemon_pb.js";
import { EventSchema, type Event as WireEvent } from "./gen/coseg/v1/event_pb.js";
import { ItemState, Outcome, type Job as WireJob, type JobItem, type WaitIdleReply } from "./gen/coseg/v1/job_pb.js";
import { RequestSchema, type Reply, type Request } from "./gen/coseg/v1/message_pb.js";
import type { Shape as WireShape } from "./gen/coseg/v1/shape_pb.js";
import { curveFromEnv, Transport, type Curve, type Subscription } from "./transport.js";
import { FrameWriter, formatName, plain, Raw, type Encoded, type Matrix, type Mesh, type Plain } from "./wire.js";

/** Longest single wait in the daemon: so long a change of mind takes to be noticed. */
const WAIT_MS = 1_000;
/** Silence after which a subscription is made anew; heartbeats come once a second. */
const SILENCE_MS = 3_000;
/** Between tries while a daemon drains and another has not taken its place. */
const DRAINING_RETRY_MS = 500;
/** What a daemon that drains answers at once is asked again after this. */
const PACE_MS = 20;
const HEARTBEAT_TOPIC = "\0";

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
/** A correction that is durable. */
export type Corrected = Plain<CorrectLabelsReply>;
/** What was undone. */
export type Undone = Plain<UndoReply>;
/** The shape whose labelling by a person would help most. */
export type Suggestion = Plain<SuggestNextReply>;
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
  readonly quality: Plain<NonNullable<GetFunctionalMapReply["quality"]>>;
}

/** How a map between points is made. */
export interface Points {
  /** Vertices of the working meshes that correspond, `from` first. */
  readonly landmarks?: readonly (readonly [number, number])[];
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

type Bodies = NonNullable<MessageInitShape<typeof RequestSchema>["body"]>;
type Body = Exclude<Request["body"]["case"], undefined>;
type Init<C extends Body> = Extract<Bodies, { case: C }>["value"];
type Result<C extends Body> = Extract<Reply["result"], { case: C }>["value"];

/** Where a daemon of this user listens when nobody says otherwise. */
export function defaultEndpoint(): string {
  const { COSEG_ENDPOINT, RUNTIME_DIRECTORY, XDG_RUNTIME_DIR } = process.env;
  if (COSEG_ENDPOINT) return COSEG_ENDPOINT;
  if (RUNTIME_DIRECTORY) return `ipc://${RUNTIME_DIRECTORY}/coseg.sock`;
  if (XDG_RUNTIME_DIR) return `ipc://${XDG_RUNTIME_DIR}/coseg/coseg.sock`;
  return `ipc:///tmp/coseg-${process.getuid?.() ?? 0}/coseg.sock`;
}

/** A connection to a daemon, and the library that it keeps. That somebody listens shows with the first request. */
export class Library {
  readonly endpoint: string;
  readonly clientId: string;
  /** @internal */
  readonly transport: Transport;
  // Request ids of two programs under one client id must differ.
  readonly #run = randomUUID().slice(0, 13);
  #n = 0;
  #hello: HelloReply | undefined;

  constructor(options: Options = {}) {
    this.endpoint = options.endpoint ?? defaultEndpoint();
    this.clientId = options.clientId ?? `typescript-${randomUUID()}`;
    this.transport = new Transport(this.endpoint, options.timeout ?? 30, options.curve ?? curveFromEnv());
  }

  /** Closes the connection. */
  close(): void {
    this.transport.close();
  }

  /**
   * Sends any request of the protocol: `await lib.call("getJob", { jobId: 7n })`. A daemon that is at a
   * limit is asked again after the delay it names, one that drains until another has taken its place.
   */
  async call<C extends Body>(
    body: C,
    value: Init<C>,
    options: { frames?: readonly Uint8Array[]; clientId?: string; requestId?: string; deadlineMs?: number } = {},
  ): Promise<[Result<C>, Raw]> {
    if (this.#hello === undefined && body !== "hello") await this.hello();
    const request = create(RequestSchema, {
      requestId: options.requestId ?? `${this.#run}-${++this.#n}`,
      clientId: options.clientId ?? this.clientId,
      deadlineMs: BigInt(options.deadlineMs ?? 0),
      body: { case: body, value } as Bodies,
    });
    const frames = [toBinary(RequestSchema, request), ...(options.frames ?? [])];
    // A frame beyond the limit would end the connection without a word.
    const nBytes = frames.reduce((n, frame) => n + frame.length, 0);
    const limit = this.#hello?.limits?.maxMessageBytes;
    if (limit !== undefined && BigInt(nBytes) > limit) {
      throw new CosegError(`the message has ${nBytes} bytes, the daemon's limit is ${limit}`);
    }
    for (;;) {
      const [{ result }, raw] = await this.transport.exchange(request.requestId, frames);
      if (result.case === body) return [result.value as Result<C>, new Raw(raw)];
      if (result.case !== "error") throw new BadReply(`the reply to ${body} has ${result.case ?? "no result"}`);
      const error = refused(result.value);
      if (error.retryAfter !== undefined) await sleep(error.retryAfter * 1000);
      else if (error.reason === "DRAINING") await sleep(DRAINING_RETRY_MS);
      else throw error;
    }
  }

  /** Who the daemon is. */
  async hello(): Promise<Hello> {
    [this.#hello] = await this.call("hello", {});
    return plain(this.#hello);
  }

  /** @internal */
  async limits(): Promise<NonNullable<HelloReply["limits"]>> {
    const { limits } = (await this.call("hello", {}))[0];
    if (limits === undefined) throw new BadReply("the daemon states no limits");
    return limits;
  }

  /** The daemon's counters. */
  async stats(): Promise<Stats> {
    return plain((await this.call("stats", {}))[0]);
  }

  /** All collections, by name. */
  async collections(): Promise<CollectionInfo[]> {
    return (await this.call("listCollections", {}))[0].collections.map(plain);
  }

  /** Creates a collection. */
  async create(name: string, settings: Settings = {}): Promise<Collection> {
    await this.call("createCollection", { spec: { ...spec(settings), name } });
    return this.collection(name, settings);
  }

  /**
   * The collection of that name. The first shape added creates it, with these settings, if it is missing; a
   * collection that has others is refused then.
   */
  collection(name: string, settings: Settings = {}): Collection {
    return new Collection(this, name, spec(settings));
  }

  /** The only collection there is. */
  async onlyCollection(): Promise<Collection> {
    const names = (await this.collections()).map((c) => c.spec?.name ?? "");
    const [only] = names;
    if (only === undefined || names.length > 1) {
      throw new CosegError(`name a collection: there are ${names.length} (${names.join(", ")})`);
    }
    return this.collection(only);
  }

  /** The functional map that carries functions on `from` to functions on `to`. */
  async map(from: string, to: string, collection?: string, points?: Points): Promise<FunctionalMap> {
    const within = collection === undefined ? await this.onlyCollection() : this.collection(collection);
    return within.map(from, to, points);
  }

  /** A job as it stands. */
  async job(jobId: bigint): Promise<Job> {
    return job((await this.call("getJob", { jobId }))[0].job);
  }

  /** A job each time it has changed, until it is finished; also across restarts of the daemon. */
  async *watch(jobId: bigint): AsyncGenerator<Job> {
    for await (const message of this.watchWire(jobId)) yield job(message);
  }

  /** @internal */
  async *watchWire(jobId: bigint): AsyncGenerator<WireJob> {
    let revision = 0n;
    for (;;) {
      const [{ job: message }] = await this.call("watchJob", { jobId, revision, waitMs: BigInt(WAIT_MS) });
      if (message === undefined) throw new BadReply("a watched job is missing");
      if (message.revision !== revision || message.finished) yield message;
      if (message.finished) return;
      if (message.revision === revision) await sleep(PACE_MS);
      revision = message.revision;
    }
  }

  /** Cancels the shapes of a job that are not placed yet. */
  async cancel(jobId: bigint): Promise<Job> {
    return job((await this.call("cancelJob", { jobId }))[0].job);
  }

  /** Jobs, the newest first; with `failed` those of which a shape failed, each with its failed shapes alone. */
  async *jobs(options: { failed?: boolean; collection?: string } = {}): AsyncGenerator<Job> {
    let before = 0n;
    for (;;) {
      const [reply] = await this.call("listJobs", { ...options, before });
      for (const message of reply.jobs) yield job(message);
      const last = reply.jobs.at(-1);
      if (!reply.more || last === undefined) return;
      before = last.jobId;
    }
  }

  /** Queues the failed shapes of a job again, once what made them fail is mended. With keys: for the role `admin`. */
  async retry(jobId: bigint): Promise<Job> {
    return job((await this.call("retryJob", { jobId }))[0].job);
  }
}

/** One collection of a library; made by {@link Library.collection}. */
export class Collection {
  /** @internal */
  constructor(
    readonly library: Library,
    readonly name: string,
    readonly spec: CollectionSpec,
  ) {}

  /** As it stands, with its labels. */
  async info(): Promise<CollectionInfo> {
    const [{ collection }] = await this.library.call("describeCollection", { collection: this.name });
    if (collection === undefined) throw new BadReply("a described collection is missing");
    return plain(collection);
  }

  /** Deletes the collection with its shapes, labels and events. */
  async delete(): Promise<void> {
    await this.library.call("deleteCollection", { collection: this.name });
  }

  /** Adds a shape and waits until it is labelled. A refusal is thrown. */
  async add(name: string, mesh: Mesh, options: { replace?: boolean } = {}): Promise<Added> {
    for await (const added of this.addMany([[name, mesh]], options)) {
      if (added.error) throw added.error;
      return added;
    }
    throw new BadReply("a finished job without its shape");
  }

  /** Hands shapes over and returns the ids of their jobs as soon as the daemon has them durably. */
  async submit(
    shapes: Iterable<Item> | AsyncIterable<Item>,
    options: { replace?: boolean; key?: string } = {},
  ): Promise<bigint[]> {
    const jobs: bigint[] = [];
    for await (const [batch, jobId] of this.#send(shapes, { inFlight: 64, ...options })) {
      if (jobId !== undefined) jobs.push(jobId);
      const unsent = batch.results.find((r) => r !== undefined);
      if (unsent) throw unsent.error;
    }
    return jobs;
  }

  /**
   * Streams shapes in, and yields what became of each, in order. `shapes` is read as needed, and at most
   * about `inFlight` (64) are under way. One that fails is yielded with its `error`; the others go on.
   *
   * A daemon that is restarted gets the same requests again. If *this* program may die and be run again,
   * give the run a `key`: with the same key and shapes a second run takes up the jobs of the first.
   */
  async *addMany(
    shapes: Iterable<Item> | AsyncIterable<Item>,
    options: { replace?: boolean; key?: string; inFlight?: number; onProgress?: (job: Job) => void } = {},
  ): AsyncGenerator<Added> {
    const inFlight = options.inFlight ?? 64;
    const underWay: [Batch, bigint | undefined][] = [];
    let nUnderWay = 0;
    for await (const [batch, jobId] of this.#send(shapes, { ...options, inFlight })) {
      const n = batch.request.shapes.length;
      underWay.push([batch, jobId]);
      nUnderWay += n;
      while (nUnderWay > inFlight - Math.min(n, inFlight >> 2)) {
        const [oldest, oldestJob] = underWay.shift()!;
        nUnderWay -= oldest.request.shapes.length;
        yield* this.#finish(oldest, oldestJob, options.onProgress);
      }
    }
    for (const [batch, jobId] of underWay) yield* this.#finish(batch, jobId, options.onProgress);
  }

  async *#send(
    shapes: Iterable<Item> | AsyncIterable<Item>,
    options: { replace?: boolean; key?: string; inFlight: number },
  ): AsyncGenerator<[Batch, bigint | undefined]> {
    const limits = await this.library.limits();
    const clientId = `add-many-${options.key ?? randomUUID()}`;
    let index = 0;
    const { inFlight, replace = false } = options;
    for await (const batch of batches(this.name, shapes, limits, inFlight, replace, this.spec)) {
      let jobId: bigint | undefined;
      if (batch.request.shapes.length > 0) {
        const { frames } = batch.writer;
        const requestId = batch.requestId(index);
        [{ jobId }] = await this.library.call("addShapes", batch.request, { frames, clientId, requestId });
        // The bytes are the daemon's now.
        frames.length = 0;
      }
      index += 1;
      yield [batch, jobId];
    }
  }

  async *#finish(batch: Batch, jobId: bigint | undefined, onProgress?: (job: Job) => void): AsyncGenerator<Added> {
    const results = [...batch.results];
    const ready: Added[] = [];
    let nTaken = 0;
    if (jobId !== undefined) {
      for await (const message of this.library.watchWire(jobId)) {
        onProgress?.(job(message));
        for (let over; (over = added(message.items[nTaken])) !== undefined; nTaken += 1) ready.push(over);
        while (results.length > 0 && (results[0] !== undefined || ready.length > 0)) {
          const unsent = results.shift();
          yield unsent ? failed(unsent.name, unsent.error) : ready.shift()!;
        }
      }
    }
    for (const unsent of results) {
      if (unsent === undefined) throw new BadReply(`job ${jobId} is finished without all of its shapes`);
      yield failed(unsent.name, unsent.error);
    }
  }

  /** Waits until no shape is to be placed and no label to be recomputed, at most `timeout` seconds. */
  async waitIdle(timeout = Infinity): Promise<Idle> {
    for (let leftMs = timeout * 1000; ; ) {
      const waitMs = Math.trunc(Math.min(WAIT_MS, Math.max(0, leftMs)));
      const request = { collection: this.name, waitMs: BigInt(waitMs) };
      const [reply] = await this.library.call("waitIdle", request);
      leftMs -= waitMs;
      if (reply.idle || leftMs <= 0) return plain(reply);
      await sleep(PACE_MS);
    }
  }

  /** All shapes in the order of their arrival, or those that carry a label. */
  async *shapes(options: { label?: number } = {}): AsyncGenerator<Shape> {
    let pageToken = "";
    do {
      const [reply] = await this.library.call("listShapes", { collection: this.name, pageToken, ...options });
      for (const shape of reply.shapes) yield plain(shape);
      pageToken = reply.nextPageToken;
    } while (pageToken !== "");
  }

  /** One shape: its parts, what cleaning found, where its labels come from. */
  async shape(name: string): Promise<Shape> {
    const [{ shape }] = await this.library.call("getShape", { collection: this.name, shape: name });
    if (shape === undefined) throw new BadReply("the shape is missing");
    return plain(shape);
  }

  /** One label for each face of the bytes that were sent, in their order; −1: unlabelled. */
  async labels(name: string, options: { version?: number } = {}): Promise<Int32Array> {
    return (await this.labelling(name, options)).labels;
  }

  /** Labels with their version and, if wanted, their probabilities. */
  async labelling(name: string, options: { version?: number; confidence?: boolean } = {}): Promise<Labelling> {
    const { version = 0, confidence = false } = options;
    const request = { collection: this.name, shape: name, version: BigInt(version), confidence };
    const [reply, raw] = await this.library.call("getLabels", request);
    const labels = raw.array(Int32Array, reply.labels).data;
    const probabilities = reply.confidence && { confidence: raw.array(Float32Array, reply.confidence).data };
    return { version: Number(reply.version), labels, ...probabilities };
  }

  /** The labels of all shapes as of one moment; `events({ since: snapshot.sequence })` goes on. */
  async snapshot(): Promise<Snapshot> {
    const [reply, raw] = await this.library.call("labelsSnapshot", { collection: this.name });
    const shapes = reply.shapes.map((s): [string, Labelling] => {
      return [s.shape, { version: Number(s.version), labels: raw.array(Int32Array, s.labels).data }];
    });
    return { sequence: Number(reply.sequence), shapes: new Map(shapes) };
  }

  /** The bytes of a shape as they were sent; of arrays, an OFF file with the same values. */
  async original(name: string): Promise<Encoded> {
    const [reply, raw] = await this.library.call("getOriginal", { collection: this.name, shape: name });
    return { format: formatName(reply.format), data: raw.file(reply.bytes) };
  }

  /** Removes a shape. */
  async remove(name: string): Promise<void> {
    await this.library.call("removeShape", { collection: this.name, shape: name });
  }

  /** Eigenvalues and, if wanted, eigenvectors and mass. */
  async spectrum(name: string, options: { eigenvectors?: boolean } = {}): Promise<Spectrum> {
    const { eigenvectors = false } = options;
    const request = { collection: this.name, shape: name, eigenvectors };
    const [reply, raw] = await this.library.call("getSpectrum", request);
    return {
      eigenvalues: raw.array(Float64Array, reply.eigenvalues).data,
      ...(reply.eigenvectors && { eigenvectors: raw.array(Float32Array, reply.eigenvectors) }),
      ...(reply.mass && { mass: raw.array(Float32Array, reply.mass).data }),
      area: reply.area,
    };
  }

  /** (n, t) heat kernel signature: a row for each vertex of the working mesh. */
  async hks(name: string): Promise<Matrix<Float32Array>> {
    const [reply, raw] = await this.library.call("getHks", { collection: this.name, shape: name });
    return raw.array(Float32Array, reply.hks);
  }

  /** The working mesh and what the segmentation is computed from. */
  async descriptors(name: string): Promise<Descriptors> {
    const [reply, raw] = await this.library.call("getDescriptors", { collection: this.name, shape: name });
    return {
      vertices: raw.array(Float32Array, reply.vertices),
      faces: raw.array(Uint32Array, reply.faces),
      faceDescriptors: raw.array(Float32Array, reply.faceDescriptors),
      patches: raw.array(Uint32Array, reply.patches).data,
      faceMap: raw.array(Uint32Array, reply.faceMap).data,
      polygonArea: raw.array(Float32Array, reply.polygonArea).data,
      signature: raw.array(Float32Array, reply.signature).data,
    };
  }

  /**
   * The functional map that carries functions on `from` to functions on `to`, and the pointwise map back: the one
   * by which labels are carried, which is kept, or, with `points`, one made for points, in about 0.1 s.
   */
  async map(from: string, to: string, points?: Points): Promise<FunctionalMap> {
    const request = { collection: this.name, from, to, ...(points && { points: pointOptions(points) }) };
    const [reply, raw] = await this.library.call("getFunctionalMap", request);
    if (reply.quality === undefined) throw new BadReply("the quality of a map is missing");
    const c12 = raw.array(Float32Array, reply.c12);
    return { from, to, c12, p2p21: raw.array(Uint32Array, reply.p2p21).data, quality: plain(reply.quality) };
  }

  /**
   * Carries values at the faces of `from` to those of `to`, by a map between points: of an Int32Array one for each
   * face, which are voted on; of a Float32Array as many for each face as there are, of which means are made.
   */
  async transfer<T extends Int32Array | Float32Array>(values: T, from: string, to: string, points: Points = {}): Promise<T> {
    const writer = new FrameWriter();
    let shape = [values.length];
    if (values instanceof Float32Array) {
      const n = (await this.shape(from)).nPolygons;
      shape = [n, values.length / n];
    }
    const array = writer.array(values, ...shape);
    const request = { collection: this.name, from, to, values: array, points: pointOptions(points) };
    const [reply, raw] = await this.library.call("transferFunction", request, { frames: writer.frames });
    const type = values.constructor as new (buffer: ArrayBuffer) => T;
    return raw.array(type, reply.values).data;
  }

  /** Which part of `a` matches which part of `b`. */
  async matchParts(a: string, b: string) {
    const request = { collection: this.name, shapeA: a, shapeB: b };
    return plain((await this.library.call("getPartCorrespondence", request))[0]);
  }

  /** The shapes most like one shape, nearest first. */
  async nearest(name: string, limit = 5) {
    const [reply] = await this.library.call("nearest", { collection: this.name, shape: name, limit });
    return reply.neighbors.map(plain);
  }

  /**
   * Labels faces of a shape by hand: an integer for each (−1 leaves one alone), one label for some faces, or
   * one for a part. They never change again by themselves; other shapes follow: {@link waitIdle}.
   */
  async correct(
    name: string,
    correction:
      | Int32Array
      | { readonly faces: Uint32Array; readonly label: number }
      | { readonly part: number; readonly label: number },
  ): Promise<Corrected> {
    const writer = new FrameWriter();
    const what =
      correction instanceof Int32Array
        ? { case: "labels" as const, value: writer.array(correction, correction.length) }
        : "faces" in correction
          ? {
              case: "faces" as const,
              value: { faces: writer.array(correction.faces, correction.faces.length), label: correction.label },
            }
          : { case: "part" as const, value: correction };
    const request = { collection: this.name, shape: name, correction: what };
    return plain((await this.library.call("correctLabels", request, { frames: writer.frames }))[0]);
  }

  /** Gives a label a name. */
  async nameLabel(label: number, name: string): Promise<Label> {
    const [reply] = await this.library.call("nameLabel", { collection: this.name, label, name });
    return present(reply.label);
  }

  /** Makes one label of two: faces of `label` carry `into` from now on. */
  async merge(label: number, into: number): Promise<Label> {
    const [reply] = await this.library.call("mergeLabels", { collection: this.name, label, into });
    return present(reply.label);
  }

  /** Makes two labels of one, and returns the new one. */
  async split(label: number): Promise<Label> {
    const [reply] = await this.library.call("splitLabel", { collection: this.name, label });
    return present(reply.label);
  }

  /** Takes back the newest correction, name, merge or split. */
  async undo(): Promise<Undone> {
    return plain((await this.library.call("undo", { collection: this.name }))[0]);
  }

  /** The shape whose labelling by a person would help most, or undefined if there is none. */
  async suggest(): Promise<Suggestion | undefined> {
    try {
      return plain((await this.library.call("suggestNext", { collection: this.name }))[0]);
    } catch (e) {
      if (e instanceof Refused && e.reason === "NOTHING_TO_SUGGEST") return undefined;
      throw e;
    }
  }

  /** Events of the log after `sequence`, in order. */
  async eventsSince(sequence: number): Promise<Event[]> {
    const found: Event[] = [];
    for (;;) {
      const request = { collection: this.name, sequence: BigInt(sequence) };
      const [reply] = await this.library.call("eventsSince", request);
      found.push(...reply.events.map(plain));
      if (!reply.more) return found;
      sequence = found.at(-1)!.sequence;
    }
  }

  /**
   * Events in order, each once and none left out: those after `since` (by default those from now on), then as
   * they happen, without end. What the event socket drops is read from the log. A daemon that is restarted is
   * waited for, at most `patience` seconds (without end).
   */
  async *events(options: { since?: number; patience?: number } = {}): AsyncGenerator<Event> {
    let seen = options.since ?? (await this.info()).sequence;
    for (;;) {
      const endpoint = await this.#eventEndpoint(options.patience ?? Infinity);
      const topics = [`${this.name}\0`, HEARTBEAT_TOPIC];
      const subscription = this.library.transport.subscribe(endpoint, topics, SILENCE_MS);
      try {
        for await (const event of this.#follow(subscription, seen)) {
          seen = event.sequence;
          yield event;
        }
      } finally {
        subscription.close();
      }
    }
  }

  /** Events after `seen` until the subscription falls silent. */
  async *#follow(subscription: Subscription, seen: number): AsyncGenerator<Event> {
    let newest: number | undefined;
    for (;;) {
      if (newest === undefined || newest > seen) {
        // The log has what came before the subscription, and what it dropped.
        let missed: Event[];
        try {
          missed = await this.eventsSince(seen);
        } catch (e) {
          if (e instanceof NoAnswer) return;
          throw e;
        }
        for (const event of missed) {
          seen = event.sequence;
          yield event;
        }
      }
      const body = await subscription.receive();
      if (body === undefined) return;
      const event = plain(fromBinary(EventSchema, body));
      if (event.kind.case === "heartbeat") {
        newest = event.kind.value.collections.find((c) => c.collection === this.name)?.sequence ?? seen;
        if (newest < seen) {
          throw new EventLogRewound(`the log of ${this.name} ends with event ${newest}, but event ${seen} was seen`);
        }
      } else if (event.sequence === seen + 1) {
        seen = newest = event.sequence;
        yield event;
      } else {
        newest = Math.max(newest ?? 0, event.sequence);
      }
    }
  }

  /** Where a daemon that may be away publishes. */
  async #eventEndpoint(patience: number): Promise<string> {
    for (let waited = 0; ; ) {
      try {
        return reachable((await this.library.hello()).eventEndpoint, this.library.endpoint);
      } catch (e) {
        waited += this.library.transport.timeout;
        if (!(e instanceof NoAnswer) || waited >= patience) throw e;
      }
    }
  }
}

/** A daemon that listens on all addresses names none: then the host is the one that is known. */
export function reachable(announced: string, endpoint: string): string {
  const every = /^tcp:\/\/(?:0\.0\.0\.0|\[::\]|\*):(\d+)$/.exec(announced);
  const known = /^tcp:\/\/(.+):\d+$/.exec(endpoint);
  return every && known ? `tcp://${known[1]}:${every[1]}` : announced;
}

function spec(settings: Settings): CollectionSpec {
  const up = settings.up?.toUpperCase().replace("+", "PLUS_").replace("-", "MINUS_") as keyof typeof Up | undefined;
  const operator = settings.operator?.toUpperCase().replace("-", "_") as keyof typeof Operator | undefined;
  return create(CollectionSpecSchema, {
    ...(settings.parts !== undefined && { nParts: settings.parts }),
    up: up === undefined ? Up.UNSPECIFIED : Up[up],
    operator: operator === undefined ? Operator.UNSPECIFIED : Operator[operator],
  });
}

function present(label: LabelInfo | undefined): Label {
  if (label === undefined) throw new BadReply("the label is missing");
  return plain(label);
}

function pointOptions({ landmarks = [] }: Points) {
  return { landmarks: landmarks.map(([from, to]) => ({ from, to })) };
}

function job(message: WireJob | undefined): Job {
  if (message === undefined) throw new BadReply("the job is missing");
  return { ...plain(message), jobId: message.jobId };
}

function failed(name: string, error: Error | undefined, outcome: "failed" | "cancelled" = "failed"): Added {
  return { name, outcome, ok: false, ...(error && { error }), version: 0, sequence: 0, stages: {} };
}

/** What became of a shape of a job, once it is over. */
function added(item: JobItem | undefined): Added | undefined {
  switch (item?.state) {
    case ItemState.DONE: {
      const { placed } = item;
      if (placed === undefined) throw new BadReply(`${item.name} is done, but nothing was`);
      return {
        name: item.name,
        outcome: Outcome[placed.outcome].toLowerCase() as Added["outcome"],
        ok: true,
        version: Number(placed.version),
        sequence: Number(placed.sequence),
        stages: Object.fromEntries(placed.stages.map((s) => [s.stage, s.ms])),
      };
    }
    case ItemState.FAILED:
      return failed(item.name, item.error && refused(item.error));
    case ItemState.CANCELLED:
      return failed(item.name, item.error && refused(item.error), "cancelled");
    default:
      return undefined;
  }
}
