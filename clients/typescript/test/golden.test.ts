/** Replays recorded conversations: this client sends the same bytes, and reads the same values. */

import assert from "node:assert/strict";
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { after, before, test } from "node:test";
import { create, fromBinary, fromJson, toBinary, toJson, type JsonValue } from "@bufbuild/protobuf";
import { Router } from "zeromq";
import * as coseg from "../src/index.js";
import { EventSchema } from "../src/gen/coseg/v1/event_pb.js";
import { ReplySchema, RequestSchema } from "../src/gen/coseg/v1/message_pb.js";

interface Entry {
  name: string;
  request?: JsonValue;
  reply: { error?: { code: string; reason?: string; message: string; retry_after_ms?: string } };
  reply_frames: { bytes: number; sha256: string }[];
}

const golden = process.env.COSEG_GOLDEN ?? new URL("../../../../tests/golden", import.meta.url).pathname;
const index = JSON.parse(readFileSync(`${golden}/index.json`, "utf8")) as Entry[];

function recorded(entry: Entry, what: "request" | "reply"): Buffer[] {
  let data = readFileSync(`${golden}/${entry.name}.${what}.bin`);
  const frames: Buffer[] = [];
  while (data.length > 0) {
    const end = 4 + data.readUInt32LE(0);
    frames.push(data.subarray(4, end));
    data = data.subarray(end);
  }
  return frames;
}

test("bytes mean what the index says", () => {
  assert.ok(index.length >= 40);
  for (const entry of index) {
    const [header] = recorded(entry, "request");
    if (entry.request !== undefined) {
      const encoded = toBinary(RequestSchema, fromJson(RequestSchema, entry.request));
      assert.deepEqual(Buffer.from(encoded), header, entry.name);
    }
    const [reply, ...frames] = recorded(entry, "reply");
    const decoded = fromBinary(ReplySchema, reply!);
    assert.deepEqual(toJson(ReplySchema, decoded, { useProtoFieldName: true }), entry.reply, entry.name);
    const digests = frames.map((f) => ({ bytes: f.length, sha256: createHash("sha256").update(f).digest("hex") }));
    assert.deepEqual(digests, entry.reply_frames, entry.name);
  }
});

test("every kind of event is understood", () => {
  const samples = JSON.parse(readFileSync(`${golden}/events.json`, "utf8")) as { kind: string; hex: string }[];
  for (const { kind, hex } of samples) {
    const event = fromBinary(EventSchema, Buffer.from(hex, "hex"));
    assert.equal(event.kind.case?.replace(/[A-Z]/g, (c) => `_${c.toLowerCase()}`), kind);
  }
});

const router = new Router({ linger: 0 });
let reply: Buffer[] = [];
let heard: Buffer[] = [];

before(async () => {
  await router.bind("tcp://127.0.0.1:*");
  void (async () => {
    for await (const [peer, ...frames] of router) {
      const { requestId } = fromBinary(RequestSchema, frames[0]!);
      if (requestId.startsWith("?") || requestId === "introduction") {
        const value = { instance: "golden", limits: { maxMessageBytes: 1n << 30n } };
        const hello = create(ReplySchema, { requestId, result: { case: "hello", value } });
        await router.send([peer!, toBinary(ReplySchema, hello)]);
      } else {
        heard = frames;
        await router.send([peer!, ...reply]);
      }
    }
  })();
});

after(() => router.close());

// The client repeats the request after these, which is tested with the real daemon.
const again = (entry: Entry) =>
  entry.reply.error?.retry_after_ms !== undefined || entry.reply.error?.reason === "ERROR_REASON_DRAINING";

for (const entry of index.filter((e) => e.request !== undefined && !again(e))) {
  test(`the client replays ${entry.name}`, async () => {
    const [header, ...frames] = recorded(entry, "request");
    const request = fromBinary(RequestSchema, header!);
    reply = recorded(entry, "reply");
    const lib = new coseg.Library({ endpoint: router.lastEndpoint!, clientId: request.clientId });
    await lib.call("hello", {}, { requestId: "introduction" });
    // Like any first call, but with a known id.
    lib.hello = async () => ({}) as coseg.Hello;
    const { requestId, deadlineMs } = request;
    const options = { requestId, deadlineMs: Number(deadlineMs), frames };
    const call = lib.call(request.body.case!, request.body.value as never, options);
    const { error } = entry.reply;
    if (error === undefined) {
      await call;
    } else {
      await assert.rejects(call, (e) => {
        assert.ok(e instanceof coseg.Refused);
        assert.equal(`ERROR_CODE_${e.code}`, error.code);
        assert.equal(`ERROR_REASON_${e.reason}`, error.reason ?? "ERROR_REASON_UNSPECIFIED");
        assert.equal(e.detail, error.message);
        assert.equal(e.name.toUpperCase(), e.code.replaceAll("_", ""));
        return true;
      });
    }
    lib.close();
    assert.deepEqual(heard, recorded(entry, "request"));
  });
}
