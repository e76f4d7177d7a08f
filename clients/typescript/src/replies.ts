/** Converts replies to results of the client, and settings to requests. */

import { create } from "@bufbuild/protobuf";
import { BadReply, CosegError, refused } from "./errors.js";
import { MapOrientation, Resolution as WireResolution, type GetFunctionalMapReply, type MapQuality as WireMapQuality } from "./gen/coseg/v1/analysis_pb.js";
import { CollectionSpecSchema, Operator, Up, type CollectionSpec, type LabelInfo } from "./gen/coseg/v1/collection_pb.js";
import { LinkKind, type Link as WireLink } from "./gen/coseg/v1/link_pb.js";
import { ItemState, Outcome, type Job as WireJob, type JobItem } from "./gen/coseg/v1/job_pb.js";
import type { Added, FunctionalMap, Job, Label, Link, MapQuality, Points, Resolution, Settings } from "./types.js";
import { plain, type Raw } from "./wire.js";

/** Maximum number of part kinds of a collection. */
const MAX_PARTS = 64;

export function up(name: Settings["up"]): Up {
  const key = name?.toUpperCase().replace("+", "PLUS_").replace("-", "MINUS_") as keyof typeof Up | undefined;
  return key === undefined ? Up.UNSPECIFIED : Up[key];
}

export function spec(settings: Settings): CollectionSpec {
  const { parts } = settings;
  if (parts !== undefined && !(Number.isInteger(parts) && parts >= 0 && parts <= MAX_PARTS)) {
    throw new CosegError(`parts is ${parts}, but must be 1 to ${MAX_PARTS}, or 0: estimated`);
  }
  const operator = settings.operator?.toUpperCase().replace("-", "_") as keyof typeof Operator | undefined;
  return create(CollectionSpecSchema, {
    ...(settings.parts !== undefined && { nParts: settings.parts }),
    workingFaces: settings.workingFaces ?? 0,
    up: up(settings.up),
    operator: operator === undefined ? Operator.UNSPECIFIED : Operator[operator],
  });
}

export function present(label: LabelInfo | undefined): Label {
  if (label === undefined) throw new BadReply("the label is missing");
  return plain(label);
}

/** What a link demands, and the part at each of its ends. */
export function link(wire: WireLink | undefined): Link {
  if (wire?.a === undefined || wire.b === undefined) throw new BadReply("the link, or a part of it, is missing");
  const kind = wire.kind === LinkKind.DIFFER ? "differ" : "same";
  return { ...plain(wire), kind, a: plain(wire.a), b: plain(wire.b) };
}

/** What rows are of, in words. */
const ROWS: Readonly<Record<Resolution, string>> = {
  input: "vertex of the mesh as sent",
  input_faces: "face of the mesh as sent",
  proxy: "vertex of the working mesh",
};

export function wireResolution(resolution: Resolution): WireResolution {
  const names = { input: WireResolution.INPUT, input_faces: WireResolution.INPUT_FACES, proxy: WireResolution.PROXY };
  const found = names[resolution] as WireResolution | undefined;
  if (found === undefined) {
    throw new CosegError(`resolution is ${resolution}, but must be one of: ${Object.keys(names).join(", ")}`);
  }
  return found;
}

/**
 * Refuses arrays with other rows than requested. Daemons that know no resolution send the rows that
 * `unset` names, which are accepted if they were requested.
 */
export function checkResolution(
  found: WireResolution,
  wanted: Resolution,
  unset: Resolution | "nothing" = "proxy",
): void {
  if (found === wireResolution(wanted)) return;
  if (found === WireResolution.UNSPECIFIED && wanted === unset) return;
  throw new BadReply(
    `a row for each ${ROWS[wanted]} was requested, but the daemon answers otherwise: it is too old for ` +
      'that; the resolution "proxy" is that of the working mesh',
  );
}

export function pointOptions(
  { landmarks = [], orientation, k = 0, alternative = false, landmarkResolution }: Points,
  resolution: Resolution,
) {
  const of = landmarkResolution ?? (resolution === "proxy" ? "proxy" : "input");
  // Not all callers have types.
  if (of !== "input" && of !== "proxy") {
    throw new CosegError(`landmarkResolution is ${JSON.stringify(of)}, but must be "input" or "proxy"`);
  }
  const wanted = { keep: MapOrientation.KEEP, reverse: MapOrientation.REVERSE };
  return {
    landmarks: landmarks.map(([from, to]) => ({ from, to })),
    orientation: orientation === undefined ? MapOrientation.UNSPECIFIED : wanted[orientation],
    k,
    alternative,
    landmarkResolution: landmarks.length === 0 ? WireResolution.UNSPECIFIED : wireResolution(of),
  };
}

export function mapQuality(quality: WireMapQuality | undefined): MapQuality {
  if (quality === undefined) throw new BadReply("the quality of a map is missing");
  return plain(quality);
}

export function functionalMap(
  from: string,
  to: string,
  resolution: Resolution,
  reply: GetFunctionalMapReply,
  raw: Raw,
): FunctionalMap {
  const one = (c12: typeof reply.c12, p2p21: typeof reply.p2p21, quality: typeof reply.quality, matched: typeof reply.matched) => ({
    from,
    to,
    c12: raw.array(Float32Array, c12),
    p2p21: raw.array(Uint32Array, p2p21).data,
    quality: mapQuality(quality),
    matched: raw.array(Uint32Array, matched).data,
    n1: reply.n1,
    resolution,
  });
  return {
    ...one(reply.c12, reply.p2p21, reply.quality, reply.matched),
    ...(reply.confidence && { confidence: raw.array(Float32Array, reply.confidence).data }),
    ...(reply.agreement && { agreement: plain(reply.agreement) }),
    ...(reply.alternativeC12 && {
      alternative: one(reply.alternativeC12, reply.alternativeP2p21, reply.alternativeQuality, reply.alternativeMatched),
    }),
    ...(reply.alternativeCost !== undefined && { alternativeCost: reply.alternativeCost }),
  };
}

export function job(message: WireJob | undefined): Job {
  if (message === undefined) throw new BadReply("the job is missing");
  return { ...plain(message), jobId: message.jobId };
}

const NOTHING_DONE = { nMaps: 0, nRelabelled: 0, nInconsistent: 0, stages: {} };

export function failed(name: string, error: Error | undefined, outcome: "failed" | "cancelled" = "failed"): Added {
  return { name, outcome, ok: false, ...(error && { error }), version: 0, sequence: 0, ...NOTHING_DONE };
}

/** The result of a completed shape of a job. */
export function added(item: JobItem | undefined): Added | undefined {
  switch (item?.state) {
    case ItemState.DONE: {
      const { placed } = item;
      if (placed === undefined) throw new BadReply(`${item.name} is done, but nothing was`);
      return {
        name: item.name,
        outcome: Outcome[placed.outcome].toLowerCase() as Added["outcome"],
        ok: true,
        version: Number(placed.version),
        sequence: Number(placed.sequence),
        nMaps: placed.nMaps,
        nRelabelled: placed.nRelabelled,
        nInconsistent: placed.nInconsistent,
        stages: Object.fromEntries(placed.stages.map((s) => [s.stage, s.ms])),
      };
    }
    case ItemState.FAILED:
      return failed(item.name, item.error && refused(item.error));
    case ItemState.CANCELLED:
      return failed(item.name, item.error && refused(item.error), "cancelled");
    default:
      return undefined;
  }
}
