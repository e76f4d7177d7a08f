// The page as a whole: what is loaded, what is selected, what changed.

/** Milliseconds between polls of a live library. */
const LOOK_MS = 1_500;
/** Okabe and Ito's colours, which the library gives to labels. */
const OKABE_ITO = [
  [230, 159, 0],
  [86, 180, 233],
  [0, 158, 115],
  [240, 228, 66],
  [0, 114, 178],
  [213, 94, 0],
  [204, 121, 167],
  [128, 128, 128],
];
/** Colour of faces outside the selected label. */
const DIMMED = [206, 210, 216];

class App {
  constructor(source) {
    this.source = source;
    this.portraits = new Map();
    this.labels = new Map();
    this.shapes = [];
    this.cache = new Map();
    this.thumbnails = new Thumbnails(this);
    this.changes = new Changes(this);
    this.asker = new Asker(this);
    this.gallery = new Gallery(this);
    this.stage = new Stage(this);
    this.panel = new Panel(this);
    this.legend = new Legend(this);
    this.view = readAddress("");
    this.listen();
  }

  shape(name) {
    return this.byName.get(name);
  }

  colour(label) {
    return this.labels.get(label)?.rgb ?? OKABE_ITO[label] ?? UNLABELLED;
  }

  /** Returns the colour of a label; grey if another label is selected. */
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

  // Data. Each item is requested once.

  async cached(key, ask) {
    if (!this.cache.has(key))
      this.cache.set(
        key,
        ask().catch((e) => (this.cache.delete(key), Promise.reject(e))),
      );
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
    return this.cached(`nearest ${name} ${this.shapes.length}`, () =>
      this.source.nearest(this.name, name),
    );
  }

  async events() {
    if (!this.source.live) return this.source.events();
    const last = this.log.at(-1)?.sequence ?? 0;
    this.log.push(...(await this.source.events(this.name, last)).filter((e) => e.sequence > last));
    return this.log;
  }

  /** Returns the shapes from which a map to `name` can be shown, best first. */
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
    if (library.collections.length === 0) {
      this.empty(
        "The library is empty",
        "Add a folder of meshes, and they appear here as they are labelled.",
        "coseg add meshes/ --collection chairs",
      );
      document.documentElement.dataset.ready = "empty";
    } else {
      await this.follow();
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
    for (const id of ["undo", "redo", "ask", "suggest", "approve"]) $(id).hidden = !edit;
    for (const mode of ["correct", "ask"])
      document.querySelector(`[data-mode=${mode}]`).hidden = !edit;
    this.edit = edit;
  }

  empty(title, text, command) {
    $("empty").hidden = !title;
    if (!title) return;
    const parts = [make("h2", {}, title), make("div", {}, text)];
    if (command) parts.push(make("code", {}, command));
    $("empty").replaceChildren(...parts);
  }

  async load(name) {
    this.name = name;
    this.loaded = false;
    this.close();
    const ticket = (this.loading = {});
    [this.portraits, this.cache, this.log] = [new Map(), new Map(), []];
    $("collections").value = name;
    this.changes.forget();
    this.asker.question = null;
    this.changes.show();
    this.gallery.show([]);
    const found = await this.source.collection(name);
    if (this.loading !== ticket) return;
    this.setCollection(found);
    for await (const batch of this.source.portraits(name, this.shapes)) {
      if (this.loading !== ticket) return;
      for (const portrait of batch) {
        this.portraits.set(portrait.name, portrait);
        this.gallery.draw(portrait.name);
      }
      // Opens the shape of the address as soon as it is loaded.
      if (!this.selected && this.portraits.has(this.view.shape)) this.open();
      // Draw the visible shapes before the next batch is read.
      await this.thumbnails.idle();
    }
    if (this.loading !== ticket) return;
    document.documentElement.dataset.loadedMs = Math.round(performance.now());
    this.loaded = true;
    this.thumbnailsDrawn();
    this.open();
  }

