// Makes src/gen from the protocol's own files in the repository, with the `buf` that npm brings.
import { spawnSync } from "node:child_process";
import { mkdirSync, rmSync } from "node:fs";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const proto = resolve(here, "../../proto");
const tools = join(here, "node_modules/.bin");
const out = join(here, "src/gen");

rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
const opt = ["target=ts", "import_extension=js"];
const plugins = [{ local: join(tools, "protoc-gen-es"), out, opt }];
const template = JSON.stringify({ version: "v2", plugins });
const args = ["generate", proto, "--template", template];
const { error, status } = spawnSync(join(tools, "buf"), args, { stdio: "inherit" });
if (error || status !== 0) throw new Error(`buf failed: ${error ?? status}`);
