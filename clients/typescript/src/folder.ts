/** Chooses and checks the folder in which daemon and clients meet if no endpoint is named. */

import { lstatSync, mkdirSync, statSync, type Stats } from "node:fs";
import { dirname } from "node:path";
import { CosegError } from "./errors.js";

/**
 * `$RUNTIME_DIRECTORY`, else `$XDG_RUNTIME_DIR/coseg`, else `/tmp/coseg-UID`. Throws {@link
 * CosegError} if anybody but this user and root could listen there. The folder of a service may let
 * a group in; that of a user must be closed to others. A missing folder below `/tmp` is created, so
 * that nobody else creates it while the client waits for a daemon.
 */
export function defaultFolder(): string {
  const { RUNTIME_DIRECTORY, XDG_RUNTIME_DIR } = process.env;
  if (RUNTIME_DIRECTORY) {
    checkFolder(RUNTIME_DIRECTORY, 0o022);
    return RUNTIME_DIRECTORY;
  }
  const folder = XDG_RUNTIME_DIR ? `${XDG_RUNTIME_DIR}/coseg` : `/tmp/coseg-${process.getuid?.() ?? 0}`;
  if (dirname(folder) === "/tmp") {
    try {
      mkdirSync(folder, 0o700);
    } catch (e) {
      if ((e as NodeJS.ErrnoException).code !== "EEXIST") throw e;
    }
  }
  checkFolder(folder, 0o077);
  return folder;
}

/**
 * Throws if the folder, or a link to it, belongs to another user, or others may do what the bits
 * say.
 */
export function checkFolder(folder: string, forbidden: number): void {
  // Both a link and its target are checked: a user who can change the link can redirect it.
  for (const look of [lstatSync, statSync]) {
    let found: Stats;
    try {
      found = look(folder) as Stats;
    } catch (e) {
      if ((e as NodeJS.ErrnoException).code === "ENOENT") return;
      throw e;
    }
    const doubt = "so whoever listens there need not be your daemon";
    const me = process.getuid?.() ?? found.uid;
    if (found.uid !== me && found.uid !== 0) {
      throw new CosegError(
        `${folder} belongs to user ${found.uid}, not to ${me}, ${doubt}; remove it, set XDG_RUNTIME_DIR to a folder ` +
          "of your own, or name the daemon's endpoint",
      );
    }
    const mode = found.mode & 0o7777;
    if (!found.isSymbolicLink() && (mode & forbidden) !== 0) {
      const [may, cure] = (forbidden & 0o055) !== 0 ? ["enter", "700"] : ["write", "go-w"];
      const octal = mode.toString(8).padStart(4, "0");
      throw new CosegError(
        `${folder} has mode ${octal}, which lets others ${may}, ${doubt}; \`chmod ${cure} ${folder}\` mends that`,
      );
    }
  }
}
