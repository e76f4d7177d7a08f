// Makes src/gen from the protocol's own files, with `buf` or `protoc`, whichever there is.
// They are in $COSEG_PROTO, else in the repository's proto folder.
import { spawnSync } from "node:child_process";
import { mkdirSync, readdirSync, rmSync } from "node:fs";
import { dirname, join, resolve } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const proto = process.env.COSEG_PROTO ?? resolve(here, "../../proto");
const plugin = join(here, "node_modules/.bin/protoc-gen-es");
const out = join(here, "src/gen");
const opt = ["target=ts", "import_extension=js"];

rmSync(out, { recursive: true, force: true });
mkdirSync(out, { recursive: true });
const template = { version: "v2", plugins: [{ local: plugin, out, opt }] };
const files = readdirSync(join(proto, "coseg/v1")).map((name) => `coseg/v1/${name}`);
const plugins = [`--plugin=protoc-gen-es=${plugin}`, `--es_out=${out}`, `--es_opt=${opt.join(",")}`];
const attempts = [
  ["buf", "generate", proto, "--template", JSON.stringify(template)],
  ["protoc", `-I${proto}`, ...plugins, ...files],
];
for (const [command, ...args] of attempts) {
  const { error, status } = spawnSync(command, args, { stdio: "inherit" });
  if (error?.code === "ENOENT") continue;
  if (error || status !== 0) throw new Error(`${command} failed: ${error ?? status}`);
  process.exit(0);
}
throw new Error("neither buf nor protoc is installed");
