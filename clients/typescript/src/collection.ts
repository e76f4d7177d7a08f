/** One collection: shapes, labels, analysis, corrections, events. */

import { randomUUID } from "node:crypto";
import { open, rename, rm } from "node:fs/promises";
import { setTimeout as sleep } from "node:timers/promises";
import { fromBinary } from "@bufbuild/protobuf";
import { batches, type Batch, type Item } from "./batch.js";
import { BadReply, CosegError, EventLogRewound, NoAnswer, Refused } from "./errors.js";
import type { CollectionSpec } from "./gen/coseg/v1/collection_pb.js";
import { EventSchema } from "./gen/coseg/v1/event_pb.js";
import { LinkKind } from "./gen/coseg/v1/link_pb.js";
import { PortraitDetail } from "./gen/coseg/v1/portrait_pb.js";
import { ReviewState } from "./gen/coseg/v1/review_pb.js";
import { PACE_MS, WAIT_MS, type Library } from "./library.js";
import {
  added,
  checkResolution,
  failed,
  functionalMap,
  job,
  link,
  mapQuality,
  pointOptions,
  present,
  up,
  wireResolution,
} from "./replies.js";
import type { Subscription } from "./transport.js";
import type {
  Added,
  Answer,
  Answered,
  BundleHead,
  ChangedLabel,
  Chosen,
  CollectionInfo,
  Corrected,
  Descriptors,
  Event,
  FunctionalMap,
  Idle,
  Job,
  Label,
  Labelling,
  Link,
  Linked,
  MapOptions,
  Neighbor,
  PartMatches,
  PartOfShape,
  Points,
  Proposals,
  Published,
  Rows,
  Question,
  Settings,
  Shape,
  Snapshot,
  Spectrum,
  Suggestion,
  Transferred,
  Undone,
  Updated,
  Verdict,
} from "./types.js";
import { FrameWriter, formatName, plain, type Encoded, type Matrix, type Mesh } from "./wire.js";

/** Silence after which the client subscribes again; heartbeats come once a second. */
const SILENCE_MS = 3_000;
const HEARTBEAT_TOPIC = "\0";
/** Array files of a bundle begin at multiples of so many bytes. */
const BUNDLE_ALIGNMENT = 64;

const VERDICTS: Record<Verdict, ReviewState> = {
  unseen: ReviewState.UNSEEN,
  corrected: ReviewState.CORRECTED,
  approved: ReviewState.APPROVED,
  doubtful: ReviewState.DOUBTFUL,
};

/** One collection of a library; created by {@link Library.collection}. */
export class Collection {
  /** @internal */
  constructor(
    readonly library: Library,
    readonly name: string,
    readonly spec: CollectionSpec,
  ) {}

  /** Returns its present state, with its labels. */
  async info(): Promise<CollectionInfo> {
    const [{ collection }] = await this.library.call("describeCollection", { collection: this.name });
    if (collection === undefined) throw new BadReply("a described collection is missing");
    return plain(collection);
  }

  /**
   * Changes the up axis: shapes are labelled again along the new axis, and faces labelled by hand
   * keep their labels. Other shapes follow in the background: {@link waitIdle}. Can be undone.
   */
  async set(settings: { readonly up: NonNullable<Settings["up"]> }): Promise<Updated> {
    const request = { collection: this.name, up: up(settings.up) };
    return plain((await this.library.call("updateCollection", request))[0]);
  }

  /** Deletes the collection with its shapes, labels and events. */
  async delete(): Promise<void> {
    await this.library.call("deleteCollection", { collection: this.name });
  }

  /** Adds a shape and waits until it is labelled. Throws if the daemon refuses it. */
  async add(name: string, mesh: Mesh, options: { replace?: boolean } = {}): Promise<Added> {
    for await (const added of this.addMany([[name, mesh]], options)) {
      if (added.error) throw added.error;
      return added;
    }
    throw new BadReply("a finished job without its shape");
  }