  setCollection({ collection, shapes, n_stored: nStored }) {
    this.about = collection;
    this.up = collection.up;
    this.shapes = shapes;
    this.nStored = nStored ?? shapes.length;
    this.byName = new Map(shapes.map((s) => [s.name, s]));
    this.labels = new Map(collection.labels.map((l) => [l.id, { ...l, rgb: rgb(l.colour) }]));
    this.legend.show();
    this.warnOfUp();
    $("undo").disabled = !collection.n_undoable;
    $("undo").title = collection.n_undoable
      ? "Take back the newest change by a person"
      : "Nothing to undo: nobody has changed anything";
    this.filter();
    if (shapes.length === 0)
      this.empty(
        "No shapes yet",
        "Shapes appear here as they are labelled.",
        `coseg add meshes/ --collection ${collection.name}`,
      );
    else this.empty();
  }

  /** Records when all visible pictures are drawn: milliseconds since the page was requested. */
  thumbnailsDrawn() {
    const root = document.documentElement;
    const inSight = [...this.gallery.cards.values()].filter((c) => c.inSight);
    const someShown =
      inSight.length > 0 || this.found.length === 0 || this.gallery.root.clientHeight === 0;
    if (!someShown || !inSight.every((c) => c.firstChild.dataset.drawn)) return;
    root.dataset.visibleMs ??= Math.round(performance.now());
    if (this.loaded) root.dataset.ready = "true";
  }

  // The gallery.

  filter() {
    this.filtered = writeAddress({ ...this.view, collection: null, shape: null });
    const words = $("search").value.toLowerCase().split(/\s+/).filter(Boolean);
    const names = (s) =>
      `${s.name} ${s.parts.map((p) => this.labelName(p.label)).join(" ")}`.toLowerCase();
    let found = this.shapes.filter((s) => words.every((w) => names(s).includes(w)));
    if (this.only !== undefined)
      found = found.filter((s) => s.parts.some((p) => p.label === this.only));
    if (this.view.review)
      found = found.filter((s) => (s.review?.state ?? "unseen") === this.view.review);
    const orders = {
      moved: (a, b) => this.changes.moved(b.name) - this.changes.moved(a.name),
      name: (a, b) => a.name.localeCompare(b.name, "en", { numeric: true }),
      doubt: (a, b) => certainty(a) - certainty(b),
      changed: (a, b) => b.version - a.version,
    };
    const order = orders[$("order").value];
    if (order) found.sort((a, b) => order(a, b) || a.ordinal - b.ordinal);
    this.found = found;
    this.gallery.show(found);
    const all = this.nStored;
    const approved = this.shapes.filter((s) => s.review?.state === "approved").length;
    const verdicts = approved ? `, ${approved} approved` : "";
    $("count").textContent =
      (found.length === all
        ? counted(all, "shape")
        : `${found.length} of ${counted(all, "shape")}`) + verdicts;
    if (this.shapes.length && found.length === 0)
      this.empty("Nothing found", "No shape has this name or label.");
    else if (this.shapes.length) this.empty();
  }

  /**
   * Warns if shapes seem to stand along another axis than the collection's, and says what to do.
   */
  warnOfUp() {
    const { about } = this;
    const other = about.up_disagrees;
    $("warning").hidden = !other;
    if (!other) return;
    const word = /^[\p{L}\p{N}_.][\p{L}\p{N}_.-]*$/u.test(about.name);
    const name = word ? about.name : `'${about.name.replaceAll("'", "'\\''")}'`;
    $("warning").replaceChildren(
      `This collection was given up ${about.up}, but ${percent(other.agreement)} of the shapes ` +
        `that were clustered last stand along ${other.up}. ` +
        "If they do, this finds the labels again: ",
      make("code", {}, `coseg collections set ${name} --up ${other.up}`),
    );
  }

