/** Tests the keys that `coseg keys generate` writes, and failed jobs. */

import assert from "node:assert/strict";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { test } from "node:test";
import * as coseg from "../src/index.js";
import { chairs as makeChairs, Daemon, keys } from "./daemon.js";

const meshes = makeChairs(2);

test("a key of a file has its role", async () => {
  const folder = join(mkdtempSync(join(tmpdir(), "coseg")), "keys");
  keys(folder, "generate", "--server");
  for (const role of ["read-only", "ingest"]) keys(folder, "generate", role, "--role", role);
  const curve = (name: string) => coseg.curveFromFiles(join(folder, "server.pub"), join(folder, `${name}.key`));
  const daemon = await Daemon.started({ COSEG__SECURITY__KEYS: folder }, curve("ingest"));
  const lib = new coseg.Library({ endpoint: daemon.endpoint, curve: curve("ingest") });
  const chairs = lib.collection("chairs", { parts: 4 });
  assert.equal((await chairs.add("first", meshes[0]!)).outcome, "added");
  for await (const event of chairs.events({ since: 0 })) {
    assert.equal(event.sequence, 1);
    break;
  }
  await assert.rejects(chairs.delete(), coseg.PermissionDenied);
  // The environment names the files, as for the command line.
  process.env.COSEG_SERVER_KEY = join(folder, "server.pub");
  process.env.COSEG_CLIENT_KEY = join(folder, "read-only.key");
  const reader = new coseg.Library({ endpoint: daemon.endpoint });
  assert.ok((await reader.collection("chairs").labels("first")).length > 0);
  await assert.rejects(reader.collection("chairs").remove("first"), coseg.PermissionDenied);
  delete process.env.COSEG_CLIENT_KEY;
  assert.throws(() => new coseg.Library({ endpoint: daemon.endpoint }), /COSEG_CLIENT_KEY is not set/);
  delete process.env.COSEG_SERVER_KEY;
  const plain = new coseg.Library({ endpoint: daemon.endpoint, timeout: 1.5 });
  await assert.rejects(plain.hello(), coseg.NoAnswer);
  for (const one of [lib, reader, plain]) one.close();
  await daemon.close();
  rmSync(folder, { recursive: true });
});

test("failed jobs are listed and tried again", async () => {
  const settings: Record<string, string> = { COSEG_TEST_POISON: "1" };
  const daemon = await Daemon.started(settings);
  const lib = new coseg.Library({ endpoint: daemon.endpoint });
  const chairs = lib.collection("chairs", { parts: 4 });
  const data = Buffer.from(readFileSync(meshes[0]!, "utf8").replace("\n", "\n# poison: panic\n"));
  await assert.rejects(chairs.add("bad", { format: "off", data }));
  const jobs: coseg.Job[] = [];
  for await (const job of lib.jobs({ failed: true })) jobs.push(job);
  assert.equal(jobs.length, 1);
  assert.deepEqual(jobs[0]!.items.map((item) => item.name), ["bad"]);
  // The cause is removed: the same bytes, and workers that ignore the comment.
  delete settings.COSEG_TEST_POISON;
  await daemon.restart();
  await lib.retry(jobs[0]!.jobId);
  for await (const job of lib.watch(jobs[0]!.jobId)) assert.equal(job.jobId, jobs[0]!.jobId);
  assert.ok((await chairs.labels("bad")).length > 0);
  lib.close();
  await daemon.close();
});
