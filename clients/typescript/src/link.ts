/**
 * One connection without its socket: what to send when, until every request has its answer.
 *
 * A ZeroMQ socket hides that a daemon was gone for a while, and with it what was under way. So while
 * answers are awaited, a Hello is sent once a second. Its reply shows that the daemon lives, and whether
 * it is still the one that got the requests: if not, they are sent again, which the idempotency key
 * makes harmless. The timeout is for silence, not for work.
 */

import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { BadReply, NoAnswer } from "./errors.js";
import { ReplySchema, RequestSchema, type Reply } from "./gen/coseg/v1/message_pb.js";

/** Milliseconds of silence after which the daemon is asked whether it lives. */
export const PING_MS = 1_000;
/**
 * Milliseconds after which a request is sent again although the daemon lives: it drops replies to clients
 * that do not read. Doubled each time.
 */
export const RESEND_MS = 20_000;

/** Frames of a message to send. */
export type Frames = readonly Uint8Array[];

interface Pending {
  readonly frames: Frames;
  resendAt: number;
  resendMs: number;
}

/** The state of one connection. All times are milliseconds of one monotonic clock. */
export class Link {
  readonly #pending = new Map<string, Pending>();
  #instance = "";
  #heard = 0;
  #pinged = 0;
  #nPings = 0;

  /** `timeout` is in seconds. */
  constructor(
    readonly endpoint: string,
    readonly timeout: number,
  ) {}

  /** Whether any answer is awaited. */
  get waiting(): boolean {
    return this.#pending.size > 0;
  }

  /** Notes a request; the caller sends it. */
  begin(requestId: string, frames: Frames, now: number): void {
    if (this.#pending.size === 0) this.#heard = this.#pinged = now;
    this.#pending.set(requestId, { frames, resendAt: now + RESEND_MS, resendMs: RESEND_MS });
  }

  /** Notes that a request could not be sent: it is due at the next tick. */
  unsent(requestId: string): void {
    const pending = this.#pending.get(requestId);
    if (pending) pending.resendAt = 0;
  }

  /** Forgets a request, answered or not. */
  end(requestId: string): void {
    this.#pending.delete(requestId);
  }

  /** When {@link tick} is to be called, unless something arrives before. */
  nextTick(): number {
    return Math.max(this.#pinged, this.#heard) + PING_MS;
  }

  /** What is to be sent now, with its id. Throws {@link NoAnswer} after too long a silence. */
  tick(now: number): [string, Frames][] {
    if (this.#pending.size === 0 || now < this.nextTick()) return [];
    if (now - this.#heard > this.timeout * 1000) throw new NoAnswer(this.endpoint, this.timeout);
    this.#pinged = now;
    const ping = create(RequestSchema, { requestId: `?${++this.#nPings}`, body: { case: "hello", value: {} } });
    const due: [string, Frames][] = [[ping.requestId, [toBinary(RequestSchema, ping)]]];
    for (const [requestId, pending] of this.#pending) {
      if (now < pending.resendAt) continue;
      if (pending.resendAt > 0) pending.resendMs *= 2;
      pending.resendAt = now + pending.resendMs;
      due.push([requestId, pending.frames]);
    }
    return due;
  }

  /** The reply to a request, or undefined for one that nobody waits for. */
  receive(header: Uint8Array, now: number): Reply | undefined {
    this.#heard = now;
    let reply: Reply;
    try {
      reply = fromBinary(ReplySchema, header);
    } catch (e) {
      throw new BadReply(`the header frame is not a coseg.v1.Reply: ${String(e)}`);
    }
    if (reply.result.case === "hello") {
      const { instance } = reply.result.value;
      if (this.#instance !== "" && instance !== this.#instance) {
        // What was sent before may be lost with the daemon that got it.
        for (const pending of this.#pending.values()) pending.resendAt = 0;
        this.#pinged = this.#heard = now - PING_MS;
      }
      this.#instance = instance;
    }
    return this.#pending.has(reply.requestId) ? reply : undefined;
  }
}
