// Shows proposals side by side: divisions of the shapes into labels, from coarse to fine, of which
// a person chooses one.

/** Number of shapes in the large row, and of those on each card. */
const N_LARGE = 6;
const N_SMALL = 3;

class Proposals {
  constructor(app) {
    this.app = app;
    this.root = $("proposals");
    this.forget();
  }

  /** Forgets what is shown, because another collection is. */
  forget() {
    this.found = null;
    this.all = [];
    this.at = null;
    /** Meshes of each proposal in its classes, by its number. */
    this.meshes = new Map();
    this.names = [];
    this.shown = "";
    this.asked = this.ticket = {};
    this.root.replaceChildren();
  }

  get isOpen() {
    return this.app.view.show === "proposals" && this.app.loaded;
  }

  /** Shows the proposals in place of the cards, or the cards. */
  async follow() {
    const { app } = this;
    const open = this.isOpen;
    const opened = open && this.root.hidden;
    const inside = this.root.contains(document.activeElement);
    this.root.hidden = !open;
    $("gallery").hidden = open;
    $("propose").setAttribute("aria-pressed", String(open));
    if (!open && inside) $("propose").focus();
    if (!opened) return;
    this.shown = "";
    await this.look();
    $("finer")?.focus();
  }

  toggle() {
    return this.app.go({ shape: null, show: this.isOpen ? null : "proposals" });
  }

  /** Looks for proposals; says in their place why there are none to be seen. */
  async look() {
    const asked = (this.asked = {});
    try {
      await this.fetch(asked);
    } catch (error) {
      if (asked !== this.asked) return;
      this.shown = "";
      this.root.replaceChildren(make("div", { id: "proposing", role: "status" }, error.message));
    }
  }

  /** Fetches the proposals, and shows them if they are not those that are shown. */
  async fetch(asked) {
    const { app } = this;
    const found = await app.source.proposals(app.name);
    const key = JSON.stringify([found, app.about.sequence]);
    if (asked !== this.asked || !this.isOpen || key === this.shown) return;
    // Only what is new ends the drawing of what was there.
    const ticket = (this.ticket = {});
    this.shown = key;
    if (found.set !== this.found?.set) {
      this.meshes.clear();
      this.names = spread(found.shapes ?? [], N_LARGE);
    }
    this.found = found;
    const all = (this.all = withThoseInForce(found.proposals, app.labelsInUse().length));
    if (!all.some((p) => p.n === this.at)) this.at = all.find((p) => p.in_force)?.n ?? null;
    this.build();
    // Those that are wanted first are drawn first.
    const order = [...all].sort((a, b) => (b.n === this.at) - (a.n === this.at));
    for (const { n } of order) {
      await this.load(n);
      if (ticket !== this.ticket || !this.isOpen) return;
      await this.draw(n);
    }
    this.root.dataset.ready = found.set;
  }

  /** Fetches the shapes of a proposal in its classes, once. */
  async load(n) {
    const { app } = this;
    const here = n === 0 && this.names.map((name) => app.portraits.get(name));
    if (!here && this.meshes.has(n)) return;
    const portraits = here || (await app.source.proposed(app.name, n, this.names));
    this.meshes.set(n, portraits.map((portrait) => new Mesh(portrait, app.up)));
  }

  build() {
    const { all } = this;
    delete this.root.dataset.ready;
    this.cards = new Map(all.map((p) => [p.n, this.card(p)]));
    this.large = make("div", { className: "large", role: "img" },
      ...this.names.map(() => make("canvas")));
    this.bar = make("div", { className: "choice" });
    const cards = make("div", { className: "divisions", role: "group",
      "aria-label": "Proposals, from coarse to fine" }, ...this.cards.values());
    const state = make("div", { className: "quiet", id: "proposing", role: "status" },
      progressText(this.found));
    keepingFocus(this.root, () => {
      this.root.replaceChildren(state, ...(all.length ? [this.bar, this.large, cards] : []));
      this.showChoice();
    });
  }

  /** Makes the card of a proposal. */
  card(p) {
    const labels = counted(p.n_labels, "label");
    const value = p.n ? `value ${p.value.toFixed(2)}` : "none of the proposals";
    const facts = `${value} · ${p.in_force ? "in force" : `differs ${p.differs.toFixed(2)}`}`;
    const select = make("button", { className: "division", "data-n": p.n,
      title: "Look at this proposal" },
      make("span", { className: "row" },
        ...this.names.slice(0, N_SMALL).map(() => make("canvas", { "aria-hidden": "true" }))),
      make("span", { className: "title" }, make("kbd", {}, String(p.n)), labels),
      make("span", { className: "quiet" }, facts));
    select.onclick = () => this.select(p.n);
    return select;
  }