  /**
   * Submits shapes and returns the ids of their jobs as soon as the daemon has stored them durably.
   */
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
   * Streams shapes to the daemon, and yields the result of each, in order. `shapes` is read as
   * needed; at most about `inFlight` (64) shapes are in flight. A shape that fails is yielded with
   * its `error`; the others continue.
   *
   * A daemon that restarts gets the same requests again. If *this* program may be interrupted and
   * run again, give the run a `key`: with the same key and shapes a second run resumes the jobs of
   * the first.
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
        // The daemon has the bytes now, so they can be freed.
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

  /**
   * Waits until no shape waits to be placed and no label to be recomputed, at most `timeout`
   * seconds.
   */
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

  /** All shapes in the order of their arrival, or those that have a label. */
  async *shapes(options: { label?: number | string; review?: Verdict } = {}): AsyncGenerator<Shape> {
    const label = options.label === undefined ? {} : { label: await this.#label(options.label) };
    const wish = { ...label, ...(options.review && { review: VERDICTS[options.review] }) };
    let pageToken = "";
    do {
      const [reply] = await this.library.call("listShapes", { collection: this.name, pageToken, ...wish });
      for (const shape of reply.shapes) yield plain(shape);
      pageToken = reply.nextPageToken;
    } while (pageToken !== "");
  }

  /** One shape: its parts, the findings of cleaning, and the sources of its labels. */
  async shape(name: string): Promise<Shape> {
    const [{ shape }] = await this.library.call("getShape", { collection: this.name, shape: name });
    if (shape === undefined) throw new BadReply("the shape is missing");
    return plain(shape);
  }

  /** One label for each face of the bytes that were sent, in their order; −1: unlabelled. */
  async labels(name: string, options: { version?: number } = {}): Promise<Int32Array> {
    return (await this.labelling(name, options)).labels;
  }

  /** Labels with their version and, optionally, their probabilities. */
  async labelling(name: string, options: { version?: number; confidence?: boolean } = {}): Promise<Labelling> {
    const { version = 0, confidence = false } = options;
    const request = { collection: this.name, shape: name, version: BigInt(version), confidence };
    const [reply, raw] = await this.library.call("getLabels", request);
    const labels = raw.array(Int32Array, reply.labels).data;
    const probabilities = reply.confidence && { confidence: raw.array(Float32Array, reply.confidence).data };
    return { version: Number(reply.version), labels, ...probabilities };
  }

  /**
   * The labels of all shapes at one moment; `events({ since: snapshot.sequence })` continues from
   * it.
   */
  async snapshot(): Promise<Snapshot> {
    const [reply, raw] = await this.library.call("labelsSnapshot", { collection: this.name });
    const shapes = reply.shapes.map((s): [string, Labelling] => {
      return [s.shape, { version: Number(s.version), labels: raw.array(Int32Array, s.labels).data }];
    });
    return { sequence: Number(reply.sequence), shapes: new Map(shapes) };
  }

  /** The bytes of a shape in their original form; for arrays, an OFF file with the same values. */
  async original(name: string): Promise<Encoded> {
    const [reply, raw] = await this.library.call("getOriginal", { collection: this.name, shape: name });
    return { format: formatName(reply.format), data: raw.file(reply.bytes) };
  }

  /**
   * Writes everything that labels a new shape now to the file `path`, for `coseg label`. The file is replaced when it is
   * whole. Throws `FailedPrecondition` (NOT_PUBLISHABLE) if the collection has too few labelled shapes, or shapes wait to
   * be relabelled: `waitIdle` waits for them.
   */
  async publish(path: string): Promise<Published> {
    const { head, files, ...published } = await this.bundleHead();
    const part = `${path}.${process.pid}.part`;
    const file = await open(part, "w");
    try {
      try {
        await file.writeFile(head);
        for (const { shape, blake3, length } of files) {
          const found = await this.arrayFile(shape, blake3);
          if (found.length !== length) {
            throw new BadReply(`array file of "${shape}": ${found.length} bytes, not ${length}`);
          }
          await file.writeFile(found);
          await file.writeFile(new Uint8Array((BUNDLE_ALIGNMENT - (length % BUNDLE_ALIGNMENT)) % BUNDLE_ALIGNMENT));
        }
        await file.sync();
      } finally {
        await file.close();
      }
      await rename(part, path);
    } catch (error) {
      await rm(part, { force: true });
      throw error;
    }
    return published;
  }

  /** The beginning of the file that `publish` writes, and the array files that follow it. */
  async bundleHead(): Promise<BundleHead> {
    const [reply, raw] = await this.library.call("publish", { collection: this.name });
    const { head: _, ...rest } = plain(reply);
    return { ...rest, head: raw.file(reply.head) };
  }

  /** The array file of a shape, which must have this BLAKE3. */
  async arrayFile(name: string, blake3: string): Promise<Uint8Array> {
    const [reply, raw] = await this.library.call("getArrayFile", { collection: this.name, shape: name, blake3 });
    return raw.file(reply.bytes);
  }

  /** Removes a shape. */
  async remove(name: string): Promise<void> {
    await this.library.call("removeShape", { collection: this.name, shape: name });
  }

  /**
   * At most 256 shapes in the compact form that the viewer draws, which docs/viewer.md describes. With
   * the number of a proposal, the proxy has its classes in place of the labels.
   */
  async portraits(
    names: readonly string[],
    detail: "proxy" | "surface" | "functions" = "proxy",
    options: { proposal?: number } = {},
  ): Promise<Uint8Array> {
    const wanted = PortraitDetail[detail.toUpperCase() as keyof typeof PortraitDetail];
    const { proposal = 0 } = options;
    const request = { collection: this.name, shapes: [...names], detail: wanted, proposal };
    const [reply, raw] = await this.library.call("getPortraits", request);
    return raw.file(reply.pack);
  }

  /**
   * Eigenvalues and, optionally, eigenvectors and mass: a row for each vertex of the mesh as sent, or
   * as the resolution says. On the working mesh ("proxy") the eigenvectors are orthonormal; at other
   * resolutions they are interpolated, and NaN at vertices without a face.
   */
  async spectrum(name: string, options: { eigenvectors?: boolean } & Rows = {}): Promise<Spectrum> {
    const { eigenvectors = false, resolution = "input" } = options;
    const rows = { resolution: wireResolution(resolution) };
    const request = { collection: this.name, shape: name, eigenvectors, ...rows };
    const [reply, raw] = await this.library.call("getSpectrum", request);
    if (eigenvectors) checkResolution(reply.resolution, resolution);
    return {
      eigenvalues: raw.array(Float64Array, reply.eigenvalues).data,
      ...(reply.eigenvectors && { eigenvectors: raw.array(Float32Array, reply.eigenvectors) }),
      ...(reply.mass && { mass: raw.array(Float32Array, reply.mass).data }),
      area: reply.area,
    };
  }

  /**
   * (n, t) heat kernel signature: a row for each vertex of the mesh as sent, or as the resolution
   * says.
   */
  async hks(name: string, { resolution = "input" }: Rows = {}): Promise<Matrix<Float32Array>> {
    const request = { collection: this.name, shape: name, resolution: wireResolution(resolution) };
    const [reply, raw] = await this.library.call("getHks", request);
    checkResolution(reply.resolution, resolution);
    return raw.array(Float32Array, reply.hks);
  }

  /** The working mesh and the data from which the segmentation is computed. */
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
   * The functional map that transfers functions on `from` to functions on `to`, and the pointwise
   * map back: the stored part map that propagates labels, or, with options of {@link Points}, a map
   * between points, computed in about 0.1 s. The pointwise map is between the vertices of the meshes
   * as sent, or as the resolution says.
   */
  async map(from: string, to: string, options?: MapOptions): Promise<FunctionalMap> {
    const { resolution = "input", ...wish } = options ?? {};
    const onlyRows = options?.resolution !== undefined && Object.keys(wish).length === 0;
    const request = {
      collection: this.name,
      from,
      to,
      resolution: wireResolution(resolution),
      ...("agreement" in wish && { agreement: wish.agreement }),
      ...(options && !onlyRows && !("agreement" in wish) && { points: pointOptions(wish, resolution) }),
    };
    const [reply, raw] = await this.library.call("getFunctionalMap", request);
    checkResolution(reply.resolution, resolution);
    return functionalMap(from, to, resolution, reply, raw);
  }

  /**
   * Transfers values at the faces of `from` to those of `to`, by a map between points. An
   * Int32Array has one label for each face, transferred by majority; a Float32Array has one or more
   * values for each face, which are averaged. With the resolution "input" values are at the vertices
   * of the meshes as sent: labels are those of the corresponding vertex, numbers are interpolated;
   * with "proxy" at the vertices of the working meshes.
   */
  async transfer<T extends Int32Array | Float32Array>(
    values: T,
    from: string,
    to: string,
    points: Points & Rows = {},
  ): Promise<T> {
    return (await this.transferred(values, from, to, points)).values;
  }

  /** The result of {@link transfer}, with the quality of the map. */
  async transferred<T extends Int32Array | Float32Array>(
    values: T,
    from: string,
    to: string,
    points: Points & Rows = {},
  ): Promise<Transferred<T>> {
    const writer = new FrameWriter();
    const { resolution = "input_faces" } = points;
    const rows = { resolution: wireResolution(resolution) };
    let shape = [values.length];
    if (values instanceof Float32Array) {
      const { nPolygons, report } = await this.shape(from);
      if (report === undefined) throw new BadReply("the report of a shape is missing");
      const n = { input: report.nVertices, input_faces: nPolygons, proxy: report.nProxyVertices }[resolution];
      if (values.length === 0 || values.length % n !== 0) {
        const what = { input: "vertices", input_faces: "faces", proxy: "vertices of the working mesh" }[resolution];
        throw new CosegError(`${values.length} values are not as many for each of the ${n} ${what} of ${from}`);
      }
      shape = [n, values.length / n];
    }
    const array = writer.array(values, ...shape);
    const wish = { values: array, points: pointOptions(points, resolution), ...rows };
    const request = { collection: this.name, from, to, ...wish };
    const [reply, raw] = await this.library.call("transferFunction", request, { frames: writer.frames });
    // A daemon that is too old takes landmarks for vertices of the working meshes.
    const isBare = wish.points.landmarks.length === 0;
    checkResolution(reply.resolution, resolution, isBare ? "input_faces" : "nothing");
    const type = values.constructor as new (buffer: ArrayBuffer) => T;
    return { values: raw.array(type, reply.values).data, quality: mapQuality(reply.quality) };
  }

  /** The matching parts of `a` and `b`. */
  async matchParts(a: string, b: string): Promise<PartMatches> {
    const request = { collection: this.name, shapeA: a, shapeB: b };
    return plain((await this.library.call("getPartCorrespondence", request))[0]);
  }

  /** The shapes most similar to one shape, nearest first. */
  async nearest(name: string, limit = 5): Promise<Neighbor[]> {
    const [reply] = await this.library.call("nearest", { collection: this.name, shape: name, limit });
    return reply.neighbors.map(plain);
  }

  /**
   * Labels faces of a shape by hand: an integer for each face (−1 leaves it unchanged), one label
   * for some faces, or one for a part. Only a person changes these labels again; other shapes
   * follow: {@link waitIdle}. With `closed` there are no labels but those that persons used; if it
   * is false, discovered labels that no labelled shape shows are labels too; without it that stays
   * as it is.
   */
  async correct(
    name: string,
    correction:
      | Int32Array
      | { readonly faces: Uint32Array; readonly label: number | string }
      | { readonly part: number; readonly label: number | string },
    options: { readonly closed?: boolean } = {},
  ): Promise<Corrected> {
    const writer = new FrameWriter();
    const what =
      correction instanceof Int32Array
        ? { case: "labels" as const, value: writer.array(correction, correction.length) }
        : "faces" in correction
          ? {
              case: "faces" as const,
              value: { faces: writer.array(correction.faces, correction.faces.length), label: await this.#label(correction.label) },
            }
          : { case: "part" as const, value: { part: correction.part, label: await this.#label(correction.label) } };
    const request = { collection: this.name, shape: name, correction: what, ...options };
    const [reply] = await this.library.call("correctLabels", request, { frames: writer.frames });
    return { ...plain(reply), jobId: reply.jobId };
  }

  /** Gives a label, selected by its id or present name, a name. */
  async nameLabel(label: number | string, name: string): Promise<Label> {
    const request = { collection: this.name, label: await this.#label(label), name };
    const [reply] = await this.library.call("nameLabel", request);
    return present(reply.label);
  }

  /** Merges two labels, given by id or name: faces of `label` have `into` from now on. */
  async merge(label: number | string, into: number | string): Promise<ChangedLabel> {
    const request = { collection: this.name, label: await this.#label(label), into: await this.#label(into) };
    const [reply] = await this.library.call("mergeLabels", request);
    return { ...present(reply.label), nChanged: Number(reply.nShapes) };
  }

  /** Splits a label, given by id or name, and returns the new one. */
  async split(label: number | string): Promise<ChangedLabel> {
    const request = { collection: this.name, label: await this.#label(label) };
    const [reply] = await this.library.call("splitLabel", request);
    return { ...present(reply.label), nChanged: Number(reply.nShapes) };
  }

  /** The id of a label; text of digits is an id, other text the name of a label in use. */
  async #label(label: number | string): Promise<number> {
    if (typeof label === "number") return label;
    if (/^[0-9]+$/.test(label)) return Number(label);
    const inUse = (await this.info()).labels.filter((l) => l.mergedInto === undefined);
    const found = inUse.filter((l) => label !== "" && l.name === label).map((l) => l.id);
    if (found.length === 0) throw new CosegError(`no label of ${this.name} is named ${JSON.stringify(label)}`);
    if (found.length > 1) {
      throw new CosegError(`${found.length} labels are named ${JSON.stringify(label)}, choose one by its id: ${found.join(", ")}`);
    }
    return found[0]!;
  }

  /** Undoes the newest correction, name, merge, split, link, change of the up axis or choice. */
  async undo(): Promise<Undone> {
    return plain((await this.library.call("undo", { collection: this.name }))[0]);
  }

  /** The part whose label is worth most to ask a person for, or undefined if there is none. */
  async ask(options: { passed?: boolean } = {}): Promise<Question | undefined> {
    try {
      const request = { collection: this.name, passed: options.passed ?? false };
      const [reply, raw] = await this.library.call("nextQuestion", request);
      return { ...plain(reply), faces: raw.array(Uint32Array, reply.faces).data };
    } catch (e) {
      if (e instanceof Refused && e.reason === "NOTHING_TO_ASK") return undefined;
      throw e;
    }
  }

  /** Answers a question about a part of a shape. */
  async answer(name: string, part: number, answer: Answer, options: { by?: string } = {}): Promise<Answered> {
    const what =
      "label" in answer
        ? { case: "label" as const, value: await this.#label(answer.label) }
        : "named" in answer
          ? { case: "named" as const, value: answer.named }
          : "skip" in answer
            ? { case: "skip" as const, value: true }
            : { case: "cutWrongly" as const, value: true };
    const request = { collection: this.name, shape: name, part, answer: what, by: options.by ?? "" };
    const [reply] = await this.library.call("answerQuestion", request);
    const { label, corrected } = reply;
    return {
      ...(label !== undefined && { label }),
      ...(corrected && { corrected: { ...plain(corrected), jobId: corrected.jobId } }),
    };
  }

  /** Takes all present labels of a shape as a person's; `doubtful` only notes that something is wrong with them. */
  async approve(name: string, options: { doubtful?: boolean; by?: string } = {}): Promise<Corrected | undefined> {
    const state = options.doubtful ? ReviewState.DOUBTFUL : ReviewState.APPROVED;
    const request = { collection: this.name, shape: name, state, by: options.by ?? "" };
    const [{ corrected }] = await this.library.call("reviewShape", request);
    return corrected && { ...plain(corrected), jobId: corrected.jobId };
  }

  /**
   * Divisions of the shapes into labels, from coarse to fine, of which `choose` makes one the labels. They are made in
   * the background: `nSteps` is 0 once they are those for the present labels.
   */
  async proposals(): Promise<Proposals> {
    return plain((await this.library.call("listProposals", { collection: this.name }))[0]);
  }

  /**
   * The class of each face of each shape in proposal `n`, by the names of the shapes that it divides, at most 40. Classes
   * become label ids when it is chosen.
   */
  async proposedLabels(n: number): Promise<Map<string, Int32Array>> {
    const [reply, raw] = await this.library.call("getProposal", { collection: this.name, n });
    return new Map(reply.shapes.map((s) => [s.shape, raw.array(Int32Array, s.labels).data]));
  }

  /** Makes proposal `n` the labels; `set`, if given, must be that of the present proposals. */
  async choose(n: number, options: { set?: string } = {}): Promise<Chosen> {
    const request = { collection: this.name, n, set: options.set ?? "" };
    return plain((await this.library.call("chooseProposal", request))[0]);
  }

  /** Demands that two parts have the same label. */
  async same(a: PartOfShape, b: PartOfShape, options: { by?: string } = {}): Promise<Linked> {
    return this.#link(LinkKind.SAME, a, b, options);
  }

  /** Demands that two parts have different labels. */
  async differ(a: PartOfShape, b: PartOfShape, options: { by?: string } = {}): Promise<Linked> {
    return this.#link(LinkKind.DIFFER, a, b, options);
  }

  async #link(kind: LinkKind, a: PartOfShape, b: PartOfShape, options: { by?: string }): Promise<Linked> {
    const request = { collection: this.name, kind, a: { ...a }, b: { ...b }, by: options.by ?? "" };
    const [reply] = await this.library.call("linkParts", request);
    return { ...plain(reply), link: link(reply.link), jobId: reply.jobId };
  }

  /** Removes the link with this id. */
  async unlink(id: number): Promise<Linked> {
    const [reply] = await this.library.call("unlinkParts", { collection: this.name, id: BigInt(id) });
    return { ...plain(reply), link: link(reply.link), changed: true, jobId: reply.jobId };
  }

  /** Links between parts, the oldest first; with `shape` only those of its parts. */
  async links(shape = ""): Promise<Link[]> {
    const [reply] = await this.library.call("listLinks", { collection: this.name, shape });
    return reply.links.map(link);
  }

  /** The shape that is most worth labelling by hand, or undefined if there is none. */
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
   * Events in order, each exactly once: those after `since` (default: from now on), then new ones
   * as they happen, without end. Events that the event socket drops are read from the log. If the
   * daemon restarts, the client waits for it, at most `patience` seconds (default: without limit).
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

  /** Yields events after `seen` until the subscription falls silent. */
  async *#follow(subscription: Subscription, seen: number): AsyncGenerator<Event> {
    let newest: number | undefined;
    for (;;) {
      if (newest === undefined || newest > seen) {
        // The log has the events before the subscription, and those that it dropped.
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

  /** The event endpoint of a daemon that may be unreachable at the moment. */
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

/** A daemon that listens on all addresses names no host; the known host is used instead. */
export function reachable(announced: string, endpoint: string): string {
  const every = /^tcp:\/\/(?:0\.0\.0\.0|\[::\]|\*):(\d+)$/.exec(announced);
  const known = /^tcp:\/\/(.+):\d+$/.exec(endpoint);
  return every && known ? `tcp://${known[1]}:${every[1]}` : announced;
}
