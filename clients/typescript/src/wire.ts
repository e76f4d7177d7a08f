/** Converts values to frames and back, without sockets. */

import { extname } from "node:path";
import { create, type Message } from "@bufbuild/protobuf";
import { BadMesh, BadReply } from "./errors.js";
import { readMesh } from "./gltf.js";
import { ArrayRefSchema, BytesRefSchema, DataType, type ArrayRef, type BytesRef } from "./gen/coseg/v1/array_pb.js";
import { ArrayMeshSchema, EncodedMeshSchema, MeshFormat, ShapeInputSchema, type ShapeInput } from "./gen/coseg/v1/job_pb.js";

/** The bytes of a mesh file and their format, such as `off`. */
export interface Encoded {
  readonly format: string;
  readonly data: Uint8Array;
}

/**
 * A mesh as arrays: x, y, z of each vertex, and the vertices of each face, all of `faceSize`
 * corners (3).
 */
export interface Arrays {
  readonly vertices: Float32Array | Float64Array | readonly number[];
  readonly faces: Uint32Array | Int32Array | readonly number[];
  readonly faceSize?: number;
}

/** A mesh: the path of a file, the bytes of a file, or arrays. */
export type Mesh = string | Encoded | Arrays;

/** An array and its extents, row-major. */
export interface Matrix<T> {
  readonly data: T;
  readonly shape: readonly number[];
}

/** A message as plain values: counts are numbers. */
export type Plain<T> = T extends bigint
  ? number
  : T extends Uint8Array | string | number | boolean | undefined
    ? T
    : T extends readonly (infer E)[]
      ? Plain<E>[]
      : { readonly [K in keyof T as K extends "$typeName" | "$unknown" ? never : K]: Plain<T[K]> };

/** A message's fields as plain values. */
export function plain<T>(value: T): Plain<T> {
  if (typeof value === "bigint") return Number(value) as Plain<T>;
  if (Array.isArray(value)) return value.map(plain) as Plain<T>;
  if (typeof value !== "object" || value === null || value instanceof Uint8Array) return value as Plain<T>;
  const entries = Object.entries(value as unknown as Message).filter(([name]) => !name.startsWith("$"));
  return Object.fromEntries(entries.map(([name, v]) => [name, plain(v)])) as Plain<T>;
}

type Typed = Int32Array | Uint32Array | Float32Array | Float64Array;

const TYPES = new Map<DataType, new (buffer: ArrayBuffer) => Typed>([
  [DataType.INT32, Int32Array],
  [DataType.UINT32, Uint32Array],
  [DataType.FLOAT32, Float32Array],
  [DataType.FLOAT64, Float64Array],
]);

/** Collects the raw frames of a request. */
export class FrameWriter {
  readonly frames: Uint8Array[] = [];
  nBytes = 0;

  /** Appends the bytes of a file. */
  file(data: Uint8Array): BytesRef {
    return create(BytesRefSchema, { frame: this.#push(data) });
  }

  /** Appends an array of the extents. */
  array(data: Typed, ...shape: number[]): ArrayRef {
    const dtype = [...TYPES].find(([, type]) => data instanceof type)![0];
    const frame = this.#push(new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
    return create(ArrayRefSchema, { dtype, shape: shape.map(BigInt), frame });
  }

  #push(frame: Uint8Array): number {
    this.nBytes += frame.length;
    return this.frames.push(frame) - 1;
  }
}

/** The raw frames of a reply. */
export class Raw {
  constructor(readonly frames: readonly Uint8Array[]) {}

  /** An array, copied from its frame. */
  array<T extends Typed>(type: new (buffer: ArrayBuffer) => T, ref: ArrayRef | undefined): Matrix<T> {
    const shape = (ref?.shape ?? []).map(Number);
    if (ref === undefined || TYPES.get(ref.dtype) !== (type as unknown)) {
      throw new BadReply(`an array has element type ${ref?.dtype}, expected ${type.name}`);
    }
    const frame = this.#frame(ref.frame);
    // A copy is needed, since a frame may be unaligned for its elements.
    const data = new type(frame.slice().buffer as ArrayBuffer);
    if (data.length !== shape.reduce((a, b) => a * b, 1)) {
      throw new BadReply(`an array of shape ${shape} has ${data.length} elements`);
    }
    return { data, shape };
  }

  /** The bytes of a file. */
  file(ref: BytesRef | undefined): Uint8Array {
    return this.#frame(ref?.frame ?? -1);
  }

  #frame(index: number): Uint8Array {
    const frame = this.frames[index];
    if (frame === undefined) throw new BadReply(`frame ${index} is named, the reply has ${this.frames.length}`);
    return frame;
  }
}

/** The format with this name or file extension. */
export function meshFormat(name: string): MeshFormat {
  // A GLB is a glTF in one binary file.
  if (name.toLowerCase() === "glb") return MeshFormat.GLTF;
  const format = MeshFormat[name.toUpperCase() as keyof typeof MeshFormat];
  if (typeof format !== "number" || format === MeshFormat.UNSPECIFIED) throw new BadMesh(`${name} is not a mesh format`);
  return format;
}

/** The name of a format, such as `off`. */
export function formatName(format: MeshFormat): string {
  return (MeshFormat[format] ?? String(format)).toLowerCase();
}

/**
 * A shape to add; appends its bytes to `writer`. Throws {@link BadMesh} or an error of reading the
 * file.
 */
export async function shapeInput(name: string, mesh: Mesh, replace: boolean, writer: FrameWriter): Promise<ShapeInput> {
  const shape = create(ShapeInputSchema, { name, replace });
  if (typeof mesh === "string") mesh = { format: extname(mesh).slice(1), data: await readMesh(mesh) };
  if ("data" in mesh) {
    const format = meshFormat(mesh.format);
    shape.source = {
      case: "encoded",
      value: create(EncodedMeshSchema, { format, bytes: writer.file(mesh.data) }),
    };
    return shape;
  }
  const { vertices, faces, faceSize = 3 } = mesh;
  if (vertices.length % 3 !== 0) throw new BadMesh(`${name}: ${vertices.length} coordinates are not a multiple of 3`);
  if (faceSize < 3 || faces.length % faceSize !== 0) {
    throw new BadMesh(`${name}: ${faces.length} corners are not a multiple of ${faceSize}, at least 3`);
  }
  const n = vertices.length / 3;
  const bad = (faces as readonly number[]).findIndex((v) => !Number.isInteger(v) || v < 0 || v >= n);
  if (bad >= 0) {
    throw new BadMesh(`${name}: face ${Math.floor(bad / faceSize)} names vertex ${faces[bad]}, the mesh has ${n}`);
  }
  const coordinates = Array.isArray(vertices) ? Float64Array.from(vertices) : (vertices as Float32Array | Float64Array);
  const corners = Array.isArray(faces) ? Uint32Array.from(faces) : (faces as Uint32Array | Int32Array);
  shape.source = {
    case: "arrays",
    value: create(ArrayMeshSchema, {
      vertices: writer.array(coordinates, n, 3),
      faces: writer.array(corners, corners.length / faceSize, faceSize),
    }),
  };
  return shape;
}