  // The state of the page. Every selection goes through the address, so that Back, Forward and
  // links restore it.

  /**
   * Goes to the address with these changes, as a new entry of the history or in place of this one.
   */
  go(changes, { replace = false } = {}) {
    const address = writeAddress({ ...this.view, ...changes });
    if (address === writeAddress(this.view)) return this.follow();
    if (replace) history.replaceState(null, "", address);
    else history.pushState(null, "", address);
    return this.follow();
  }

  /** Shows the state that the address describes. */
  async follow() {
    const { stage } = this;
    const view = readAddress(location.hash);
    const names = this.library.collections.map((c) => c.name);
    const unknown = view.collection && !names.includes(view.collection) ? view.collection : null;
    if (!names.includes(view.collection))
      Object.assign(view, { collection: names[0], shape: null, label: null });
    const tab = document.querySelector(`[data-mode="${view.view}"]:not([hidden])`);
    if (view.shape && !tab) Object.assign(view, { view: "labels", detail: null });
    const stays =
      view.collection === this.name && view.shape === this.selected && view.view === stage.mode;
    if (stage.painted.size && !stays) {
      if (!confirm("Discard what is painted?"))
        return history.pushState(null, "", writeAddress(this.view));
      stage.painted.clear();
    }
    this.view = view;
    history.replaceState(null, "", writeAddress(view));
    document.title = [view.shape, view.collection, "coseg viewer"].filter(Boolean).join(" – ");
    if (document.activeElement !== $("search")) $("search").value = view.search;
    $("order").value = view.order;
    const only = view.label ?? undefined;
    const dims = only !== this.only;
    this.only = only;
    if (unknown) this.toast(`There is no collection “${unknown}” here.`, true);
    if (view.collection !== this.name) return this.load(view.collection);
    if (dims) this.legend.show();
    $("review").value = view.review ?? "";
    const wanted = writeAddress({ ...view, collection: null, shape: null });
    if (wanted !== this.filtered) this.filter();
    if (dims) this.recolour();
    await this.open();
  }

  /** Draws all shapes again in other colours. */
  recolour() {
    this.gallery.redraw();
    if (!this.stage.scenes?.length) return;
    this.stage.colour();
    this.stage.draw();
  }

  // One shape.

  /** Shows the shape of the address once it is loaded, or closes the stage if there is none. */
  async open() {
    const { stage, view } = this;
    const { shape } = view;
    if (!shape) return this.close();
    if (!this.portraits.has(shape)) {
      if (this.loaded) {
        this.toast(
          `There is no shape “${shape}” in ${this.name}` +
            `${this.byName.has(shape) ? " that is loaded" : ""}.`,
          true,
        );
        await this.go({ shape: null }, { replace: true });
      }
      return;
    }
    const another = this.selected !== shape;
    const other = another || stage.mode !== view.view;
    if (!other && this.detail === view.detail) return;
    this.selected = shape;
    this.detail = view.detail;
    stage.choose(view);
    $("stage").hidden = $("panel").hidden = false;
    $("main").classList.add("open");
    this.gallery.select(shape);
    this.showTabs();
    // A narrow page has no room for the cards beside the shape.
    if (
      another &&
      document.activeElement?.closest("#gallery") &&
      this.gallery.root.clientHeight === 0
    )
      this.tab().focus();
    if (other) {
      this.panel.show(shape);
      // The controls of the view are at the top.
      this.panel.root.scrollTop = 0;
    }
    if (another) await stage.show(shape);
    else await stage.refresh();
  }

  tab() {
    return document.querySelector(`[data-mode="${this.stage.mode}"]`);
  }

  showTabs() {
    for (const tab of document.querySelectorAll("[data-mode]")) {
      const chosen = tab === this.tab();
      tab.setAttribute("aria-selected", String(chosen));
      tab.tabIndex = chosen ? 0 : -1;
    }
    $("scene").classList.toggle("painting", this.stage.mode === "correct");
  }

