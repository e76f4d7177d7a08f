// Validates GLB files by Khronos's validator and loads them with three.js: node validate.mjs FILE...
import { readFileSync } from "node:fs";
import { basename } from "node:path";
import validator from "gltf-validator";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";

globalThis.self ??= globalThis;
let failed = false;
for (const file of process.argv.slice(2)) {
  const bytes = new Uint8Array(readFileSync(file));
  const { issues } = await validator.validateBytes(bytes);
  const { numErrors, numWarnings, messages } = issues;
  const gltf = await new Promise((resolve, reject) =>
    new GLTFLoader().parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "", resolve, reject),
  );
  const parts = [];
  gltf.scene.traverse((o) => o.isMesh && parts.push(`${o.material.name}: ${o.geometry.index.count / 3}`));
  console.log(`${basename(file)}: ${numErrors} errors, ${numWarnings} warnings; three.js: ${parts.join(", ")}`);
  for (const m of messages.filter((m) => m.severity < 2)) console.log(`  ${m.code} ${m.pointer}: ${m.message}`);
  failed ||= numErrors > 0 || parts.length === 0;
}
process.exit(failed ? 1 : 0);
