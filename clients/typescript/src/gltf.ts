/**
 * Packs a `.gltf` with its buffers in separate files into one binary file (GLB).
 *
 * A buffer is read only from the folder of the file, by a relative path, and only if it contains
 * positions or indices. Textures and other files are not read.
 */

import { readFile, realpath, stat } from "node:fs/promises";
import { dirname, extname, isAbsolute, join, relative, sep } from "node:path";
import { BadMesh } from "./errors.js";

/** Extensions whose views name buffers themselves. */
const COMPRESSIONS = ["EXT_meshopt_compression", "KHR_meshopt_compression"] as const;

interface Part {
  buffer: number;
  byteOffset?: number;
}
interface View extends Part {
  extensions?: { [name: string]: Part };
}
interface Buffer0 {
  byteLength: number;
  uri?: string;
}
interface Accessor {
  bufferView?: number;
  sparse?: { indices: { bufferView: number }; values: { bufferView: number } };
}
interface Root {
  meshes?: { primitives: { attributes: { POSITION?: number }; indices?: number }[] }[];
  accessors?: Accessor[];
  bufferViews?: View[];
  buffers?: Buffer0[];
}

/**
 * The bytes to send for the file at a path. Throws {@link BadMesh} or an error of reading the file.
 */
export async function readMesh(path: string): Promise<Uint8Array> {
  const data = await readFile(path);
  if (![".gltf", ".glb"].includes(extname(path).toLowerCase()) || data.subarray(0, 4).toString("latin1") === "glTF") {
    return data;
  }
  let root: Root;
  let external: Map<number, string>;
  try {
    root = JSON.parse(data.toString("utf8").replace(/^\ufeff/, "")) as Root;
    const uris = needed(root).map((index) => [index, root.buffers![index]!.uri] as const);
    external = new Map(
      uris.filter((entry): entry is readonly [number, string] => entry[1] !== undefined && !/^data:/i.test(entry[1])),
    );
  } catch {
    // The daemon reports the fault.
    return data;
  }
  return external.size > 0 ? pack(root, external, path) : data;
}

/** The buffers that contain positions and indices. */
function needed(root: Root): number[] {
  const primitives = (root.meshes ?? []).flatMap((mesh) => mesh.primitives);
  const accessors = primitives.flatMap((p) => [p.attributes.POSITION, p.indices]).filter((i) => i !== undefined);
  const views = accessors.flatMap((i) => {
    const { bufferView, sparse } = root.accessors![i]!;
    return [bufferView, sparse?.indices.bufferView, sparse?.values.bufferView];
  });
  const buffers = views.filter((i) => i !== undefined).map((i) => {
    const view = root.bufferViews![i]!;
    return parts(view).at(-1)!.buffer;
  });
  return [...new Set(buffers)];
}

/** A view, and the objects that name a buffer in its place. */
function parts(view: View): Part[] {
  const compressed = COMPRESSIONS.map((name) => view.extensions?.[name]);
  return [view, ...compressed.filter((part) => part !== undefined)];
}

async function pack(root: Root, external: Map<number, string>, path: string): Promise<Uint8Array> {
  const pieces: Uint8Array[] = [];
  let length = 0;
  const rest: Buffer0[] = [{ byteLength: 0 }];
  // For each buffer its new index, and its offset in the new buffer.
  const moved: [index: number, begin: number][] = [];
  for (const [index, buffer] of root.buffers!.entries()) {
    const uri = external.get(index);
    if (uri === undefined) {
      moved.push([rest.length, 0]);
      rest.push(buffer);
      continue;
    }
    moved.push([0, length]);
    const bytes = await file(index, buffer, uri, path);
    pieces.push(bytes, new Uint8Array(-bytes.length & 3));
    length += (bytes.length + 3) & ~3;
  }
  rest[0]!.byteLength = length;
  root.buffers = rest;
  for (const part of root.bufferViews!.flatMap(parts)) {
    const [index, begin] = moved[part.buffer]!;
    part.buffer = index;
    if (begin > 0) part.byteOffset = (part.byteOffset ?? 0) + begin;
  }
  const json = Buffer.from(JSON.stringify(root));
  const text = Buffer.concat([json, Buffer.alloc(-json.length & 3, " ")]);
  const total = 12 + 8 + text.length + 8 + length;
  if (total >= 2 ** 32) throw new BadMesh(`${path}: with its buffers it is larger than the 4 GiB that a GLB can have`);
  const words = (kind: string, ...numbers: number[]) => {
    const bytes = Buffer.alloc(4 * numbers.length);
    numbers.forEach((word, i) => bytes.writeUInt32LE(word, 4 * i));
    return [bytes, Buffer.from(kind, "latin1")];
  };
  return Buffer.concat([
    Buffer.from("glTF"),
    ...words("JSON", 2, total, text.length),
    text,
    ...words("BIN\0", length),
    ...pieces,
  ]);
}

/** The bytes of a buffer in a separate file. */
async function file(index: number, buffer: Buffer0, uri: string, mesh: string): Promise<Uint8Array> {
  const fault = (why: string) => new BadMesh(`${mesh}: buffer ${index} is in "${uri}", ${why}`);
  if (/^[a-z][a-z0-9+.-]*:/i.test(uri)) throw fault("and only files beside the mesh are read: download it");
  let decoded: string;
  try {
    decoded = decodeURIComponent(uri);
  } catch {
    throw fault("which is not a valid URI");
  }
  if (decoded === "" || isAbsolute(decoded) || /[\\\0]/.test(decoded) || decoded.split("/").includes("..")) {
    throw fault("but must be in the folder of the file, by a relative path");
  }
  const whole = join(dirname(mesh), decoded);
  const unreadable = (e: unknown) => {
    const { code, message } = e as NodeJS.ErrnoException;
    const missing = "but the folder of the file has no file of that name";
    return fault(code === "ENOENT" ? missing : `which cannot be read: ${message}`);
  };
  const real = await realpath(whole).catch((e: unknown) => Promise.reject(unreadable(e)));
  const below = relative(await realpath(dirname(mesh)), real);
  if (below.split(sep)[0] === ".." || isAbsolute(below)) {
    throw fault("which is a link that leads out of the folder of the file");
  }
  if (!(await stat(real)).isFile()) throw fault("which is not a regular file");
  const bytes = await readFile(real).catch((e: unknown) => Promise.reject(unreadable(e)));
  if (bytes.length < buffer.byteLength) {
    throw fault(`which has ${bytes.length} bytes, but the buffer declares ${buffer.byteLength}`);
  }
  return bytes.subarray(0, buffer.byteLength);
}
