// Reads shapes from the daemon that serves this page, or from packs inside the file itself.

const TYPES = { u8: Uint8Array, u16: Uint16Array, u32: Uint32Array, f32: Float32Array };

/** Returns a pack's JSON with references replaced by arrays. */
function readPack(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const base = Math.ceil((4 + length) / 8) * 8;
  const isArray = (value) => value && typeof value === "object" && "at" in value && "type" in value;
  const text = new TextDecoder().decode(new Uint8Array(buffer, 4, length));
  return JSON.parse(text, (_, value) => {
    if (!isArray(value)) return value;
    const count = value.shape.reduce((a, b) => a * b, 1);
    const data = new TYPES[value.type](buffer, base + value.at, count);
    return { ...value, data };
  });
}

/** Returns the numbers of a quantised array, row by row. */
function numbers(array) {
  const { data, low, high } = array;
  const columns = low.length;
  const steps = array.type === "u8" ? 255 : 65535;
  const factor = low.map((l, i) => (high[i] - l) / steps);
  const out = new Float32Array(data.length);
  for (let i = 0; i < data.length; i++) out[i] = low[i % columns] + data[i] * factor[i % columns];
  return out;
}

/** Returns one column of a quantised array. */
function column(array, at) {
  const { data, low, high } = array;
  const columns = array.shape[1];
  const steps = array.type === "u8" ? 255 : 65535;
  const factor = (high[at] - low[at]) / steps;
  const out = new Float32Array(array.shape[0]);
  for (let i = 0; i < out.length; i++) out[i] = low[at] + data[i * columns + at] * factor;
  return out;
}

/** Decodes base 64. */
function bytesOf(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const words = atob(text);
  const bytes = new Uint8Array(words.length);
  for (let i = 0; i < words.length; i++) bytes[i] = words.charCodeAt(i);
  return bytes;
}

async function unpacked(element) {
  const stream = new Blob([bytesOf(element.textContent)])
    .stream()
    .pipeThrough(new DecompressionStream("gzip"));
  return readPack(await new Response(stream).arrayBuffer());
}

/** Reads everything from this file. Nothing can be changed. */
class EmbeddedSource {
  constructor(element) {
    this.live = false;
    this.catalogue = JSON.parse(element.textContent);
    this.elements = new Map();
    for (const pack of document.querySelectorAll("script[data-kind]"))
      this.elements.set(`${pack.dataset.kind} ${pack.dataset.key}`, pack);
  }

  async library() {
    return {
      version: this.catalogue.version,
      edit: false,
      collections: [this.catalogue.collection],
    };
  }

  async collection() {
    return this.catalogue;
  }

  /** Yields portraits in batches, each as soon as it is read. */
  async *portraits() {
    for (let i = 0; this.elements.has(`portraits ${i}`); i++) {
      const element = this.elements.get(`portraits ${i}`);
      yield (await unpacked(element)).shapes;
      element.remove();
    }
  }

  async functions(_, shape) {
    const at = this.catalogue.functions.indexOf(shape);
    if (at < 0)
      throw new Error(
        "Left out of this file. Write it with --functions N to have more shapes with functions.",
      );
    return (await unpacked(this.elements.get(`functions ${at}`))).shapes[0];
  }

  /** Returns the shapes from which there is a map to `shape`. */
  mapSources(shape) {
    return this.catalogue.maps.filter((m) => m[1] === shape).map((m) => m[0]);
  }

  async map(_, from, to) {
    const at = this.catalogue.maps.findIndex((m) => m[0] === from && m[1] === to);
    if (at < 0) throw new Error("Left out of this file. Write it with --maps N to have more maps.");
    return unpacked(this.elements.get(`map ${at}`));
  }

  async nearest(_, shape) {
    return this.catalogue.neighbors[shape] ?? [];
  }

  async events() {
    return this.catalogue.events;
  }
}

