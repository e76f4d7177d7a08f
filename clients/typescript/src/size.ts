/** Formats numbers of bytes for messages. */

const UNITS = [
  ["TiB", 2 ** 40],
  ["GiB", 2 ** 30],
  ["MiB", 2 ** 20],
  ["KiB", 2 ** 10],
] as const;

/** Formats a size: `64 MiB` if that is exact, `76.3 MiB (80000000 bytes)` if it is rounded. */
export function inWords(n: number): string {
  const found = UNITS.find(([, unit]) => n >= unit);
  if (found === undefined) return n === 1 ? "1 byte" : `${n} bytes`;
  const [name, unit] = found;
  return n % unit === 0 ? `${n / unit} ${name}` : `${(n / unit).toFixed(1)} ${name} (${n} bytes)`;
}

/** The message that something exceeds a limit, with the setting of the daemon that raises it. */
export function beyond(what: string, found: number, limit: number, key: string): string {
  return `${what} ${inWords(found)}, the limit is ${inWords(limit)} (${key} of the daemon's configuration)`;
}