  close() {
    const { selected } = this;
    const inside = document.activeElement?.closest("#stage, #panel");
    this.selected = null;
    this.stage.close();
    $("stage").hidden = $("panel").hidden = true;
    $("main").classList.remove("open");
    this.gallery.select(null);
    if (inside) this.gallery.cards.get(selected)?.focus();
  }

  step(by) {
    const at = this.found.findIndex((s) => s.name === this.selected);
    const next = this.found[(at + by + this.found.length) % this.found.length];
    if (next)
      this.go({ shape: next.name, detail: this.stage.mode === "map" ? null : this.view.detail });
  }

  async correct() {
    const { stage } = this;
    const shape = this.shape(this.selected);
    const body = {
      collection: this.name,
      shape: shape.name,
      n_polygons: shape.n_polygons,
      runs: stage.runs(),
    };
    await this.attempt(async () => {
      const done = await this.changes.send("correct", body);
      stage.painted.clear();
      this.toast(
        `${percent(done.area_share)} of ${shape.name} is labelled by hand; ` +
          `${followers(done, shape)}.`,
      );
      await this.reload();
    });
  }

  /** Approves all labels of the shape. */
  approve() {
    const shape = this.shape(this.selected);
    if (!shape || !this.edit || this.stage.painted.size) return;
    return this.attempt(async () => {
      const body = { collection: this.name, shape: shape.name, state: "approved" };
      const { corrected } = await this.changes.send("review", body);
      this.toast(`${shape.name} is approved; ${followers(corrected, shape)}.`);
      await this.reload();
    });
  }

