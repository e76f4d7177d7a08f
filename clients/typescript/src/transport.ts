/** Connects {@link Link} with ZeroMQ sockets. */

import { readFileSync } from "node:fs";
import { Dealer, Subscriber } from "zeromq";
import { CosegError } from "./errors.js";
import type { Reply } from "./gen/coseg/v1/message_pb.js";
import { Link, type Frames } from "./link.js";

/**
 * Keys of an encrypted connection, each 40 characters of Z85: the daemon's public key, and this
 * client's pair.
 */
export interface Curve {
  readonly server: string;
  readonly public: string;
  readonly secret: string;
}

/**
 * Reads the keys that `coseg keys generate` wrote: the daemon's `server.pub` and this client's
 * `NAME.key`.
 */
export function curveFromFiles(server: string, client: string): Curve {
  return { server: key(server, "public"), public: key(client, "public"), secret: key(client, "secret") };
}

/**
 * Reads the keys in the files named by `$COSEG_SERVER_KEY` and `$COSEG_CLIENT_KEY`; undefined if
 * neither is set.
 */
export function curveFromEnv(): Curve | undefined {
  const { COSEG_SERVER_KEY: server, COSEG_CLIENT_KEY: client } = process.env;
  if (!server && !client) return undefined;
  if (!server || !client) {
    const missing = server ? "COSEG_CLIENT_KEY" : "COSEG_SERVER_KEY";
    throw new CosegError(`an encrypted connection needs both keys: ${missing} is not set`);
  }
  return curveFromFiles(server, client);
}

function key(path: string, kind: string): string {
  for (const line of readFileSync(path, "latin1").split("\n")) {
    const [found, value, ...more] = line.trim().split(/\s+/);
    if (found === kind && value?.length === 40 && more.length === 0) return value;
  }
  throw new CosegError(`${path} has no ${kind} key of 40 characters; \`coseg keys generate\` makes such files`);
}

/** A reply and its raw frames. */
export type Answer = readonly [Reply, Uint8Array[]];

interface Waiting {
  resolve(answer: Answer): void;
  reject(error: unknown): void;
}

const curveOptions = (curve: Curve | undefined) =>
  curve === undefined
    ? {}
    : { curveServerKey: curve.server, curvePublicKey: curve.public, curveSecretKey: curve.secret };

/** Sends requests and awaits their replies, any number at once. */
export class Transport {
  readonly #link: Link;
  readonly #socket: Dealer;
  readonly #waiting = new Map<string, Waiting>();
  #sending: Promise<void> = Promise.resolve();
  #timer: NodeJS.Timeout | undefined;
  #reading = false;

  constructor(
    readonly endpoint: string,
    readonly timeout: number,
    readonly curve: Curve | undefined,
  ) {
    this.#link = new Link(endpoint, timeout);
    this.#socket = new Dealer({ linger: 0, sendTimeout: 0, ...curveOptions(curve) });
    this.#socket.connect(endpoint);
  }

  /** Closes the socket; pending requests are rejected. */
  close(): void {
    this.#failAll(new CosegError("the connection was closed"));
    clearTimeout(this.#timer);
    this.#socket.close();
  }

  /** Sends a request, repeatedly if necessary, and resolves to the reply and its raw frames. */
  async exchange(requestId: string, frames: Frames): Promise<Answer> {
    if (!this.#reading) void this.#read();
    this.#link.begin(requestId, frames, performance.now());
    const answer = new Promise<Answer>((resolve, reject) => this.#waiting.set(requestId, { resolve, reject }));
    this.#send(requestId, frames);
    this.#arm();
    try {
      return await answer;
    } finally {
      this.#waiting.delete(requestId);
      this.#link.end(requestId);
      if (!this.#link.waiting) clearTimeout(this.#timer);
    }
  }

  #arm(): void {
    clearTimeout(this.#timer);
    const left = Math.max(1, this.#link.nextTick() - performance.now());
    this.#timer = setTimeout(() => {
      try {
        for (const [requestId, frames] of this.#link.tick(performance.now())) this.#send(requestId, frames);
      } catch (e) {
        this.#failAll(e);
      }
      if (this.#waiting.size > 0) this.#arm();
    }, left);
  }

  #failAll(error: unknown): void {
    for (const waiting of this.#waiting.values()) waiting.reject(error);
    this.#waiting.clear();
  }

  /** A socket takes one message at a time. */
  #send(requestId: string, frames: Frames): void {
    this.#sending = this.#sending.then(async () => {
      try {
        await this.#socket.send(frames as Uint8Array[]);
      } catch (e) {
        if (this.#socket.closed) return;
        if ((e as NodeJS.ErrnoException).code === "EAGAIN") this.#link.unsent(requestId);
        else this.#waiting.get(requestId)?.reject(e);
      }
    });
  }

  async #read(): Promise<void> {
    this.#reading = true;
    try {
      for await (const [header, ...raw] of this.#socket) {
        const reply = this.#link.receive(header!, performance.now());
        if (reply) this.#waiting.get(reply.requestId)?.resolve([reply, raw]);
      }
    } catch (e) {
      this.#failAll(e);
    } finally {
      this.#reading = false;
    }
  }

  /** A socket that receives messages under the topics. */
  subscribe(endpoint: string, topics: readonly string[], silenceMs: number): Subscription {
    const socket = new Subscriber({ linger: 0, receiveTimeout: silenceMs, ...curveOptions(this.curve) });
    socket.subscribe(...topics);
    socket.connect(endpoint);
    return new Subscription(socket);
  }
}

/** A socket that receives events. */
export class Subscription {
  readonly #socket: Subscriber;

  constructor(socket: Subscriber) {
    this.#socket = socket;
  }

  /** The body of the next message, or undefined after silence. */
  async receive(): Promise<Uint8Array | undefined> {
    try {
      return (await this.#socket.receive()).at(-1);
    } catch (e) {
      if ((e as NodeJS.ErrnoException).code === "EAGAIN") return undefined;
      throw e;
    }
  }

  /** Closes the socket. */
  close(): void {
    this.#socket.close();
  }
}
