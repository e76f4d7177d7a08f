// Validates GLB files by Khronos's validator, loads them with three.js and compares their parts with what check.py
// found: node validate.mjs PARTS.json FILE...
import { readFileSync } from "node:fs";
import assert from "node:assert/strict";
import { basename } from "node:path";
import validator from "gltf-validator";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

globalThis.self ??= globalThis;
let failed = false;
// No textures are decoded here.
globalThis.createImageBitmap ??= async () => ({ width: 1, height: 1, close() {} });
const expected = JSON.parse(readFileSync(process.argv[2], "utf8"));
for (const file of process.argv.slice(3)) {
  const bytes = new Uint8Array(readFileSync(file));
  const { issues } = await validator.validateBytes(bytes);
  const { numErrors, numWarnings, messages } = issues;
  const gltf = await new Promise((resolve, reject) =>
    new GLTFLoader().parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "", resolve, reject),
  );
  // three.js takes dots out of names of objects, and keeps the file's in userData.
  const parts = {};
  gltf.scene.traverse((o) => {
    if (!o.isMesh) return;
    const { name, label } = o.userData;
    assert.equal(typeof label, "number", name);
    parts[name] = o.geometry.index.count / 3;
  });
  assert.deepEqual(parts, expected[basename(file, ".glb")].glb);
  const shown = Object.entries(parts).map(([name, n]) => `${name}: ${n}`);
  console.log(`${basename(file)}: ${numErrors} errors, ${numWarnings} warnings; three.js: ${shown.join(", ")}`);
  for (const m of messages.filter((m) => m.severity < 2)) console.log(`  ${m.code} ${m.pointer}: ${m.message}`);
  failed ||= numErrors + numWarnings > 0 || shown.length === 0;
}
process.exit(failed ? 1 : 0);
