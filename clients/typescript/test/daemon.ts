/** Runs the real daemon on a temporary library, and generates shapes for it. */

import { execFileSync, spawn, type ChildProcess } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { Library, type Curve } from "../src/index.js";

const binary = process.env.COSEG_BIN;
if (binary === undefined) throw new Error("COSEG_BIN names the daemon's binary");
const env: NodeJS.ProcessEnv = Object.fromEntries(
  Object.entries(process.env).filter(([name]) => !name.startsWith("COSEG_")),
);

/** A daemon in a folder of its own. */
export class Daemon {
  readonly folder = mkdtempSync(join(tmpdir(), "coseg"));
  readonly endpoint = `ipc://${this.folder}/s`;
  #process: ChildProcess | undefined;

  /** `settings` are variables of its environment, `curve` the keys for connecting to it. */
  constructor(
    readonly settings: Record<string, string> = {},
    readonly curve?: Curve,
  ) {}

  static async started(settings: Record<string, string> = {}, curve?: Curve): Promise<Daemon> {
    const daemon = new Daemon(settings, curve);
    await daemon.start();
    return daemon;
  }

  async start(): Promise<void> {
    const args = ["serve", "--library", `${this.folder}/library`, "--endpoint", this.endpoint];
    this.#process = spawn(binary!, args, { env: { ...env, ...this.settings }, stdio: "ignore" });
    const lib = new Library({ endpoint: this.endpoint, ...(this.curve && { curve: this.curve }) });
    await lib.hello();
    lib.close();
  }

  async kill(): Promise<void> {
    const gone = once(this.#process!, "exit");
    this.#process!.kill("SIGKILL");
    await gone;
  }

  async restart(): Promise<void> {
    await this.kill();
    await this.start();
  }

  async close(): Promise<void> {
    if (this.#process?.exitCode === null && this.#process.signalCode === null) await this.kill();
    rmSync(this.folder, { recursive: true });
  }
}

/**
 * Paths of generated chairs, in the order of their numbers, in a folder that is removed with the
 * process.
 */
export function chairs(count: number): string[] {
  const folder = mkdtempSync(join(tmpdir(), "coseg"));
  process.on("exit", () => rmSync(folder, { recursive: true }));
  const args = ["synth", "chair", "--count", String(count), "--faces", "1500", "--out", folder];
  execFileSync(binary!, args, { env, stdio: "ignore" });
  const names = readdirSync(folder).filter((name) => name.endsWith(".off"));
  return names.sort().map((name) => join(folder, name));
}

/** Runs `coseg keys` on a folder. */
export function keys(folder: string, ...args: string[]): void {
  execFileSync(binary!, ["keys", "--dir", folder, ...args], { env, stdio: "ignore" });
}

/** Coordinates and corners of an OFF file of triangles. */
export function readOff(path: string): { vertices: Float64Array; faces: Uint32Array } {
  const words = readFileSync(path, "utf8").split(/\s+/).slice(1).map(Number);
  const [n, m] = words as [number, number];
  const corners = words.slice(3 + 3 * n, 3 + 3 * n + 4 * m).filter((_, i) => i % 4 !== 0);
  return { vertices: Float64Array.from(words.slice(3, 3 + 3 * n)), faces: Uint32Array.from(corners) };
}