  /** Shows the proposal that is looked at, and what can be done with it. */
  showChoice() {
    const { app, all, at } = this;
    const i = all.findIndex((p) => p.n === at);
    if (i < 0) return;
    const p = all[i];
    for (const [n, card] of this.cards) card.setAttribute("aria-pressed", String(n === at));
    const text = `${p.n ? `Proposal ${p.n}` : "In force"}: ${counted(p.n_labels, "label")}`;
    if (!this.slider?.isConnected || Number(this.slider.max) !== all.length - 1) {
      this.slider = make("input", { type: "range", id: "finer", min: 0, max: all.length - 1,
        step: 1, "aria-label": "From coarse to fine" });
      this.slider.oninput = () => this.select(this.all[this.slider.value].n);
      this.output = make("output", {});
      this.choosing = make("button", { className: "primary", id: "choose" });
      this.choosing.onclick = () => this.choose();
      this.note = make("span", { className: "quiet" });
      this.bar.replaceChildren(make("label", {}, "Coarser", this.slider, "finer"), this.output,
        this.choosing, this.note);
    }
    this.slider.value = i;
    this.slider.setAttribute("aria-valuetext", text);
    this.output.textContent = text;
    this.choosing.textContent = p.in_force ? "In force" : `Choose proposal ${p.n}`;
    this.choosing.title = "Make it the labels of all shapes (Enter)";
    this.choosing.disabled = !app.edit || p.in_force;
    this.note.textContent = p.in_force
      ? "These are the labels now."
      : `Value ${p.value.toFixed(2)} among divisions with as many labels; differs by ` +
        `${p.differs.toFixed(2)} from the labels in force (0: not at all, 1: completely).`;
    this.large.setAttribute("aria-label", `${text}, on ${this.names.join(", ")}`);
  }

  select(n) {
    this.at = n;
    this.showChoice();
    this.cards.get(n).scrollIntoView({ block: "nearest" });
    this.draw(n);
  }

  /** Makes the proposal that is looked at the labels. */
  choose() {
    const p = this.all.find((p) => p.n === this.at);
    if (p && !this.choosing.disabled) return this.app.actions.choose(p.n, this.found.set);
  }

  /** Draws a proposal on its card, and large if it is looked at. */
  async draw(n) {
    const meshes = this.meshes.get(n);
    if (!meshes) return;
    const colour = this.colours(meshes);
    const rows = [this.cards.get(n).querySelector(".row")];
    if (n === this.at) rows.unshift(this.large);
    for (const row of rows) {
      const canvases = [...row.children];
      const sizes = canvases.map((canvas) => this.app.thumbnails.size(canvas));
      for (const [i, canvas] of canvases.entries()) {
        const [width, height] = sizes[i];
        const picture = this.app.thumbnails.raster.picture(meshes[i], colour, width, height);
        [canvas.width, canvas.height] = [width, height];
        canvas.getContext("2d", { willReadFrequently: true }).putImageData(picture, 0, 0);
        canvas.dataset.drawn = n;
      }
      // What a person does meanwhile comes first.
      await new Promise((resolve) => setTimeout(resolve));
      if (row === this.large && n !== this.at) return;
    }
  }

  /**
   * Returns the colour of each class: that of the label in force which it covers most, so that the
   * same parts have the same colours here and on the cards; of the others, one that is free.
   */
  colours(meshes) {
    const { app } = this;
    const overlap = new Map();
    for (const mesh of meshes) {
      const inForce = app.portraits.get(mesh.portrait.name);
      if (inForce?.labels.data.length !== mesh.nFaces) continue;
      const areas = mesh.faceAreas;
      for (let f = 0; f < mesh.nFaces; f++) {
        const key = `${mesh.labels[f]} ${inForce.palette[inForce.labels.data[f]]}`;
        overlap.set(key, (overlap.get(key) ?? 0) + areas[f]);
      }
    }
    const [of, taken] = [new Map(), new Set()];
    for (const [key] of [...overlap].sort((a, b) => b[1] - a[1])) {
      const [kind, label] = key.split(" ").map(Number);
      if (label < 0 || of.has(kind) || taken.has(label)) continue;
      of.set(kind, app.colour(label));
      taken.add(label);
    }
    const used = new Set([...of.values()].map(String));
    const free = this.found.colours.map(rgb).filter((colour) => !used.has(String(colour)));
    return (kind) => {
      if (!of.has(kind)) of.set(kind, free.shift() ?? UNLABELLED);
      return of.get(kind);
    };
  }

  /** Handles a key; returns whether it has a meaning here. */
  key(event) {
    const { all } = this;
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const i = all.findIndex((p) => p.n === this.at);
    const to = by ? all[i + by] : all.find((p) => String(p.n) === event.key);
    if (to) this.select(to.n);
    else if (event.key === "Enter" && !event.target.closest("button, select, a")) this.choose();
    else return false;
    return true;
  }
}

/** Returns `n` of the items, evenly spread. */
function spread(items, n) {
  if (items.length <= n) return [...items];
  return Array.from({ length: n }, (_, i) => items[Math.floor((i * items.length) / n)]);
}

/**
 * Returns proposals with the labels in force among them, as number 0 if they are none of the
 * proposals: a person compares with what there is.
 */
function withThoseInForce(proposals, nLabels) {
  if (proposals.length === 0 || proposals.some((p) => p.in_force)) return proposals;
  const finer = proposals.findIndex((p) => p.n_labels > nLabels);
  const at = finer < 0 ? proposals.length : finer;
  const inForce = { n: 0, n_labels: nLabels, in_force: true, differs: 0 };
  return [...proposals.slice(0, at), inForce, ...proposals.slice(at)];
}

/** Says how far the making of proposals is, and why there are none yet. */
function progressText({ proposals, why, n_steps: nSteps, n_done: nDone }) {
  if (why) return capital(why);
  if (!nSteps) return proposals.length ? "" : "Nothing can be proposed for these shapes.";
  const done = `${nDone} of ${nSteps} steps are done`;
  const when = "while the daemon has nothing else to do";
  return proposals.length
    ? `New proposals are made ${when}: ${done}. These are the previous ones.`
    : `Proposals are made ${when}: ${done}.`;
}
