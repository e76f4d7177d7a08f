/** The client of a daemon's library of shapes. */

import { randomUUID } from "node:crypto";
import { setTimeout as sleep } from "node:timers/promises";
import { create, toBinary, type MessageInitShape } from "@bufbuild/protobuf";
import { Collection } from "./collection.js";
import { BadReply, CosegError, refused } from "./errors.js";
import { defaultFolder } from "./folder.js";
import type { HelloReply } from "./gen/coseg/v1/daemon_pb.js";
import type { Job as WireJob } from "./gen/coseg/v1/job_pb.js";
import { RequestSchema, type Reply, type Request } from "./gen/coseg/v1/message_pb.js";
import { job, spec } from "./replies.js";
import { beyond } from "./size.js";
import { curveFromEnv, Transport } from "./transport.js";
import type { CollectionInfo, FunctionalMap, Hello, Job, MapOptions, Options, RetriedJob, Settings, Stats } from "./types.js";
import { plain, Raw } from "./wire.js";

/**
 * Longest single wait in the daemon, and hence the longest delay until a cancellation takes effect.
 * @internal
 */
export const WAIT_MS = 1_000;
/** Delay between tries while a daemon drains and none has replaced it. */
const DRAINING_RETRY_MS = 500;
/**
 * Delay after which a request is repeated to a draining daemon, which answers at once. @internal
 */
export const PACE_MS = 20;

type Bodies = NonNullable<MessageInitShape<typeof RequestSchema>["body"]>;
type Body = Exclude<Request["body"]["case"], undefined>;
type Init<C extends Body> = Extract<Bodies, { case: C }>["value"];
type Result<C extends Body> = Extract<Reply["result"], { case: C }>["value"];

/** The default endpoint of this user's daemon. Throws if another user could listen there. */
export function defaultEndpoint(): string {
  return process.env.COSEG_ENDPOINT || `ipc://${defaultFolder()}/coseg.sock`;
}

/** A connection to a daemon and its library. A missing daemon is noticed at the first request. */
export class Library {
  readonly endpoint: string;
  readonly clientId: string;
  /** @internal */
  readonly transport: Transport;
  // Request ids of two programs with the same client id must differ.
  readonly #run = randomUUID().slice(0, 13);
  #n = 0;
  #hello: HelloReply | undefined;

  constructor(options: Options = {}) {
    this.endpoint = options.endpoint ?? defaultEndpoint();
    this.clientId = options.clientId ?? `typescript-${randomUUID()}`;
    this.transport = new Transport(this.endpoint, options.timeout ?? 30, options.curve ?? curveFromEnv());
  }

  /** Closes the connection. */
  close(): void {
    this.transport.close();
  }