/** Status of an answer that has no room yet; a read is then tried again after so long. */
const BUSY = 503;
const BUSY_MS = 300;
const MAX_TRIES = 4;
/** Most shapes that the page names to the daemon as those that it shows. */
const MAX_SHOWN = 48;

/** Reads from the daemon that serves this page. */
class LiveSource {
  constructor() {
    this.live = true;
  }

  async fetch(path, parameters = {}) {
    const query = new URLSearchParams(parameters);
    for (let tries = 1; ; tries++) {
      const response = await fetch(`api/${path}?${query}`);
      if (response.ok) return response;
      if (response.status !== BUSY || tries === MAX_TRIES) throw new Error(await refusal(response));
      await new Promise((resolve) => setTimeout(resolve, tries * BUSY_MS));
    }
  }

  async json(path, parameters) {
    return (await this.fetch(path, parameters)).json();
  }

  async pack(path, parameters) {
    return readPack(await (await this.fetch(path, parameters)).arrayBuffer());
  }

  async change(path, body) {
    const headers = { "content-type": "application/json", "x-coseg": "1" };
    const response = await fetch(`api/${path}`, {
      method: "POST",
      headers,
      body: JSON.stringify(body),
    });
    if (!response.ok) throw new Error(await refusal(response));
    return response.json();
  }

  /** Returns the library. Shapes that the page shows, the first ones, are relabelled first. */
  library(collection, names = []) {
    const first = names.slice(0, MAX_SHOWN).map((name) => ["first", name]);
    return this.json("library", collection ? [["collection", collection], ...first] : []);
  }

  collection(name) {
    return this.json("collection", { collection: name });
  }

  async *portraits(collection, shapes) {
    // The first batch is small, so that something appears at once.
    let size = 12;
    let after = 0;
    const last = shapes.at(-1)?.ordinal ?? 0;
    let next = () => this.pack("portraits", { collection, after, limit: size });
    let coming = last > 0 ? next() : null;
    while (coming) {
      const batch = (await coming).shapes;
      if (batch.length === 0) return;
      after = shapes.find((s) => s.name === batch.at(-1).name)?.ordinal ?? last;
      size = 40;
      coming = after < last ? next() : null;
      yield batch;
    }
  }

  /** Returns the portraits of a few shapes that changed. */
  async portraitsOf(collection, names) {
    const parameters = [["collection", collection], ...names.map((name) => ["shape", name])];
    return (await this.pack("portraits", parameters)).shapes;
  }

  async surface(collection, shape) {
    return (await this.pack("portraits", { collection, shape, detail: "surface" })).shapes[0];
  }

  async functions(collection, shape) {
    return (await this.pack("portraits", { collection, shape, detail: "functions" })).shapes[0];
  }

  mapSources() {
    return null;
  }

  map(collection, from, to) {
    return this.pack("map", { collection, from, to });
  }

  proposals(collection) {
    return this.json("proposals", { collection });
  }

  /** Returns portraits of shapes in the classes of a proposal. */
  async proposed(collection, proposal, names) {
    const shapes = names.map((name) => ["shape", name]);
    const parameters = [["collection", collection], ["proposal", proposal], ...shapes];
    return (await this.pack("portraits", parameters)).shapes;
  }

  links(collection) {
    return this.json("links", { collection });
  }

  question(collection) {
    return this.json("question", { collection });
  }

  suggest(collection) {
    return this.json("suggest", { collection });
  }

  async nearest(collection, shape) {
    return (await this.json("nearest", { collection, shape, limit: 6 })).neighbors;
  }

  async events(collection, since = 0) {
    const events = [];
    for (let more = true; more; ) {
      const page = await this.json("events", { collection, since });
      events.push(...page.events);
      more = page.more && page.events.length > 0;
      since = page.events.at(-1)?.sequence ?? since;
    }
    return events;
  }
}

async function refusal(response) {
  const text = await response.text();
  try {
    return JSON.parse(text).error.message;
  } catch {
    return text.trim() || `the daemon answered ${response.status}`;
  }
}
