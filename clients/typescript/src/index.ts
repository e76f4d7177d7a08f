/**
 * Client of the coseg daemon: consistent labels, spectra and functional maps of 3D shapes.
 *
 * ```ts
 * const lib = new Library();
 * const chairs = lib.collection("chairs", { parts: 4, up: "+y" });
 * await chairs.add("101", "meshes/101.off");
 * const labels = await chairs.labels("101"); // Int32Array, one for each face of the file
 * ```
 */

export type { Item } from "./batch.js";
export * from "./errors.js";
export { Collection, reachable } from "./collection.js";
export { defaultEndpoint, Library } from "./library.js";
export { curveFromEnv, curveFromFiles, type Curve } from "./transport.js";
export type * from "./types.js";
export type { Arrays, Encoded, Matrix, Mesh, Plain } from "./wire.js";