  /**
   * Sends any request of the protocol: `await lib.call("getJob", { jobId: 7n })`. If the daemon is
   * at a limit, the request is repeated after the delay that it names; if it drains, until another
   * daemon has replaced it.
   */
  async call<C extends Body>(
    body: C,
    value: Init<C>,
    options: { frames?: readonly Uint8Array[]; clientId?: string; requestId?: string; deadlineMs?: number } = {},
  ): Promise<[Result<C>, Raw]> {
    if (this.#hello === undefined && body !== "hello") await this.hello();
    const request = create(RequestSchema, {
      requestId: options.requestId ?? `${this.#run}-${++this.#n}`,
      clientId: options.clientId ?? this.clientId,
      deadlineMs: BigInt(options.deadlineMs ?? 0),
      body: { case: body, value } as Bodies,
    });
    const frames = [toBinary(RequestSchema, request), ...(options.frames ?? [])];
    // A frame beyond the limit would end the connection silently.
    const nBytes = frames.reduce((n, frame) => n + frame.length, 0);
    const limit = this.#hello?.limits?.maxMessageBytes;
    if (limit !== undefined && BigInt(nBytes) > limit) {
      throw new CosegError(beyond("the message has", nBytes, Number(limit), "limits.max_message"));
    }
    for (;;) {
      const [{ result }, raw] = await this.transport.exchange(request.requestId, frames);
      if (result.case === body) return [result.value as Result<C>, new Raw(raw)];
      if (result.case !== "error") throw new BadReply(`the reply to ${body} has ${result.case ?? "no result"}`);
      const error = refused(result.value);
      if (error.retryAfter !== undefined) await sleep(error.retryAfter * 1000);
      else if (error.reason === "DRAINING") await sleep(DRAINING_RETRY_MS);
      else throw error;
    }
  }

  /** The daemon's description of itself. */
  async hello(): Promise<Hello> {
    [this.#hello] = await this.call("hello", {});
    return plain(this.#hello);
  }

  /** @internal */
  async limits(): Promise<NonNullable<HelloReply["limits"]>> {
    const { limits } = (await this.call("hello", {}))[0];
    if (limits === undefined) throw new BadReply("the daemon states no limits");
    return limits;
  }

  /** The daemon's counters. */
  async stats(): Promise<Stats> {
    return plain((await this.call("stats", {}))[0]);
  }

  /**
   * Stops the daemon when its current work is done; only over `ipc`. Returns the number of accepted
   * shapes that are not yet placed; those not begun are resumed at the next start.
   */
  async drain(): Promise<number> {
    return Number((await this.call("drain", {}))[0].nQueued);
  }

  /** All collections, by name. */
  async collections(): Promise<CollectionInfo[]> {
    return (await this.call("listCollections", {}))[0].collections.map(plain);
  }

  /** Creates a collection. */
  async create(name: string, settings: Settings = {}): Promise<Collection> {
    await this.call("createCollection", { spec: { ...spec(settings), name } });
    return this.collection(name, settings);
  }

  /**
   * The collection of that name. If it is missing, the first added shape creates it with these
   * settings; if it exists with other settings, that addition is refused.
   */
  collection(name: string, settings: Settings = {}): Collection {
    return new Collection(this, name, spec(settings));
  }

  /** The only collection of the library. */
  async onlyCollection(): Promise<Collection> {
    const names = (await this.collections()).map((c) => c.spec?.name ?? "");
    const [only] = names;
    if (only === undefined || names.length > 1) {
      throw new CosegError(`name a collection: there are ${names.length} (${names.join(", ")})`);
    }
    return this.collection(only);
  }

  /** The functional map that transfers functions on `from` to functions on `to`. */
  async map(from: string, to: string, collection?: string, options?: MapOptions): Promise<FunctionalMap> {
    const within = collection === undefined ? await this.onlyCollection() : this.collection(collection);
    return within.map(from, to, options);
  }

  /** The present state of a job. */
  async job(jobId: bigint): Promise<Job> {
    return job((await this.call("getJob", { jobId }))[0].job);
  }

  /**
   * Yields a job each time it has changed, until it is finished; also across restarts of the
   * daemon.
   */
  async *watch(jobId: bigint): AsyncGenerator<Job> {
    for await (const message of this.watchWire(jobId)) yield job(message);
  }

  /** @internal */
  async *watchWire(jobId: bigint): AsyncGenerator<WireJob> {
    let revision = 0n;
    for (;;) {
      const [{ job: message }] = await this.call("watchJob", { jobId, revision, waitMs: BigInt(WAIT_MS) });
      if (message === undefined) throw new BadReply("a watched job is missing");
      if (message.revision !== revision || message.finished) yield message;
      if (message.finished) return;
      if (message.revision === revision) await sleep(PACE_MS);
      revision = message.revision;
    }
  }

  /** Cancels the shapes of a job that are not yet placed. */
  async cancel(jobId: bigint): Promise<Job> {
    return job((await this.call("cancelJob", { jobId }))[0].job);
  }

  /**
   * Jobs, newest first; with `failed` only those with failed shapes, each with these shapes alone.
   */
  async *jobs(options: { failed?: boolean; collection?: string } = {}): AsyncGenerator<Job> {
    let before = 0n;
    for (;;) {
      const [reply] = await this.call("listJobs", { ...options, before });
      for (const message of reply.jobs) yield job(message);
      const last = reply.jobs.at(-1);
      if (!reply.more || last === undefined) return;
      before = last.jobId;
    }
  }

  /**
   * Queues the failed shapes of a job again, after the cause was removed. With keys it needs the
   * role `admin`.
   */
  async retry(jobId: bigint): Promise<RetriedJob> {
    const [reply] = await this.call("retryJob", { jobId });
    return { ...job(reply.job), nQueued: reply.nQueued };
  }
}
