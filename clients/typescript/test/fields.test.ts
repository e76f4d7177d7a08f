/**
 * Tests that every field of every reply affects a result of the client: changing the field changes
 * the result.
 */

import assert from "node:assert/strict";
import { after, test } from "node:test";
import { clone, create, ScalarType, type DescField, type DescMessage, type Message } from "@bufbuild/protobuf";
import * as coseg from "../src/index.js";
import { DataType } from "../src/gen/coseg/v1/array_pb.js";
import { ReplySchema } from "../src/gen/coseg/v1/message_pb.js";
import { Raw } from "../src/wire.js";

/** Number of entries of a repeated field: one for each state of an item with different contents. */
const N = 3;
/** Fields that must have a certain value for the others to matter, by message, field and entry. */
const GIVEN = new Map([
  ["JobItem.state", [3, 4, 2]],
  ["Placed.outcome", [1, 2, 3]],
]);
/** Fields without effect, and why. */
const ELSEWHERE: Record<string, string> = {
  "createCollection.collection": "`create` returns the collection, whose `info` asks for it",
  "addShapes.nShapes": "the caller knows how many it gave",
  "addShapes.job": "only told where the request waits, as the client's never does; it watches the job",
  "listJobs.more": "the client reads page after page",
  "listShapes.nextPageToken": "the client reads page after page",
  "eventsSince.more": "the client reads page after page",
};
/** Element types that the protocol specifies in comments. */
const TYPES: Record<string, DataType> = {
  labels: DataType.INT32,
  values: DataType.INT32,
  eigenvalues: DataType.FLOAT64,
  ...Object.fromEntries(
    ["faces", "patches", "faceMap", "p2p21", "alternativeP2p21", "matched", "alternativeMatched"].map((f) => [f, DataType.UINT32]),
  ),
};

/** The first resolution that a reply may have; others are refused. */
const PROXY = { resolution: "proxy" } as const;

const CALLS: Record<string, (lib: coseg.Library, c: coseg.Collection) => unknown> = {
  hello: (lib) => coseg.Library.prototype.hello.call(lib),
  stats: (lib) => lib.stats(),
  drain: (lib) => lib.drain(),
  createCollection: async (lib) => (await lib.create("a")).name,
  listCollections: (lib) => lib.collections(),
  describeCollection: (_, c) => c.info(),
  updateCollection: (_, c) => c.set({ up: "+z" }),
  deleteCollection: (_, c) => c.delete(),
  nameLabel: (_, c) => c.nameLabel(1, "leg"),
  addShapes: (_, c) => c.submit([["a", { format: "off", data: new Uint8Array(3) }]]),
  getJob: (lib) => lib.job(1n),
  watchJob: (lib) => first(lib.watch(1n), 1),
  cancelJob: (lib) => lib.cancel(1n),
  waitIdle: (_, c) => c.waitIdle(0),
  listJobs: (lib) => first(lib.jobs()),
  retryJob: (lib) => lib.retry(1n),
  listShapes: (_, c) => first(c.shapes()),
  getShape: (_, c) => c.shape("a"),
  getLabels: (_, c) => c.labelling("a", { confidence: true }),
  getOriginal: (_, c) => c.original("a"),
  removeShape: (_, c) => c.remove("a"),
  labelsSnapshot: (_, c) => c.snapshot(),
  getSpectrum: (_, c) => orRefusal(c.spectrum("a", { eigenvectors: true, ...PROXY })),
  getHks: (_, c) => orRefusal(c.hks("a", PROXY)),
  getDescriptors: (_, c) => c.descriptors("a"),
  getFunctionalMap: (_, c) => orRefusal(c.map("a", "b", { alternative: true, ...PROXY })),
  getPartCorrespondence: (_, c) => c.matchParts("a", "b"),
  nearest: (_, c) => c.nearest("a"),
  getPortraits: (_, c) => c.portraits(["a"]),
  transferFunction: (_, c) => orRefusal(c.transferred(new Int32Array(2), "a", "b", PROXY)),
  eventsSince: (_, c) => c.eventsSince(0),
  correctLabels: (_, c) => c.correct("a", { part: 0, label: 1 }),
  mergeLabels: (_, c) => c.merge(1, 2),
  splitLabel: (_, c) => c.split(1),
  undo: (_, c) => c.undo(),
  suggestNext: (_, c) => c.suggest(),
  nextQuestion: (_, c) => c.ask(),
  answerQuestion: (_, c) => c.answer("a", 0, { label: 1 }),
  reviewShape: (_, c) => c.approve("a"),
  listProposals: (_, c) => c.proposals(),
  getProposal: (_, c) => c.proposedLabels(1),
  chooseProposal: (_, c) => c.choose(1),
  linkParts: (_, c) => c.same({ shape: "a", part: 0 }, { shape: "b", part: 1 }),
  unlinkParts: (_, c) => c.unlink(1),
  listLinks: (_, c) => c.links("a"),
  publish: (_, c) => c.bundleHead(),
  getArrayFile: (_, c) => c.arrayFile("a", "0".repeat(64)),
};

/** The result, or what is wrong with a reply that has other rows than requested. */
async function orRefusal(result: Promise<unknown>): Promise<unknown> {
  return result.catch((error: unknown) => {
    if (error instanceof coseg.BadReply) return error;
    throw error;
  });
}

async function first<T>(values: AsyncIterable<T>, n = N): Promise<T[]> {
  const found: T[] = [];
  for await (const value of values) if (found.push(value) === n) break;
  return found;
}

type Fields = Record<string, unknown>;
const frames: Uint8Array[] = [];

