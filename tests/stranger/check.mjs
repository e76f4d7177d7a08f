// Each GLB named: a node for each part and a material of its own colour for each label, all faces there, and,
// where gltf-validator is installed beside this file, not one error.
import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import { basename } from "node:path";

const validator = await import("gltf-validator").then((m) => m.default, () => null);
const labels = new Set();
for (const path of process.argv.slice(2)) {
  const bytes = await readFile(path);
  assert.equal(bytes.toString("latin1", 0, 4), "glTF", path);
  const gltf = JSON.parse(bytes.toString("utf8", 20, 20 + bytes.readUInt32LE(12)));
  const primitives = gltf.meshes.flatMap((mesh) => mesh.primitives);
  const parts = gltf.nodes.filter((node) => node.extras?.label !== undefined);
  assert.equal(parts.length, primitives.length, path);
  const [colours, here] = [new Set(), new Set()];
  let faces = 0;
  for (const { name, extras, mesh } of parts) {
    assert.match(name, new RegExp(`^label_${extras.label}\\.\\d{3}$`), path);
    assert.equal(gltf.meshes[mesh].primitives[0].extras.label, extras.label, path);
  }
  for (const { indices, material, extras } of primitives) {
    const { name, pbrMetallicRoughness } = gltf.materials[material];
    assert.equal(name, `label_${extras.label}`, path);
    colours.add(String(pbrMetallicRoughness.baseColorFactor));
    labels.add(extras.label);
    here.add(extras.label);
    faces += gltf.accessors[indices].count / 3;
  }
  assert.ok(here.size >= 2, `${path}: ${here.size} labels`);
  assert.equal(colours.size, here.size, `${path}: two labels in one colour`);
  assert.ok(faces > 5000, `${path}: ${faces} faces`);
  let verdict = "";
  if (validator) {
    const { issues } = await validator.validateBytes(new Uint8Array(bytes));
    assert.equal(issues.numErrors, 0, JSON.stringify(issues.messages));
    verdict = ", valid";
  }
  console.log(`${basename(path)}: ${faces} faces, ${parts.length} parts, ${here.size} labels${verdict}`);
}
assert.ok(labels.size >= 3, `only ${labels.size} labels in all`);
if (!validator) console.log("gltf-validator could not be had from npm: not validated");
