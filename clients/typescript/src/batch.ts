/** Cuts a stream of meshes into requests of bounded size, whose ids identify their contents. */

import { createHash } from "node:crypto";
import { basename, extname } from "node:path";
import { create, toBinary } from "@bufbuild/protobuf";
import { BadMesh } from "./errors.js";
import type { CollectionSpec } from "./gen/coseg/v1/collection_pb.js";
import type { Limits } from "./gen/coseg/v1/daemon_pb.js";
import { AddMode, AddShapesRequestSchema, type AddShapesRequest, type ShapeInput } from "./gen/coseg/v1/job_pb.js";
import { beyond } from "./size.js";
import { FrameWriter, shapeInput, type Mesh } from "./wire.js";

/**
 * Shapes and bytes of one request: small enough that the daemon works on the first while the next
 * is read.
 */
const BATCH_SHAPES = 16;
const BATCH_BYTES = 16 << 20;

/**
 * An input of `addMany`: a path, whose file name without extension becomes the shape's name, or a
 * name and a mesh.
 */
export type Item = string | readonly [name: string, mesh: Mesh];

/** A shape that could not be sent. */
export interface Unsent {
  readonly name: string;
  readonly error: Error;
}

/** Shapes of one request, and the shapes between them that could not be sent. */
export class Batch {
  readonly writer = new FrameWriter();
  /** In order: a shape that was not sent, or undefined for the next shape of the request. */
  readonly results: (Unsent | undefined)[] = [];

  constructor(readonly request: AddShapesRequest) {}

  /** Equal for equal shapes at the same position, for any sender. */
  requestId(index: number): string {
    const digest = createHash("sha256").update(toBinary(AddShapesRequestSchema, this.request));
    for (const frame of this.writer.frames) digest.update(`${frame.length},`).update(frame);
    return `${index}-${digest.digest("hex").slice(0, 32)}`;
  }
}

/** Cuts a stream into batches; a shape that cannot be read becomes a failed result in its place. */
export async function* batches(
  collection: string,
  items: Iterable<Item> | AsyncIterable<Item>,
  limits: Limits,
  inFlight: number,
  replace: boolean,
  spec: CollectionSpec,
): AsyncGenerator<Batch> {
  if (!(inFlight >= 1)) throw new RangeError(`inFlight is ${inFlight}, expected at least 1`);
  // The daemon would always refuse a batch that exceeds its whole queue.
  const bounds = [BATCH_SHAPES, inFlight >> 2, limits.maxShapesPerRequest, Number(limits.maxQueuedShapes)];
  const nShapes = Math.max(1, Math.min(...bounds));
  const maxMessage = Number(limits.maxMessageBytes);
  const nBytes = Math.min(BATCH_BYTES, maxMessage / 2);
  const fresh = () => new Batch(create(AddShapesRequestSchema, { collection, mode: AddMode.JOB, create: spec }));
  let batch = fresh();
  for await (const item of items) {
    const [name, mesh] = typeof item === "string" ? [basename(item, extname(item)), item] : item;
    const one = new FrameWriter();
    let shape: ShapeInput;
    try {
      shape = await shapeInput(name, mesh, replace, one);
      if (shape.source.case === "encoded" && one.nBytes > Number(limits.maxShapeBytes)) {
        const key = "limits.max_shape, within limits.memory";
        throw new BadMesh(beyond(`${name}: the file has`, one.nBytes, Number(limits.maxShapeBytes), key));
      }
      if (one.nBytes > (maxMessage * 15) / 16) {
        const key = "limits.max_message, of which arrays may have 15 in 16";
        throw new BadMesh(beyond(`${name}: the arrays have`, one.nBytes, maxMessage, key));
      }
    } catch (e) {
      batch.results.push({ name, error: e instanceof Error ? e : new Error(String(e)) });
      continue;
    }
    const n = batch.request.shapes.length;
    if (n > 0 && (n === nShapes || batch.writer.nBytes + one.nBytes > nBytes)) {
      yield batch;
      batch = fresh();
    }
    const first = batch.writer.frames.length;
    if (shape.source.case === "encoded") shape.source.value.bytes!.frame += first;
    if (shape.source.case === "arrays") {
      shape.source.value.vertices!.frame += first;
      shape.source.value.faces!.frame += first;
    }
    batch.request.shapes.push(shape);
    batch.writer.frames.push(...one.frames);
    batch.writer.nBytes += one.nBytes;
    batch.results.push(undefined);
  }
  if (batch.results.length > 0) yield batch;
}