  /** Goes to the shape that is most worth labelling. */
  suggest() {
    if (!this.edit) return;
    return this.attempt(async () => {
      const { shape, reason } = await this.source.suggest(this.name);
      await this.go({ shape, view: "correct", detail: null });
      this.toast(`${shape}: ${reason}.`);
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
    // Above the shapes, so that it covers nothing that can be pressed.
    const box = (
      $("stage").hidden ? $("main") : document.querySelector(".scene")
    ).getBoundingClientRect();
    const room = {
      left: box.left + 14,
      bottom: window.innerHeight - Math.min(box.bottom, window.innerHeight) + 14,
    };
    for (const [side, pixels] of Object.entries(room))
      $("toasts").style[side] = `${Math.round(pixels)}px`;
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
      if (mine?.n_queued) busy.push(`${mine.n_queued} to place`);
      if (mine?.n_stale) busy.push(`${mine.n_stale} to relabel`);
      this.status(busy.join(" · ") || "live", busy.length ? "work" : "");
      if (!mine && names.length) await this.go({ collection: names[0], shape: null });
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
    return ["sequence", "n_shapes", "n_stale", "n_undoable"].some(
      (key) => now[key] !== this.about[key],
    );
  }

  /** Loads what changed, and redraws only that. */
  async reload() {
    const found = await this.source.collection(this.name);
    this.setCollection(found);
    for (const name of this.portraits.keys())
      if (!this.byName.has(name)) this.portraits.delete(name);
    const changed = this.shapes
      .filter((s) => this.portraits.get(s.name)?.version !== s.version)
      .map((s) => s.name);
    for (let i = 0; i < changed.length; i += 16)
      for (const portrait of await this.source.portraitsOf(this.name, changed.slice(i, i + 16))) {
        this.changes.replaced(this.portraits.get(portrait.name));
        this.portraits.set(portrait.name, portrait);
        this.gallery.draw(portrait.name, true);
      }
    await this.changes.show();
    if (this.view.order === "moved") this.filter();
    const { selected } = this;
    if (!selected) return;
    if (!this.byName.has(selected)) return this.go({ shape: null }, { replace: true });
    this.panel.show(selected);
    const shown = ["labels", "history", "correct", "ask"].includes(this.stage.mode);
    if (changed.includes(selected) && shown && this.stage.painted.size === 0)
      await this.stage.refresh();
    else this.panel.showControls();
  }

  listen() {
    $("search").oninput = () => this.go({ search: $("search").value }, { replace: true });
    $("order").onchange = () => this.go({ order: $("order").value }, { replace: true });
    $("collections").onchange = () =>
      this.attempt(() =>
        this.go({ collection: $("collections").value, shape: null, label: null, search: "" }),
      );
    $("close").onclick = () => this.go({ shape: null });
    $("previous").onclick = () => this.step(-1);
    $("next").onclick = () => this.step(1);
    $("skip").onfocus = () =>
      ($("skip").textContent = this.selected ? "Skip to the shape" : "Skip to the shapes");
    $("skip").onclick = () =>
      (this.selected ? this.tab() : this.gallery.root.querySelector(".card"))?.focus();
    $("theme").onclick = () =>
      setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark", true);
    $("review").onchange = () => this.go({ review: $("review").value || null }, { replace: true });
    $("undo").onclick = () => this.changes.undo();
    $("redo").onclick = () => this.changes.redo();
    $("ask").onclick = () => this.attempt(() => this.asker.next());
    $("suggest").onclick = () => this.suggest();
    $("approve").onclick = () => this.approve();
    const tabs = [...document.querySelectorAll("[data-mode]")];
    for (const tab of tabs) tab.onclick = () => this.go({ view: tab.dataset.mode, detail: null });
    document.querySelector("[role=tablist]").onkeydown = (event) => {
      const shown = tabs.filter((tab) => !tab.hidden);
      const next = moved(shown.indexOf(event.target), shown.length, 1, event.key);
      if (next === null) return;
      event.preventDefault();
      shown[next].focus();
      shown[next].click();
    };
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("popstate", () => this.attempt(() => this.follow()));
    window.addEventListener("resize", () => this.gallery.redraw());
  }

  /** Handles keys that mean the same wherever the focus is, except in fields. */
  key(event) {
    if (/INPUT|SELECT|TEXTAREA/.test(event.target.tagName) || event.defaultPrevented) return;
    if ((event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z") {
      event.preventDefault();
      return event.shiftKey ? this.changes.redo() : this.changes.undo();
    }
    if (event.ctrlKey || event.altKey || event.metaKey || event.shiftKey) return;
    if (this.edit && this.loaded) {
      if (event.key === "q") return this.attempt(() => this.asker.next());
      if (event.key === "g") return this.suggest();
      if (event.key === "v" && this.changes.newest) return this.changes.toggle();
    }
    if (!this.selected) return;
    if (event.key === "Escape") $("close").click();
    if (this.edit && event.key === "y") return this.approve();
    if (this.stage.mode === "ask" && this.asker.key(event.key)) return event.preventDefault();
    if (this.stage.mode === "correct" && this.panel.paintKey(event.key)) return;
    if (event.target.closest("[role=tablist]")) return;
    // Arrows move between cards only while no shape is open.
    if (event.key === "ArrowLeft") this.step(-1);
    if (event.key === "ArrowRight") this.step(1);
  }
}

/**
 * Returns the number of other shapes that wait for a correction of this one. The shape may wait
 * itself.
 */
function followers(done, shape) {
  const n = done.n_stale - (done.n_faces < shape.n_polygons ? 1 : 0);
  return `${counted(n, "other shape")} ${n === 1 ? "follows" : "follow"}`;
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
    // A page that is a file may have no storage.
  }
}

function wantedTheme() {
  try {
    const kept = localStorage.getItem("coseg-theme");
    if (kept) return kept;
  } catch {
    // A page that is a file may have no storage.
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
  $("empty").replaceChildren(
    make("h2", {}, "The viewer cannot start"),
    make("div", {}, error.message),
  );
  document.documentElement.dataset.ready = "failed";
  throw error;
}
