/** Tests that a `.gltf` with its buffers in separate files is sent as one file, or not at all. */

import assert from "node:assert/strict";
import { mkdirSync, mkdtempSync, readFileSync, rmSync, symlinkSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import * as coseg from "../src/index.js";
import { FrameWriter, shapeInput } from "../src/wire.js";
import { chairs as makeChairs, Daemon, readOff } from "./daemon.js";

const [mesh] = makeChairs(1);
const { vertices, faces } = readOff(mesh!);
let daemon: Daemon;
let folder: string;

before(async () => {
  daemon = await Daemon.started();
  folder = mkdtempSync(join(tmpdir(), "coseg"));
});

after(async () => {
  await daemon.close();
  rmSync(folder, { recursive: true });
});

/** A file whose positions and indices are in separate files. */
function written(positions = "data/a%20b.bin", indices = "./i.bin"): string {
  const at = join(folder, "mesh");
  mkdirSync(join(at, "data"), { recursive: true });
  writeFileSync(join(at, "data", "a b.bin"), new Uint8Array(Float32Array.from(vertices).buffer));
  writeFileSync(join(at, "i.bin"), new Uint8Array(Uint32Array.from([0, ...faces]).buffer));
  const n = vertices.length / 3;
  const scene = {
    asset: { version: "2.0" },
    scenes: [{ nodes: [0] }],
    nodes: [{ mesh: 0 }],
    meshes: [{ primitives: [{ attributes: { POSITION: 0 }, indices: 1 }] }],
    images: [{ uri: "nowhere.png" }],
    accessors: [
      { bufferView: 0, componentType: 5126, count: n, type: "VEC3" },
      { bufferView: 1, componentType: 5125, count: faces.length, type: "SCALAR" },
    ],
    bufferViews: [
      { buffer: 0, byteLength: 12 * n },
      { buffer: 2, byteOffset: 4, byteLength: 4 * faces.length },
    ],
    buffers: [
      { byteLength: 12 * n, uri: positions },
      { byteLength: 4, uri: "missing.bin" },
      { byteLength: 4 + 4 * faces.length, uri: indices },
    ],
  };
  const path = join(at, "chair.gltf");
  writeFileSync(path, JSON.stringify(scene));
  return path;
}

test("it is labelled as its triangles are", async () => {
  const lib = new coseg.Library({ endpoint: daemon.endpoint });
  const collection = lib.collection("gltf", { parts: 4, up: "+y" });
  for await (const added of collection.addMany([written()])) assert.ok(added.ok, added.error?.message);
  assert.equal((await collection.labels("chair")).length, faces.length / 3);
  const { data } = await collection.original("chair");
  assert.equal(Buffer.from(data.subarray(0, 4)).toString(), "glTF");
  assert.ok(Buffer.from(data).includes("nowhere.png") && Buffer.from(data).includes("missing.bin"));
  lib.close();
});

test("a buffer elsewhere is refused by its name", async () => {
  writeFileSync(join(folder, "secret.bin"), new Uint8Array(1 << 20));
  written();
  symlinkSync(join(folder, "secret.bin"), join(folder, "mesh", "link.bin"));
  for (const [uri, part] of [
    ["gone.bin", "has no file of that name"],
    ["../secret.bin", "must be in the folder"],
    ["%2e%2e/secret.bin", "must be in the folder"],
    ["data/..%2F..%2Fsecret.bin", "must be in the folder"],
    ["..%5Csecret.bin", "must be in the folder"],
    ["/etc/hostname", "must be in the folder"],
    ["https://example.com/a.bin", "only files beside the mesh"],
    ["link.bin", "a link that leads out"],
    ["data", "not a regular file"],
  ] as const) {
    const refused = shapeInput("a", written(uri), false, new FrameWriter());
    await assert.rejects(refused, (e: Error) => e instanceof coseg.BadMesh && e.message.includes(part), uri);
  }
});

test("what needs no other file is sent as it is", async () => {
  const data = "data:application/octet-stream;base64,AAAA";
  const writer = new FrameWriter();
  const path = written(data, data);
  await shapeInput("a", path, false, writer);
  assert.deepEqual(Buffer.from(writer.frames[0]!), readFileSync(path));
});
