/** Runs the TypeScript blocks of the documents, each document as one program. */

import { execFileSync } from "node:child_process";
import { copyFileSync, mkdirSync, mkdtempSync, readFileSync, rmSync, symlinkSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { basename, join } from "node:path";
import { chairs, Daemon } from "./daemon.js";

const root = process.env.COSEG_ROOT;
if (root === undefined) throw new Error("COSEG_ROOT names the repository");
const here = new URL("../..", import.meta.url).pathname;
const meshes = chairs(3);

for (const document of ["README.md", "clients/typescript/README.md", "docs/clients.md"]) {
  const text = readFileSync(join(root, document), "utf8");
  const code = [...text.matchAll(/```ts\n(.*?)```/gs)].map((block) => block[1]).join("\n");
  if (!code.includes("coseg")) throw new Error(`${document} shows no TypeScript`);
  const folder = mkdtempSync(join(tmpdir(), "coseg"));
  const daemon = await Daemon.started();
  try {
    mkdirSync(join(folder, "meshes"));
    // The README's reader has the output of `coseg synth`; the other documents name shapes 101 and
    // so on.
    const name = (path: string, i: number) => (document === "README.md" ? basename(path) : `${101 + i}.off`);
    meshes.forEach((path, i) => copyFileSync(path, join(folder, "meshes", name(path, i))));
    // `coseg` is this package, and types are checked too.
    mkdirSync(join(folder, "node_modules"));
    symlinkSync(here, join(folder, "node_modules", "coseg"));
    symlinkSync(join(here, "node_modules", "@types"), join(folder, "node_modules", "@types"));
    writeFileSync(join(folder, "package.json"), '{ "type": "module" }');
    writeFileSync(join(folder, "snippet.ts"), code);
    const options = ["--strict", "--target", "es2023", "--module", "nodenext", "--skipLibCheck", "--types", "node"];
    const tsc = join(here, "node_modules/.bin/tsc");
    execFileSync(tsc, [...options, "snippet.ts"], { cwd: folder, stdio: "inherit" });
    const env = { ...process.env, COSEG_ENDPOINT: daemon.endpoint };
    execFileSync("node", ["snippet.js"], { cwd: folder, env, stdio: ["ignore", "ignore", "inherit"], timeout: 120_000 });
    console.log(`${document}: its TypeScript runs`);
  } finally {
    await daemon.close();
    rmSync(folder, { recursive: true });
  }
}
