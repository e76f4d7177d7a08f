import { readFile } from "node:fs/promises";
import { Dealer } from "zeromq";
import { create, fromBinary, toBinary, type MessageInitShape } from "@bufbuild/protobuf";
import { RequestSchema, ReplySchema } from "./gen/coseg/v1/message_pb.js";
import { AddMode, MeshFormat } from "./gen/coseg/v1/job_pb.js";

const socket = new Dealer({ linger: 0, receiveTimeout: 60_000 });
socket.connect(process.argv[2]!);

async function call(requestId: string, body: MessageInitShape<typeof RequestSchema>["body"], ...frames: Uint8Array[]) {
  const request = create(RequestSchema, { requestId, clientId: "raw-typescript", body });
  await socket.send([toBinary(RequestSchema, request), ...frames]);
  const [header, ...raw] = await socket.receive();
  const { result } = fromBinary(ReplySchema, header!);
  if (result.case === "error") throw new Error(result.value.message);
  return { result, raw };
}

const mesh = await readFile(process.argv[3]!);
const source = { case: "encoded", value: { format: MeshFormat.OFF, bytes: { frame: 0 } } } as const;
const shapes = [{ name: "typescript", source }];
await call("add", { case: "addShapes", value: { collection: "raw", shapes, create: {}, mode: AddMode.WAIT } }, mesh);
const { result, raw } = await call("labels", { case: "getLabels", value: { collection: "raw", shape: "typescript" } });
if (result.case === "getLabels") {
  const frame = raw[result.value.labels!.frame]!;
  console.log(Array.from({ length: frame.length / 4 }, (_, i) => frame.readInt32LE(4 * i)).join(" "));
}
