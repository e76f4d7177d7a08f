import assert from "node:assert/strict";
import { test } from "node:test";
import { create, toBinary } from "@bufbuild/protobuf";
import { BadReply, NoAnswer } from "../src/errors.js";
import { ReplySchema } from "../src/gen/coseg/v1/message_pb.js";
import { reachable } from "../src/collection.js";
import { Link, RESEND_MS } from "../src/link.js";

const hello = (instance: string, requestId = "?1") =>
  toBinary(ReplySchema, create(ReplySchema, { requestId, result: { case: "hello", value: { instance } } }));
const ids = (sent: [string, unknown][]) => sent.map(([id]) => id);
const frames = [new Uint8Array([1])];

test("silence is asked about and ends in no answer", () => {
  const link = new Link("e", 3);
  link.begin("a", frames, 100_000);
  assert.deepEqual(link.tick(100_500), []);
  assert.deepEqual(ids(link.tick(101_000)), ["?1"]);
  assert.deepEqual(ids(link.tick(102_100)), ["?2"]);
  assert.throws(() => link.tick(103_200), NoAnswer);
});

test("work may take long while the daemon lives", () => {
  const link = new Link("e", 3);
  link.begin("a", frames, 0);
  const resent: number[] = [];
  for (let now = 0; now < 100_000; ) {
    now = link.nextTick();
    if (ids(link.tick(now)).includes("a")) resent.push(Math.round(now / RESEND_MS));
    assert.equal(link.receive(hello("one"), now + 10), undefined);
  }
  assert.deepEqual(resent, [1, 3]);
});

test("another daemon gets what the first may have lost", () => {
  const link = new Link("e", 30);
  link.begin("h", frames, 0);
  assert.ok(link.receive(hello("one", "h"), 0));
  link.end("h");
  link.begin("a", frames, 1_000);
  assert.deepEqual(ids(link.tick(2_000)), ["?1"]);
  link.receive(hello("one"), 2_000);
  assert.deepEqual(ids(link.tick(3_000)), ["?2"]);
  link.receive(hello("two"), 3_100);
  assert.deepEqual(ids(link.tick(3_100)), ["?3", "a"]);
  link.receive(hello("two"), 3_200);
  assert.deepEqual(ids(link.tick(4_200)), ["?4"]);
});

test("nonsense is told, and replies nobody waits for are dropped", () => {
  const link = new Link("e", 3);
  assert.equal(link.receive(hello("one", "old"), 0), undefined);
  assert.throws(() => link.receive(new Uint8Array([255, 255]), 0), BadReply);
});

test("events come from the host that is known", () => {
  assert.equal(reachable("tcp://0.0.0.0:7001", "tcp://shapes:7000"), "tcp://shapes:7001");
  assert.equal(reachable("tcp://10.0.0.1:7001", "tcp://shapes:7000"), "tcp://10.0.0.1:7001");
  assert.equal(reachable("ipc:///run/x.events", "ipc:///run/x"), "ipc:///run/x.events");
});
