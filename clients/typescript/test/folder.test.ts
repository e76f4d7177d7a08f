/** Tests that a client does not connect to a default folder that another user created. */

import assert from "node:assert/strict";
import { chmodSync, chownSync, mkdirSync, mkdtempSync, rmSync, symlinkSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { test } from "node:test";
import { checkFolder } from "../src/folder.js";
import { CosegError, defaultEndpoint } from "../src/index.js";
import { inWords } from "../src/size.js";

test("a default folder in which others could listen is refused", () => {
  const parent = mkdtempSync(join(tmpdir(), "coseg"));
  const folder = join(parent, "coseg");
  const before = { ...process.env };
  try {
    delete process.env.COSEG_ENDPOINT;
    delete process.env.RUNTIME_DIRECTORY;
    process.env.XDG_RUNTIME_DIR = parent;
    mkdirSync(folder, 0o700);
    assert.equal(defaultEndpoint(), `ipc://${folder}/coseg.sock`);
    for (const mode of [0o750, 0o755, 0o777]) {
      chmodSync(folder, mode);
      const said = new RegExp(`${folder} has mode 0${mode.toString(8)}.*\`chmod 700 ${folder}\``);
      assert.throws(defaultEndpoint, (e) => e instanceof CosegError && said.test(e.message));
    }
    const link = join(parent, "link");
    symlinkSync(folder, link);
    assert.throws(() => checkFolder(link, 0o077), CosegError);
    checkFolder(join(parent, "missing"), 0o077);
    process.env.RUNTIME_DIRECTORY = folder;
    chmodSync(folder, 0o770);
    assert.throws(defaultEndpoint, /lets others write/);
    chmodSync(folder, 0o750);
    assert.equal(defaultEndpoint(), `ipc://${folder}/coseg.sock`);
    if (process.getuid?.() === 0) {
      chownSync(folder, 12_345, 0);
      assert.throws(defaultEndpoint, /belongs to user 12345, not to 0/);
    }
    process.env.COSEG_ENDPOINT = "ipc:///x/y";
    assert.equal(defaultEndpoint(), "ipc:///x/y");
  } finally {
    for (const name of ["COSEG_ENDPOINT", "RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"]) {
      if (before[name] === undefined) delete process.env[name];
      else process.env[name] = before[name];
    }
    rmSync(parent, { recursive: true });
  }
});

test("sizes have units and stay exact", () => {
  assert.equal(inWords(64 * 2 ** 20), "64 MiB");
  assert.equal(inWords(80_000_000), "76.3 MiB (80000000 bytes)");
  assert.equal(inWords(999), "999 bytes");
});
