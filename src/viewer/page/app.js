// The page as a whole: what is loaded, what is selected, what changed.

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
/** What the stage is, for those who do not see it. */
const TURNED =
  "The shape; drag or Shift and arrows turn it, scroll, + or − zooms";
const LINKED =
  "The shape; arrows move the cursor, Space chooses the part, Shift and arrows turn it";
const PAINTED =
  "The shape; arrows move the brush, Space paints, Shift and arrows turn it, + or − zooms";
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
    this.actions = new Actions(this);
    this.verdicts = new Verdicts(this);
    this.asker = new Asker(this);
    this.proposals = new Proposals(this);
    this.linker = new Linker(this);
    this.gallery = new Gallery(this);
    this.stage = new Stage(this);
    this.pointer = new Pointer(this);
    this.painter = new Painter(this);
    this.panel = new Panel(this);
    this.legend = new Legend(this);
    this.editor = new Editor(this);
    this.live = new Live(this);
    this.view = readAddress("");
    this.keys = new Keys(this);
  }

  shape(name) {
    return this.byName.get(name);
  }

  colour(label) {
    return this.labels.get(label)?.rgb ?? OKABE_ITO[label] ?? UNLABELLED;
  }

  /**
   * Returns the colour of a label; grey if another label is selected, or a change is to be seen
   * before it is made.
   */
  shownColour(label) {
    if (this.preview) return this.preview.get(label) ?? DIMMED;
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

  /** Returns a surface with the labels of an older version, if it was loaded. */
  surfaceAt(name, version) {
    return this.cache.get(`surface ${name} ${version}`);
  }

  map(from, to) {
    return this.cached(`map ${from}/${to}`, () => this.source.map(this.name, from, to));
  }

  nearest(name) {
    return this.cached(`nearest ${name} ${this.shapes.length}`, () =>
      this.source.nearest(this.name, name),
    );
  }

  /** Returns all events. One call after the other reads those that are new. */
  events() {
    if (!this.source.live) return this.source.events();
    const { log, name } = this;
    const read = async () => {
      const last = log.at(-1)?.sequence ?? 0;
      log.push(...(await this.source.events(name, last)).filter((e) => e.sequence > last));
      return log;
    };
    return (this.reading = (this.reading ?? Promise.resolve()).then(read, read));
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
    if (this.source.live) this.live.look();
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
    for (const id of ["undo", "redo", "ask", "suggest"]) $(id).hidden = !edit;
    $("propose").hidden = !this.source.live;
    for (const mode of ["correct", "ask", "link"])
      document.querySelector(`[data-mode=${mode}]`).hidden = !edit;
    this.edit = edit;
    document.documentElement.toggleAttribute("data-edit", edit);
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
    this.editor.close();
    this.close();
    const ticket = (this.loading = {});
    [this.portraits, this.cache, this.log] = [new Map(), new Map(), []];
    $("collections").value = name;
    this.changes.forget();
    this.asker.question = null;
    this.proposals.forget();
    this.linker.forget();
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
    this.proposals.follow();
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
    this.editor.refresh();
    this.warnOfUp();
    this.changes.showButtons();
    this.filter();
    if (shapes.length === 0)
      this.empty(
        "No shapes yet",
        "Shapes appear here as they are labelled.",
        `coseg add meshes/ --collection ${collection.name}`,
      );
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
    const only = this.editor.label ?? this.only;
    if (only !== undefined) found = found.filter((s) => s.parts.some((p) => p.label === only));
    if (this.view.review) found = found.filter((s) => stateOf(s) === this.view.review);
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
    this.verdicts.show();
    const all = this.nStored;
    $("count").textContent =
      found.length === all ? counted(all, "shape") : `${found.length} of ${counted(all, "shape")}`;
    if (this.shapes.length && found.length === 0)
      this.empty("Nothing found", this.view.review
        ? `No shape with this name or label is ${this.view.review}.`
        : "No shape has this name or label.");
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
    if (stage.painting.size && !stays) {
      if (!confirm("Discard what is painted?"))
        return history.pushState(null, "", writeAddress(this.view));
      stage.painting.forget();
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
    const wanted = writeAddress({ ...view, collection: null, shape: null });
    if (wanted !== this.filtered) this.filter();
    if (dims) this.recolour();
    this.proposals.follow();
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
    if (other) this.linker.left(view.view);
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
    const { mode } = this.stage;
    $("scene").classList.toggle("painting", mode === "correct");
    $("scene").setAttribute("aria-label", { correct: PAINTED, link: LINKED }[mode] ?? TURNED);
    this.changes.showButtons();
  }

  close() {
    const { selected } = this;
    const inside = document.activeElement?.closest("#stage, #panel");
    this.selected = null;
    this.stage.close();
    $("stage").hidden = $("panel").hidden = true;
    $("main").classList.remove("open");
    placeToasts();
    this.gallery.select(null);
    if (inside) this.gallery.cards.get(selected)?.focus();
  }

  step(by) {
    const at = this.found.findIndex((s) => s.name === this.selected);
    const next = this.found[(at + by + this.found.length) % this.found.length];
    if (next)
      this.go({ shape: next.name, detail: this.stage.mode === "map" ? null : this.view.detail });
  }

  // What other files do, under one name.

  attempt(work) {
    return attempt(work);
  }

  toast(text, bad = false) {
    showToast(text, bad);
  }

  reload() {
    return this.live.reload();
  }
}

function rgb(text) {
  const n = parseInt(text.slice(1), 16);
  return [n >> 16, (n >> 8) & 255, n & 255];
}
