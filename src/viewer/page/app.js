// The page as a whole: what is loaded, what is chosen, what changed.

/** Milliseconds between looks at a live library. */
const LOOK_MS = 1_500;
/** Okabe and Ito's colours, as the library gives them to labels. */
const OKABE_ITO = [
  [230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [0, 114, 178], [213, 94, 0], [204, 121, 167], [128, 128, 128],
];
/** Colour of what a chosen label does not cover. */
const DIMMED = [206, 210, 216];

class App {
  constructor(source) {
    this.source = source;
    this.portraits = new Map();
    this.labels = new Map();
    this.shapes = [];
    this.cache = new Map();
    this.thumbnails = new Thumbnails(this);
    this.gallery = new Gallery(this);
    this.stage = new Stage(this);
    this.panel = new Panel(this);
    this.listen();
  }

  shape(name) {
    return this.byName.get(name);
  }

  colour(label) {
    return this.labels.get(label)?.rgb ?? OKABE_ITO[label] ?? UNLABELLED;
  }

  /** The colour of a label where others may be dimmed. */
  shownColour(label) {
    return this.only === undefined || this.only === label ? this.colour(label) : DIMMED;
  }

  labelName(label) {
    if (label < 0) return "unlabelled";
    return this.labels.get(label)?.name || `label ${label}`;
  }

  labelsInUse() {
    return [...this.labels.values()].filter((l) => l.n_shapes > 0);
  }

  // Data, each asked for once.

  async cached(key, ask) {
    if (!this.cache.has(key)) this.cache.set(key, ask().catch((e) => (this.cache.delete(key), Promise.reject(e))));
    return this.cache.get(key);
  }

  functions(name) {
    return this.cached(`functions ${name}`, () => this.source.functions(this.name, name));
  }

  surface(name) {
    const version = this.shape(name).version;
    return this.cached(`surface ${name} ${version}`, () => this.source.surface(this.name, name));
  }

  map(from, to) {
    return this.cached(`map ${from}/${to}`, () => this.source.map(this.name, from, to));
  }

  nearest(name) {
    return this.cached(`nearest ${name} ${this.shapes.length}`, () => this.source.nearest(this.name, name));
  }

  async events() {
    if (!this.source.live) return this.source.events();
    const last = this.log.at(-1)?.sequence ?? 0;
    this.log.push(...(await this.source.events(this.name, last)).filter((e) => e.sequence > last));
    return this.log;
  }

  /** Shapes from which a map to `name` can be shown, the best first. */
  mapSources(name) {
    const inside = this.source.mapSources(name);
    if (inside) return inside;
    const sources = this.shape(name)?.sources.map((s) => s.shape) ?? [];
    const others = this.shapes.map((s) => s.name);
    return [...new Set([...sources, ...others])].filter((n) => n !== name && this.portraits.has(n));
  }

  // Loading.

  async start() {
    const library = await this.source.library();
    this.setLibrary(library);
    const [wanted] = this.address();
    const names = library.collections.map((c) => c.name);
    if (names.length === 0) {
      this.empty("The library is empty", "Add a folder of meshes, and they appear here as they are labelled.", "coseg add meshes/ --collection chairs");
      document.documentElement.dataset.ready = "empty";
    } else {
      await this.load(names.includes(wanted) ? wanted : names[0]);
    }
    if (this.source.live) this.look();
  }

  setLibrary(library) {
    this.library = library;
    const names = library.collections.map((c) => c.name);
    const select = $("collections");
    if (names.join("\n") !== [...select.options].map((o) => o.value).join("\n"))
      select.replaceChildren(...names.map((name) => make("option", { value: name }, name)));
    if (this.name) select.value = this.name;
    select.hidden = names.length === 0;
    const edit = this.source.live && library.edit;
    $("undo").hidden = !edit;
    document.querySelector("[data-mode=correct]").hidden = !edit;
    this.edit = edit;
  }

  empty(title, text, command) {
    $("empty").hidden = !title;
    if (!title) return;
    $("empty").replaceChildren(make("h2", {}, title), make("div", {}, text), command ? make("code", {}, command) : null);
  }

  async load(name) {
    this.name = name;
    this.close();
    const ticket = (this.loading = {});
    [this.portraits, this.cache, this.log, this.only] = [new Map(), new Map(), [], undefined];
    $("collections").value = name;
    document.title = `${name} – coseg viewer`;
    this.gallery.show([]);
    const found = await this.source.collection(name);
    if (this.loading !== ticket) return;
    this.setCollection(found);
    let first = true;
    for await (const batch of this.source.portraits(name, this.shapes)) {
      if (this.loading !== ticket) return;
      for (const portrait of batch) {
        this.portraits.set(portrait.name, portrait);
        this.gallery.draw(portrait.name);
      }
      if (first) this.restore();
      first = false;
      // Draw what is in sight before the next batch is read.
      await this.thumbnails.idle();
    }
    document.documentElement.dataset.loadedMs = Math.round(performance.now());
    this.loaded = true;
    this.thumbnailsDrawn();
    if (!this.selected) this.restore();
  }

  setCollection({ collection, shapes, n_stored: nStored }) {
    this.about = collection;
    this.up = collection.up;
    this.shapes = shapes;
    this.nStored = nStored ?? shapes.length;
    this.byName = new Map(shapes.map((s) => [s.name, s]));
    this.labels = new Map(collection.labels.map((l) => [l.id, { ...l, rgb: rgb(l.colour) }]));
    this.showLegend();
    this.filter();
    if (shapes.length === 0)
      this.empty("No shapes yet", "Shapes appear here as they are labelled.", `coseg add meshes/ --collection ${collection.name}`);
    else this.empty();
  }

  /** Notes when all pictures that are in sight are there: milliseconds since the page was asked for. */
  thumbnailsDrawn() {
    const root = document.documentElement;
    const inSight = [...this.gallery.cards.values()].filter((c) => c.inSight);
    const someShown = inSight.length > 0 || this.found.length === 0 || this.gallery.root.clientHeight === 0;
    if (!someShown || !inSight.every((c) => c.firstChild.dataset.drawn)) return;
    root.dataset.visibleMs ??= Math.round(performance.now());
    if (this.loaded) root.dataset.ready = "true";
  }

  // The gallery.

  showLegend() {
    const chips = this.labelsInUse().map((label) => {
      const chip = make("span", { className: "chip", role: "button", tabIndex: 0, "data-label": label.id,
        "aria-pressed": String(this.only === label.id), title: "Show only shapes with this label" },
        swatch(label.rgb), make("span", { className: "text" }, this.labelName(label.id)),
        make("span", { className: "n" }, String(label.n_shapes)));
      const choose = () => this.choose(label.id);
      chip.onclick = choose;
      chip.onkeydown = (event) => event.target === chip && event.key === "Enter" && choose();
      if (this.edit) {
        const pencil = make("button", { className: "pencil", title: "Rename", "aria-label": `Rename ${this.labelName(label.id)}` }, "✎");
        pencil.onclick = (event) => {
          event.stopPropagation();
          this.rename(chip, label);
        };
        chip.append(pencil);
      }
      return chip;
    });
    // A name that is being typed stays.
    if (!$("legend").querySelector("input")) $("legend").replaceChildren(...chips);
  }

  rename(chip, label) {
    const input = make("input", { value: label.name ?? "", placeholder: `label ${label.id}`, maxLength: 128, "aria-label": "Name of the label" });
    const text = chip.querySelector(".text");
    text.replaceWith(input);
    input.focus();
    input.select();
    let over = false;
    const end = async (keep) => {
      if (over) return;
      over = true;
      const name = input.value.trim();
      input.replaceWith(text);
      if (!keep || !name || name === label.name) return;
      await this.attempt(async () => {
        await this.source.change("name", { collection: this.name, label: label.id, name });
        await this.reload();
        this.toast(`Label ${label.id} is “${name}” now.`);
      });
    };
    input.onclick = (event) => event.stopPropagation();
    input.onkeydown = (event) => {
      event.stopPropagation();
      if (event.key === "Enter") end(true);
      if (event.key === "Escape") end(false);
    };
    input.onblur = () => end(true);
  }

  choose(label) {
    this.only = this.only === label ? undefined : label;
    this.showLegend();
    this.filter();
    this.gallery.redraw();
    if (this.stage.scenes?.length) {
      this.stage.colour();
      this.stage.draw();
    }
  }

  filter() {
    const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const names = (s) => `${s.name} ${s.parts.map((p) => this.labelName(p.label)).join(" ")}`.toLowerCase();
    let found = this.shapes.filter((s) => words.every((w) => names(s).includes(w)));
    if (this.only !== undefined) found = found.filter((s) => s.parts.some((p) => p.label === this.only));
    const orders = {
      name: (a, b) => a.name.localeCompare(b.name, "en", { numeric: true }),
      doubt: (a, b) => certainty(a) - certainty(b),
      changed: (a, b) => b.version - a.version,
    };
    const order = orders[$("order").value];
    if (order) found.sort((a, b) => order(a, b) || a.ordinal - b.ordinal);
    this.found = found;
    this.gallery.show(found);
    const all = this.nStored;
    $("count").textContent = found.length === all ? `${all} shapes` : `${found.length} of ${all} shapes`;
    if (this.shapes.length && found.length === 0) this.empty("Nothing found", "No shape has this name or label.");
    else if (this.shapes.length) this.empty();
  }

  // One shape.

  address() {
    const parts = location.hash.slice(1).split("/").map(decodeURIComponent);
    return parts;
  }

  restore() {
    const [, shape, mode] = this.address();
    if (shape && this.portraits.has(shape)) this.open(shape, mode);
  }

  async open(name, mode) {
    if (!this.portraits.has(name)) return;
    if (this.stage.painted.size && name !== this.selected && !confirm("Discard what is painted?")) return;
    this.selected = name;
    if (mode && document.querySelector(`[data-mode="${mode}"]:not([hidden])`)) this.stage.mode = mode;
    $("stage").hidden = $("panel").hidden = false;
    $("main").classList.add("open");
    this.gallery.select(name);
    this.showMode();
    this.panel.show(name);
    await this.stage.show(name);
  }

  showMode() {
    for (const tab of document.querySelectorAll("[data-mode]"))
      tab.setAttribute("aria-selected", String(tab.dataset.mode === this.stage.mode));
    $("scene").classList.toggle("painting", this.stage.mode === "correct");
    history.replaceState(null, "", `#${[this.name, this.selected, this.stage.mode].map(encodeURIComponent).join("/")}`);
  }

  async setMode(mode) {
    if (this.stage.painted.size && !confirm("Discard what is painted?")) return;
    this.stage.painted.clear();
    this.stage.mode = mode;
    this.showMode();
    // The functional map is at the top of it.
    if (mode === "map") this.panel.root.scrollTop = 0;
    await this.stage.setMode(mode);
  }

  close() {
    this.selected = null;
    this.stage.close();
    $("stage").hidden = $("panel").hidden = true;
    $("main").classList.remove("open");
    this.gallery.select(null);
  }

  step(by) {
    const at = this.found.findIndex((s) => s.name === this.selected);
    const next = this.found[(at + by + this.found.length) % this.found.length];
    if (next) this.open(next.name);
  }

  async correct() {
    const { stage } = this;
    const shape = this.shape(this.selected);
    const body = { collection: this.name, shape: shape.name, n_polygons: shape.n_polygons, runs: stage.runs() };
    await this.attempt(async () => {
      const done = await this.source.change("correct", body);
      stage.painted.clear();
      this.toast(`${percent(done.area_share)} of ${shape.name} is labelled by hand; ${done.n_stale} shapes follow.`);
      await this.reload();
    });
  }

  // A live library.

  async attempt(work) {
    try {
      await work();
    } catch (error) {
      this.toast(error.message, true);
    }
  }

  toast(text, bad = false) {
    const toast = make("div", { className: bad ? "toast bad" : "toast" }, text);
    $("toasts").append(toast);
    setTimeout(() => toast.remove(), bad ? 9_000 : 5_000);
  }

  async look() {
    try {
      const library = await this.source.library();
      this.setLibrary(library);
      const names = library.collections.map((c) => c.name);
      const mine = library.collections.find((c) => c.name === this.name);
      const busy = [];
      if (library.n_queued) busy.push(`${library.n_queued} to place`);
      if (mine?.n_stale) busy.push(`${mine.n_stale} to relabel`);
      this.status(busy.join(" · ") || "live", busy.length ? "work" : "");
      if (!mine && names.length) await this.load(names[0]);
      else if (mine && this.loaded && this.differs(mine)) await this.reload();
    } catch {
      this.status("the daemon does not answer", "bad");
    }
    setTimeout(() => this.look(), LOOK_MS);
  }

  status(text, kind) {
    $("state").hidden = false;
    $("state").textContent = text;
    $("state").className = `pill ${kind}`;
  }

  differs(now) {
    return ["sequence", "n_shapes", "n_stale"].some((key) => now[key] !== this.about[key]);
  }

  /** Takes over what changed, and draws only that anew. */
  async reload() {
    const found = await this.source.collection(this.name);
    this.setCollection(found);
    for (const name of this.portraits.keys()) if (!this.byName.has(name)) this.portraits.delete(name);
    const changed = this.shapes.filter((s) => this.portraits.get(s.name)?.version !== s.version).map((s) => s.name);
    for (let i = 0; i < changed.length; i += 16)
      for (const portrait of await this.source.portraitsOf(this.name, changed.slice(i, i + 16))) {
        this.portraits.set(portrait.name, portrait);
        this.gallery.draw(portrait.name, true);
      }
    const { selected } = this;
    if (!selected) return;
    if (!this.byName.has(selected)) return this.close();
    this.panel.show(selected);
    const shown = this.stage.mode === "labels" || this.stage.mode === "correct";
    if (changed.includes(selected) && shown && this.stage.painted.size === 0) await this.stage.refresh();
    else this.panel.showControls();
  }

  listen() {
    $("search").oninput = () => this.filter();
    $("order").onchange = () => this.filter();
    $("collections").onchange = () => this.attempt(() => this.load($("collections").value));
    $("close").onclick = () => {
      this.close();
      history.replaceState(null, "", "#" + encodeURIComponent(this.name));
    };
    $("previous").onclick = () => this.step(-1);
    $("next").onclick = () => this.step(1);
    $("theme").onclick = () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark", true);
    $("undo").onclick = () => this.attempt(async () => {
      if (!confirm("Take the newest change by a person back? This cannot be redone.")) return;
      const undone = await this.source.change("undo", { collection: this.name });
      this.toast(`Undone: ${undone.change}. ${undone.n_left} changes before it can be undone.`);
      await this.reload();
    });
    for (const tab of document.querySelectorAll("[data-mode]")) tab.onclick = () => this.setMode(tab.dataset.mode);
    document.addEventListener("keydown", (event) => {
      if (!this.selected || /INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
      if (event.key === "Escape") $("close").click();
      if (event.key === "ArrowLeft") this.step(-1);
      if (event.key === "ArrowRight") this.step(1);
    });
    window.addEventListener("resize", () => this.gallery.redraw());
  }
}

function rgb(text) {
  const n = parseInt(text.slice(1), 16);
  return [n >> 16, (n >> 8) & 255, n & 255];
}

function setTheme(theme, keep) {
  document.documentElement.dataset.theme = theme;
  try {
    if (keep) localStorage.setItem("coseg-theme", theme);
  } catch {
    // A file may not keep anything.
  }
}

function wantedTheme() {
  try {
    const kept = localStorage.getItem("coseg-theme");
    if (kept) return kept;
  } catch {
    // As above.
  }
  return matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
}

setTheme(wantedTheme(), false);
const embedded = $("catalogue");
try {
  const app = new App(embedded ? new EmbeddedSource(embedded) : new LiveSource());
  await app.start();
} catch (error) {
  $("empty").hidden = false;
  $("empty").replaceChildren(make("h2", {}, "The viewer cannot start"), make("div", {}, error.message));
  document.documentElement.dataset.ready = "failed";
  throw error;
}
