/** The errors: every failure is a {@link CosegError}, a refusal by the daemon a {@link Refused}. */

import { ErrorCode, ErrorReason, type Error as WireError } from "./gen/coseg/v1/error_pb.js";

/** Base of all errors that this package throws. */
export class CosegError extends Error {
  override get name(): string {
    return this.constructor.name;
  }
}

/** No daemon at the endpoint has answered within the timeout. */
export class NoAnswer extends CosegError {
  constructor(
    readonly endpoint: string,
    readonly timeout: number,
  ) {
    super(`no answer from ${endpoint} within ${timeout} s; is a daemon running there?`);
  }
}

/** The daemon's reply cannot be understood. */
export class BadReply extends CosegError {}

/** The mesh is invalid; nothing was sent. */
export class BadMesh extends CosegError {}

/**
 * A collection's log ends before events that were already received: another library is served now.
 */
export class EventLogRewound extends CosegError {}

/** The subject of a refusal. */
export interface Place {
  /** Path of the field of the request, such as `shapes[3].name`. */
  readonly field?: string;
  /** Face (polygon) of the mesh, from 0. */
  readonly face?: number;
  /** Vertex of the mesh, from 0. */
  readonly vertex?: number;
  /** Offset in bytes into the file. */
  readonly byteOffset?: number;
  /** Line of the text file, from 1. */
  readonly line?: number;
  /** The job that continues although the request's deadline has passed. */
  readonly jobId?: bigint;
}

/** The daemon refused a request, or one shape of a job. */
export class Refused extends CosegError {
  /** Name of the code, such as `NOT_FOUND`. */
  readonly code: string;
  /** Name of the reason within the code, such as `NO_SHAPE`; values are only ever added. */
  readonly reason: string;
  /** For people: the value and the limit. */
  readonly detail: string;
  /** The subject, if it is a single one. */
  readonly place: Place;
  /** Seconds after which the same request may succeed; undefined: repeating it is useless. */
  readonly retryAfter: number | undefined;

  constructor(error: WireError) {
    const code = ErrorCode[error.code] ?? String(error.code);
    const reason = ErrorReason[error.reason] ?? String(error.reason);
    super(`${error.message} (${code}/${reason})`);
    this.code = code;
    this.reason = reason;
    this.detail = error.message;
    this.retryAfter = error.retryAfterMs > 0n ? Number(error.retryAfterMs) / 1000 : undefined;
    const { case: kind, value } = error.subject;
    this.place =
      kind === undefined ? {} : { [kind]: typeof value === "bigint" && kind !== "jobId" ? Number(value) : value };
  }
}

/** The request or the mesh is invalid, regardless of the state of the library. */
export class InvalidArgument extends Refused {}
/** An object that the request names does not exist. */
export class NotFound extends Refused {}
/** An object that the request would create exists and differs. */
export class AlreadyExists extends Refused {}
/** The request is valid, but not in this state of the library or the daemon. */
export class FailedPrecondition extends Refused {}
/** The daemon is at a limit; see `retryAfter`. */
export class ResourceExhausted extends Refused {}
/** The request's deadline passed; a change that has begun is still finished. */
export class DeadlineExceeded extends Refused {}
/** A client cancelled the work. */
export class Cancelled extends Refused {}
/** The configuration, the transport or the client's role does not allow it. */
export class PermissionDenied extends Refused {}
/** Stored data are damaged: `coseg check` names them. */
export class DataLoss extends Refused {}
/** A fault of the daemon. */
export class Internal extends Refused {}

const CLASSES = new Map<ErrorCode, new (error: WireError) => Refused>([
  [ErrorCode.INVALID_ARGUMENT, InvalidArgument],
  [ErrorCode.NOT_FOUND, NotFound],
  [ErrorCode.ALREADY_EXISTS, AlreadyExists],
  [ErrorCode.FAILED_PRECONDITION, FailedPrecondition],
  [ErrorCode.RESOURCE_EXHAUSTED, ResourceExhausted],
  [ErrorCode.DEADLINE_EXCEEDED, DeadlineExceeded],
  [ErrorCode.CANCELLED, Cancelled],
  [ErrorCode.PERMISSION_DENIED, PermissionDenied],
  [ErrorCode.DATA_LOSS, DataLoss],
  [ErrorCode.INTERNAL, Internal],
]);

/** The exception for an error of the protocol. */
export function refused(error: WireError): Refused {
  return new (CLASSES.get(error.code) ?? Refused)(error);
}
