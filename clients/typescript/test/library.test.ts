/** Tests the client with the real daemon. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { basename } from "node:path";
import { after, before, test } from "node:test";
import { curveKeyPair, Router } from "zeromq";
import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import * as coseg from "../src/index.js";
import { ReplySchema, RequestSchema } from "../src/gen/coseg/v1/message_pb.js";
import { chairs as makeChairs, Daemon, readOff } from "./daemon.js";

const meshes = makeChairs(8);
const names = meshes.map((path) => basename(path, ".off"));
let daemon: Daemon;
let lib: coseg.Library;
let chairs: coseg.Collection;

before(async () => {
  daemon = await Daemon.started();
  lib = new coseg.Library({ endpoint: daemon.endpoint });
  chairs = lib.collection("chairs", { parts: 4, up: "+y" });
  for await (const added of chairs.addMany(meshes.slice(0, 4))) assert.ok(added.ok, added.error?.message);
  await chairs.waitIdle();
});

after(async () => {
  lib.close();
  await daemon.close();
});

async function all<T>(values: AsyncIterable<T>): Promise<T[]> {
  const found: T[] = [];
  for await (const value of values) found.push(value);
  return found;
}

test("the daemon introduces itself", async () => {
  const hello = await lib.hello();
  assert.equal(hello.protocol, "coseg.v1");
  assert.equal(typeof hello.limits!.maxMessageBytes, "number");
  assert.equal((await lib.stats()).version, hello.version);
});

test("labels come for each face in the order that was sent", async () => {
  const { vertices, faces } = readOff(meshes[0]!);
  const labels = await chairs.labels(names[0]!);
  assert.ok(labels instanceof Int32Array);
  assert.equal(labels.length, faces.length / 3);
  const full = await chairs.labelling(names[0]!, { confidence: true });
  assert.equal(full.confidence!.length, labels.length);
  // The same arrays backwards give the labels backwards.
  const back = lib.collection("back", { parts: 4, up: "+y" });
  const corners = Array.from({ length: faces.length / 3 }, (_, i) => [...faces.slice(3 * i, 3 * i + 3)]);
  await back.add("forwards", { vertices, faces });
  await back.add("backwards", { vertices: [...vertices], faces: corners.reverse().flat() });
  const forwards = await back.labels("forwards");
  const backwards = (await back.labels("backwards")).reverse();
  const same = forwards.filter((label, i) => label === backwards[i]).length;
  assert.ok(same > 0.98 * labels.length, `${same} of ${labels.length}`);
  await back.delete();
});

test("shapes tell what they are", async () => {
  const shapes = await all(chairs.shapes());
  assert.deepEqual(shapes.map((s) => s.name), names.slice(0, 4));
  const shape = await chairs.shape(names[0]!);
  assert.equal(shape.ordinal, 1);
  assert.equal(shape.report!.nTriangles, shape.nPolygons);
  assert.deepEqual(Buffer.from((await chairs.original(names[0]!)).data), readFileSync(meshes[0]!));
  const info = await chairs.info();
  assert.deepEqual([info.spec!.name, info.spec!.nParts, info.nShapes], ["chairs", 4, 4]);
  const [label] = info.labels;
  assert.equal((await all(chairs.shapes({ label: label!.id }))).length, label!.nShapes);
  const snapshot = await chairs.snapshot();
  assert.equal(snapshot.sequence, info.sequence);
  assert.deepEqual(snapshot.shapes.get(names[1]!)!.labels, await chairs.labels(names[1]!));
});

test("spectra and maps are arrays", async () => {
  const [a, b] = names as [string, string];
  const spectrum = await chairs.spectrum(a, { eigenvectors: true, resolution: "proxy" });
  assert.ok(spectrum.eigenvalues.every((v, i, all) => i === 0 || v >= all[i - 1]!));
  const [n] = spectrum.eigenvectors!.shape;
  assert.equal(spectrum.mass!.length, n);
  assert.equal((await chairs.hks(a, { resolution: "proxy" })).shape[0], n);
  const proxy = await chairs.descriptors(a);
  assert.deepEqual(proxy.vertices.shape, [n, 3]);
  const map = await lib.map(a, b, "chairs", { resolution: "proxy" });
  assert.deepEqual([map.n1, map.resolution, map.quality.expectedError], [n, "proxy", undefined]);
  assert.equal(map.c12.data.length, map.c12.shape[0]! * map.c12.shape[1]!);
  assert.ok(map.p2p21.every((v) => v < n!));
  assert.ok(map.quality.coverage > 0);
  assert.equal(map.matched.length, map.confidence!.length);
  const { agreement } = await chairs.map(a, b, { agreement: true });
  assert.ok(agreement!.nTriangles > 1 || !agreement!.inconsistent);
  const turned = await chairs.map(a, b, { orientation: "reverse", k: 30, alternative: true });
  assert.ok(turned.quality.orientation! < 0 && turned.alternative!.quality.orientation! > 0);
  assert.ok(turned.alternativeCost! > 0 && turned.alternative!.c12.shape[0] === 30);
  const dense = await lib.map(a, b, "chairs", { landmarks: [[map.p2p21[0]!, 0]] });
  assert.ok(dense.quality.expectedError! > 0 && map.quality.expectedError === undefined);
  const ones = await chairs.transfer(new Float32Array((await chairs.labels(a)).length).fill(1), a, b);
  assert.ok(ones.length === (await chairs.labels(b)).length && ones.every((v) => Math.abs(v - 1) < 1e-5));
  assert.ok((await chairs.transfer(await chairs.labels(a), a, b)) instanceof Int32Array);
  assert.ok((await chairs.matchParts(a, b)).matches.length > 0);
  assert.equal((await chairs.nearest(a, 2)).length, 2);
  const maps = await Promise.all(names.slice(1, 4).map((to) => chairs.map(a, to)));
  assert.deepEqual(maps.map((m) => m.to), names.slice(1, 4));
});

test("arrays are of the mesh as sent", async () => {
  const [a, b] = names as [string, string];
  // Its working meshes are coarser than the files.
  const chairs = lib.collection("coarse", { parts: 4, up: "+y", workingFaces: 500 });
  for await (const { ok } of chairs.addMany(meshes.slice(0, 2))) assert.ok(ok);
  const [one, two] = [await chairs.shape(a), await chairs.shape(b)];
  const [n, n2] = [one.report!.nVertices, two.report!.nVertices];
  assert.notEqual(n, one.report!.nProxyVertices);
  const spectrum = await chairs.spectrum(a, { eigenvectors: true });
  assert.equal(spectrum.eigenvectors!.shape[0], n);
  assert.ok(Math.abs(spectrum.mass!.reduce((sum, m) => sum + m, 0) - 1) < 1e-4);
  assert.equal((await chairs.hks(a)).shape[0], n);
  assert.equal((await chairs.hks(a, { resolution: "input_faces" })).shape[0], one.nPolygons);
  const map = await chairs.map(a, b);
  assert.deepEqual([map.n1, map.p2p21.length, map.resolution], [n, n2, "input"]);
  assert.ok(map.p2p21.every((v) => v < n));
  const faces = await chairs.map(a, b, { resolution: "input_faces" });
  assert.deepEqual([faces.n1, faces.p2p21.length, faces.quality.expectedError], [one.nPolygons, two.nPolygons, undefined]);
  // A constant stays one at every vertex that has a counterpart.
  const ones = await chairs.transfer(new Float32Array(2 * n).fill(1), a, b, { resolution: "input" });
  assert.equal(ones.length, 2 * n2);
  assert.ok(ones.every((v) => Number.isNaN(v) || Math.abs(v - 1) < 1e-5) && ones.some((v) => v > 0));
  const ids = await chairs.transfer(Int32Array.from({ length: n }, (_, i) => i), a, b, { resolution: "input" });
  assert.ok(ids.length === n2 && ids.every((v) => v >= -1 && v < n));
  // Landmarks are vertices of the files; what has the wrong length is refused with both.
  assert.ok((await chairs.map(a, b, { landmarks: [[n - 1, n2 - 1]] })).quality.expectedError! > 0);
  await assert.rejects(chairs.map(a, b, { landmarks: [[n, 0]] }), new RegExp(`vertex ${n}, .* has ${n} vertices`));
  const short = new Int32Array(n - 1);
  await assert.rejects(
    chairs.transfer(short, a, b, { resolution: "input" }),
    new RegExp(`${n - 1} rows, .* has ${n} vertices`),
  );
  await assert.rejects(
    chairs.transfer(new Float32Array(n - 1), a, b, { resolution: "input" }),
    new RegExp(`${n - 1} values .* ${n} vertices`),
  );
  await assert.rejects(chairs.hks(a, { resolution: "output" as "input" }), /resolution is output/);
});

test("landmarks are vertices of either mesh", async () => {
  const [a, b] = names as [string, string];
  const chairs = lib.collection("coarse");
  const { p2p21 } = await chairs.map(a, b, { landmarks: [], resolution: "proxy" });
  const landmarks = [0, 100, 200].map((v) => [p2p21[v]!, v] as const);
  // Whatever the rows of the reply are of.
  const ofProxy = await chairs.map(a, b, { landmarks, landmarkResolution: "proxy" });
  const same = await chairs.map(a, b, { landmarks, resolution: "proxy" });
  assert.deepEqual([ofProxy.resolution, same.resolution], ["input", "proxy"]);
  assert.deepEqual(ofProxy.c12.data, same.c12.data);
  const ofFiles = await chairs.map(a, b, { landmarks, resolution: "proxy", landmarkResolution: "input" });
  assert.notDeepEqual(ofFiles.c12.data, same.c12.data);
  const { nVertices: n, nProxyVertices: nProxy } = (await chairs.shape(a)).report!;
  await assert.rejects(
    chairs.map(a, b, { landmarks: [[n - 1, 0]], landmarkResolution: "proxy" }),
    new RegExp(`vertex ${n - 1}.* has ${nProxy}`),
  );
  const options = { landmarks, resolution: "input", landmarkResolution: "proxy" } as const;
  const ones = await chairs.transfer(new Float32Array(n).fill(1), a, b, options);
  assert.ok(ones.every((v) => Number.isNaN(v) || Math.abs(v - 1) < 1e-5) && ones.some((v) => v > 0));
  await assert.rejects(
    chairs.map(a, b, { landmarks, landmarkResolution: "input_faces" as "input" }),
    /landmarkResolution is "input_faces", but must be "input" or "proxy"/,
  );
});

test("refusals are typed", async () => {
  await assert.rejects(chairs.labels("nobody"), (e) => {
    assert.ok(e instanceof coseg.NotFound && e instanceof coseg.Refused && e.name === "NotFound");
    assert.deepEqual([e.code, e.reason, e.retryAfter], ["NOT_FOUND", "NO_SHAPE", undefined]);
    return true;
  });
  await assert.rejects(chairs.add(names[0]!, meshes[1]!), coseg.AlreadyExists);
  await assert.rejects(lib.collection("chairs", { parts: 7 }).add("x", meshes[0]!), coseg.FailedPrecondition);
  await assert.rejects(lib.call("waitIdle", { waitMs: 10n ** 9n }), (e) => {
    return e instanceof coseg.InvalidArgument && e.place.field === "wait_ms";
  });
  await assert.rejects(chairs.add("x", { vertices: [0, 0, 0], faces: [0, 0, 5] }), /names vertex 5, the mesh has 1/);
});

test("corrections pin and are undone", async () => {
  const collection = lib.collection("corrections", { parts: 4 });
  await all(collection.addMany(meshes.slice(0, 2)));
  await collection.waitIdle();
  const before = await collection.labels(names[0]!);
  assert.ok(names.includes((await collection.suggest())!.shape));
  const mine = new Int32Array(before.length).fill(-1).fill(9, 0, 10);
  assert.equal((await collection.correct(names[0]!, mine)).nFaces, 10);
  await collection.correct(names[0]!, { faces: Uint32Array.of(20, 21), label: 8 });
  await collection.correct(names[0]!, { part: 0, label: 1 });
  assert.equal((await collection.nameLabel(9, "handle")).name, "handle");
  assert.equal((await collection.merge(8, 9)).id, 9);
  assert.equal((await collection.labels(names[0]!))[20], 9);
  const changes: string[] = [];
  for (let i = 0; i < 5; i++) changes.push((await collection.undo()).change);
  assert.deepEqual(changes, ["merge", "name", "correct", "correct", "correct"]);
  await collection.waitIdle();
  assert.deepEqual(await collection.labels(names[0]!), before);
});

test("failures stay alone, and a run is taken up by its key", async () => {
  const collection = lib.collection("stream", { parts: 4 });
  const bad = new TextEncoder().encode("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n");
  const items: coseg.Item[] = [meshes[0]!, ["bad", { format: "off", data: bad }], "/nowhere/x.off", meshes[1]!];
  let progress = 0;
  const seen = await all(collection.addMany(items, { onProgress: (job) => (progress = job.progress), key: "one" }));
  assert.deepEqual(seen.map((a) => [a.name, a.ok]), [[names[0], true], ["bad", false], ["x", false], [names[1], true]]);
  assert.ok(seen[1]!.error instanceof coseg.InvalidArgument && seen[1]!.error.reason === "VERTEX_INDEX");
  assert.equal(progress, 1);
  const other = new coseg.Library({ endpoint: daemon.endpoint });
  const again = await all(other.collection("stream", { parts: 4 }).addMany(items, { key: "one" }));
  assert.deepEqual(again.map((a) => a.outcome), seen.map((a) => a.outcome));
  const later = await all(other.collection("stream").addMany(meshes.slice(0, 2)));
  assert.deepEqual(later.map((a) => a.outcome), ["unchanged", "unchanged"]);
  other.close();
});

test("a kill while shapes stream in and events are followed loses nothing", async () => {
  const own = await Daemon.started();
  const library = new coseg.Library({ endpoint: own.endpoint });
  try {
    const collection = await library.create("killed", { parts: 4 });
    const following = (async () => {
      const events: coseg.Event[] = [];
      for await (const event of collection.events({ since: 0 })) {
        events.push(event);
        if (event.kind.case === "shapeAdded" && event.kind.value.shape === names[5]) break;
      }
      return events;
    })();
    const seen: coseg.Added[] = [];
    for await (const added of collection.addMany(meshes.slice(0, 6), { inFlight: 4 })) {
      seen.push(added);
      if (seen.length === 1 || seen.length === 4) await own.restart();
    }
    assert.deepEqual(seen.map((a) => a.outcome), Array(6).fill("added"));
    const events = await following;
    assert.deepEqual(events.map((e) => e.sequence), events.map((_, i) => i + 1));
    assert.deepEqual(events, (await collection.eventsSince(0)).slice(0, events.length));
  } finally {
    library.close();
    await own.close();
  }
});

test("jobs can be watched and cancelled", async () => {
  const collection = lib.collection("jobs", { parts: 4 });
  const [jobId] = await collection.submit(meshes.slice(0, 6));
  await lib.cancel(jobId!);
  const states = await all(lib.watch(jobId!));
  assert.ok(states.at(-1)!.finished);
  assert.equal((await lib.job(jobId!)).jobId, jobId);
});

test("no daemon is told in time", async () => {
  const nobody = new coseg.Library({ endpoint: "ipc:///tmp/no-coseg-here/s", timeout: 1.2 });
  const begin = performance.now();
  await assert.rejects(Promise.all([nobody.hello(), nobody.stats()]), coseg.NoAnswer);
  assert.ok(performance.now() - begin < 5_000);
  nobody.close();
});

test("encrypted sockets are used when keys are given", async () => {
  const server = curveKeyPair();
  const router = new Router({ curveServer: true, curveSecretKey: server.secretKey, linger: 0 });
  await router.bind("tcp://127.0.0.1:*");
  void (async () => {
    for await (const [peer, header] of router) {
      const { requestId } = fromBinary(RequestSchema, header!);
      const result = { case: "hello" as const, value: { version: "curve", instance: "1" } };
      await router.send([peer!, toBinary(ReplySchema, create(ReplySchema, { requestId, result }))]);
    }
  })();
  const own = curveKeyPair();
  const curve = { server: server.publicKey, public: own.publicKey, secret: own.secretKey };
  const endpoint = router.lastEndpoint!;
  const right = new coseg.Library({ endpoint, curve, timeout: 5 });
  assert.equal((await right.hello()).version, "curve");
  const plain = new coseg.Library({ endpoint, timeout: 1 });
  await assert.rejects(plain.hello(), coseg.NoAnswer);
  for (const library of [right, plain]) library.close();
  router.close();
});
