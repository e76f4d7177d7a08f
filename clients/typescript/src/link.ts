/**
 * Implements one connection without its socket: it decides what to send when, until every request
 * has its answer.
 *
 * A ZeroMQ socket hides that a daemon was away for a while, and that requests in flight were lost
 * with it. So while answers are pending, a Hello is sent once a second. Its reply shows that the
 * daemon is alive, and whether it is the one that got the requests: if not, they are sent again,
 * which the idempotency key makes harmless. The timeout limits silence, not work.
 */

import { create, fromBinary, toBinary } from "@bufbuild/protobuf";
import { BadReply, NoAnswer } from "./errors.js";
import { ReplySchema, RequestSchema, type Reply } from "./gen/coseg/v1/message_pb.js";

/** Milliseconds of silence after which the client sends a Hello. */
export const PING_MS = 1_000;
/**
 * Milliseconds after which a request is sent again although the daemon is alive, because it drops
 * replies to clients that do not read. Doubled each time.
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

  /** Whether any answer is pending. */
  get waiting(): boolean {
    return this.#pending.size > 0;
  }

  /** Records a request; the caller sends it. */
  begin(requestId: string, frames: Frames, now: number): void {
    if (this.#pending.size === 0) this.#heard = this.#pinged = now;
    this.#pending.set(requestId, { frames, resendAt: now + RESEND_MS, resendMs: RESEND_MS });
  }

  /** Records that a request could not be sent, so that it is due at the next tick. */
  unsent(requestId: string): void {
    const pending = this.#pending.get(requestId);
    if (pending) pending.resendAt = 0;
  }

  /** Forgets a request, answered or not. */
  end(requestId: string): void {
    this.#pending.delete(requestId);
  }

  /** The time at which to call {@link tick}, unless a message arrives earlier. */
  nextTick(): number {
    return Math.max(this.#pinged, this.#heard) + PING_MS;
  }

  /** The messages to send now, with their ids. Throws {@link NoAnswer} after too long a silence. */
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

  /** The reply to a request, or undefined for a request that is not pending. */
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
        // Requests sent earlier may be lost with the daemon that got them.
        for (const pending of this.#pending.values()) pending.resendAt = 0;
        this.#pinged = this.#heard = now - PING_MS;
      }
      this.#instance = instance;
    }
    return this.#pending.has(reply.requestId) ? reply : undefined;
  }
}