function frame(seed: number, bytes: number): number {
  // Four numbers of any type, all of them different.
  const data = new Uint8Array(4 * bytes);
  for (let i = 0; i < 4; i++) data[i * bytes] = i + 16 * seed;
  return frames.push(data) - 1;
}

function scalar(field: DescField, entry: number, seed: number): unknown {
  if (field.enum !== undefined) {
    const given = GIVEN.get(`${field.parent.name}.${field.name}`);
    // Not 0, which means unspecified.
    const values = field.enum.values;
    return values[given && seed === 0 ? given[entry]! : 1 + ((entry + seed) % (values.length - 1))]!.number;
  }
  const number = 3 + 7 * entry + 100 * seed + field.number;
  switch (field.scalar) {
    case ScalarType.BOOL:
      // The last page is the last.
      return ELSEWHERE[`eventsSince.${field.name}`] ? false : seed === 0;
    case ScalarType.STRING:
      return field.localName === "nextPageToken" ? "" : `${field.name} ${entry} ${seed}`;
    case ScalarType.UINT64:
    case ScalarType.INT64:
      return BigInt(number);
    default:
      return number;
  }
}

/** A message with a value in every field, and in the first field of every oneof. */
function filled(of: DescMessage, entry: number, seed: number, name: string): Message {
  const message = create(of);
  if (of.name === "ArrayRef") {
    const dtype = TYPES[name] ?? DataType.FLOAT32;
    const at = frame(seed + entry, dtype === DataType.FLOAT64 ? 8 : 4);
    return Object.assign(message, { dtype, shape: [2n, 2n], frame: at });
  }
  if (of.name === "BytesRef") return Object.assign(message, { frame: frame(seed + entry, 4) });
  for (const field of of.fields) if (field.oneof?.fields[0] === field || !field.oneof) put(message, field, entry, 0);
  return message;
}

function put(message: Message, field: DescField, entry: number, seed: number): void {
  const one = (i: number) => (field.message ? filled(field.message, i, seed, field.localName) : scalar(field, i, seed));
  const value = field.fieldKind === "list" ? Array.from({ length: N }, (_, i) => one(i)) : one(entry);
  if (field.oneof) (message as unknown as Fields)[field.oneof.localName] = { case: field.localName, value };
  else (message as unknown as Fields)[field.localName] = value;
}

type Path = { field: DescField; entry: number }[];

/** The reply with a value in the field at a path, and the same with another value. */
function pair(of: DescMessage, reply: Message, path: Path): Message[] {
  return [0, 1].map((seed) => {
    const changed = clone(of, reply);
    let message: Message = changed;
    for (const { field, entry } of path.slice(0, -1)) {
      const there = message as unknown as Fields;
      if (field.oneof) {
        const held = there[field.oneof.localName] as { case?: string; value?: Message };
        if (held.case !== field.localName) put(message, field, entry, 0);
        message = (there[field.oneof.localName] as { value: Message }).value;
      } else {
        message = (field.fieldKind === "list" ? (there[field.localName] as Message[])[entry] : there[field.localName]) as Message;
      }
    }
    const { field, entry } = path.at(-1)!;
    put(message, field, entry, seed);
    return changed;
  });
}

/** The paths to all fields that are neither messages nor references to raw frames. */
function* leaves(of: DescMessage, path: Path = [], entry = 0): Generator<Path> {
  for (const field of of.fields) {
    const kind = field.message;
    if (kind === undefined || ["ArrayRef", "BytesRef"].includes(kind.name)) yield [...path, { field, entry }];
    else if (field.fieldKind === "list") {
      for (let i = 0; i < N; i++) yield* leaves(kind, [...path, { field, entry: i }], i);
    } else yield* leaves(kind, [...path, { field, entry }], entry);
  }
}

/** The contents of a value of the client, as text. */
function told(value: unknown): string {
  const flat = (_: string, v: unknown): unknown => {
    if (typeof v === "bigint") return `${v}n`;
    if (v instanceof Map) return [...v];
    if (v instanceof Error) return { ...v, name: v.name, text: v.message };
    return v;
  };
  return JSON.stringify(value, flat) ?? "nothing";
}

const lib = new coseg.Library({ endpoint: "ipc:///nobody" });
after(() => lib.close());
const results = ReplySchema.oneofs.find((o) => o.name === "result")!.fields.filter((f) => f.localName !== "error");

test("every reply has a call", () => {
  assert.deepEqual(Object.keys(CALLS).sort(), results.map((f) => f.localName).sort());
});

for (const { localName: body, message } of results) {
  test(`every field of ${body} is told`, async () => {
    const of = message!;
    const reply = filled(of, 0, 0, body);
    let answer = reply;
    const stub = async (asked: string) => {
      if (asked === body) return [answer, new Raw(frames)];
      const other = results.find((f) => f.localName === asked)!.message!;
      return [filled(other, 0, 0, asked), new Raw(frames)];
    };
    lib.call = stub as unknown as typeof lib.call;
    const places = new Map<string, boolean>();
    for (const path of leaves(of)) {
      const name = [body, ...path.map((p) => p.field.localName)].join(".");
      if (places.get(name)) continue;
      const answers: string[] = [];
      for (answer of pair(of, reply, path)) answers.push(told(await CALLS[body]!(lib, lib.collection("a"))));
      places.set(name, answers[0] !== answers[1]);
    }
    const lost = [...places].filter(([, isTold]) => !isTold).map(([name]) => name);
    const known = Object.keys(ELSEWHERE);
    assert.deepEqual(
      lost,
      [...places.keys()].filter((name) => known.some((k) => name === k || name.startsWith(`${k}.`))),
    );
  });
}
