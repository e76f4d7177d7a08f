// Links two parts by two clicks: from then on they have the same label, or different ones. Lists
// the links of the collection.

/** What a link demands: its kind, key, button and words between two parts. */
const LINK_KINDS = [
  ["same", "s", "Same label", "has the label of"],
  ["differ", "d", "Different labels", "has another label than"],
];

class Linker {
  constructor(app) {
    this.app = app;
    this.kind = "same";
    this.forget();
  }

  /** Forgets links and the chosen part, because another collection is shown. */
  forget() {
    this.first = null;
    this.links = [];
  }

  /** Returns whether this part is the one that is chosen. */
  isFirst(shape, part) {
    return this.first?.shape === shape && this.first.part === part;
  }

  /** Goes to the view in which parts are linked. */
  open() {
    const { app } = this;
    const shape = app.selected ?? app.found[0]?.name;
    if (shape) return app.go({ shape, view: "link", detail: null });
  }

  /** Chooses a part. The second one is linked with the first; the same part again is let go. */
  async pick(shape, part) {
    const { app, first } = this;
    if (this.busy) return;
    app.stage.advise("");
    if (this.isFirst(shape, part)) return this.drop();
    if (!first) {
      this.first = { shape, part, version: app.shape(shape).version };
      $("spoken").textContent = `${partText(this.first)} is chosen`;
      return this.refresh();
    }
    this.busy = true;
    app.panel.showControls();
    const done = await app.actions.link(this.kind, first, { shape, part },
      (message) => app.stage.advise(capital(message)));
    this.busy = false;
    if (done) return this.drop();
    app.panel.showControls();
  }

  /** Lets the chosen part go. */
  drop() {
    this.first = null;
    return this.refresh();
  }

  /** Shows which part is chosen. */
  async refresh() {
    const { app } = this;
    if (app.stage.mode !== "link" || !app.selected) return;
    app.panel.show(app.selected);
    await app.stage.refresh();
  }

  /** Lets the chosen part go when a person leaves for another view. */
  left(view) {
    if (view !== "link") this.first = null;
  }

  choose(kind) {
    this.kind = kind;
    this.app.panel.showControls();
  }

  /** Removes a link. */
  unlink(link) {
    return this.app.actions.unlink(link);
  }

  /** Forgets the chosen part if its shape was labelled again, since parts have new numbers then. */
  labelsChanged() {
    const { first, app } = this;
    if (first && app.shape(first.shape)?.version !== first.version) this.first = null;
  }

  controls(box) {
    const { app, first } = this;
    const kinds = LINK_KINDS.map(([kind, key, name]) => {
      const button = make("button",
        { "aria-pressed": String(this.kind === kind), "data-kind": kind,
          title: `${name} (${key})` },
        make("kbd", { "aria-hidden": "true" }, key), name);
      button.onclick = () => this.choose(kind);
      return button;
    });
    const words = LINK_KINDS.find(([kind]) => kind === this.kind)[3];
    const text = this.busy
      ? "The parts are linked …"
      : first
        ? `${partText(first)} ${words} … Click another part, of this shape or of another one.`
        : "Click a part, on the shape or in the list; then the one that it is linked with.";
    const ends = [];
    if (first && !this.busy) {
      const drop = make("button", { id: "link-drop", title: "Let the chosen part go (Esc)" },
        "Let go");
      drop.onclick = () => this.drop();
      ends.push(drop);
    }
    box.replaceChildren(
      make("div", { className: "tools", role: "group", "aria-label": "What is demanded" },
        ...kinds),
      make("span", { className: "quiet", id: "link-state", role: "status" }, text),
      make("span", { className: "ends" }, ...ends),
    );
  }

  /** Makes the list of links, and fills it when they are read. */
  section() {
    const { app } = this;
    const list = make("ul", { className: "links" });
    const title = make("h3", {}, "Links");
    app.source.links(app.name).then(({ links }) => {
      this.links = links;
      title.textContent = `Links (${links.length})`;
      const none = make("li", { className: "quiet" }, "No parts are linked.");
      keepingFocus(list, () =>
        list.replaceChildren(...(links.length ? links.map((link) => this.item(link)) : [none])));
    }, (error) => list.replaceChildren(make("li", { className: "quiet" }, error.message)));
    return [title, list];
  }

  item(link) {
    const { app } = this;
    const end = (part) => {
      const button = make("button", { className: "end", title: `Go to ${part.shape}` },
        partText(part));
      button.onclick = () => app.go({ shape: part.shape, view: "link", detail: null });
      return button;
    };
    const words = LINK_KINDS.find(([kind]) => kind === link.kind)?.[3] ?? link.kind;
    const remove = make("button", { className: "plain", "data-link": link.id,
      title: "Remove this link", "aria-label": `Remove link ${link.id}` }, "✕");
    remove.onclick = () => this.unlink(link);
    const state = linkState(link);
    return make("li", { "data-state": state.replaceAll(" ", "-") },
      make("div", { className: "demand" }, end(link.a), make("span", {}, words), end(link.b)),
      make("div", { className: "quiet" },
        [state, signature(link)].filter(Boolean).join(" · ")),
      remove);
  }

  /** Handles a key; returns whether it has a meaning here. */
  key(key) {
    const { app } = this;
    const kind = LINK_KINDS.find(([, k]) => k === key)?.[0];
    const part = /^[1-9]$/.test(key) ? Number(key) - 1 : -1;
    if (kind) this.choose(kind);
    else if (part >= 0 && part < app.shape(app.selected).parts.length)
      this.pick(app.selected, part);
    else if (key === "Escape" && this.first) this.drop();
    else return false;
    return true;
  }
}

const partText = ({ shape, part }) => `${shape}:${part}`;

/** Says whether the labels are as a link demands. */
function linkState({ overruled, holds }) {
  if (overruled) return "overruled by labels of persons";
  return holds ? "holds" : "does not hold";
}
