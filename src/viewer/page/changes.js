// Changes that a person makes on this page: sends, undoes and repeats them, and shows their
// progress.

class Changes {
  constructor(app) {
    this.app = app;
    this.forget();
  }

  /** Forgets the changes, because another collection is shown. */
  forget() {
    this.made = [];
    this.undone = [];
    this.newest = null;
    this.shows = "after";
  }

  /** Sends a change and records it. */
  async send(path, body, redo = false) {
    const { app } = this;
    const since = app.about.sequence;
    const done = await app.source.change(path, body);
    this.made.push({ path, body });
    if (!redo) this.undone = [];
    this.newest = { since, portraits: new Map(), moved: new Map() };
    this.shows = "after";
    return done;
  }

  /** Undoes a stroke that was not sent yet, or else the newest change by a person. */
  undo() {
    const { app } = this;
    if (app.stage.mode === "correct" && app.stage.stroke(false)) return;
    if (!app.edit || !app.about?.n_undoable) return;
    return app.attempt(async () => {
      const since = app.about.sequence;
      const undone = await app.source.change("undo", { collection: app.name });
      const made = this.made.pop();
      if (made && isOf(made, undone)) this.undone.push(made);
      else [this.made, this.undone] = [[], []];
      this.newest = { since, portraits: new Map(), moved: new Map() };
      const subject = undone.subject ? ` of ${undone.subject}` : "";
      app.toast(
        `Undone: ${undone.change}${subject}. ` +
          `${counted(undone.n_left, "change")} before it can be undone.`,
      );
      await app.reload();
    });
  }

  /** Repeats the change that was undone last. */
  redo() {
    const { app } = this;
    if (app.stage.mode === "correct" && app.stage.stroke(true)) return;
    const made = this.undone.pop();
    if (!made) return;
    return app.attempt(async () => {
      await this.send(made.path, made.body, true);
      app.toast(`Done again: ${made.path}${made.body.shape ? ` of ${made.body.shape}` : ""}.`);
      await app.reload();
    });
  }

  /** Records the portrait that a shape had before the newest change. */
  replaced(portrait) {
    const { newest } = this;
    if (newest && portrait && !newest.portraits.has(portrait.name))
      newest.portraits.set(portrait.name, portrait);
  }

  /** Returns the portrait that is to be shown instead of the present one. */
  before(name) {
    return this.shows === "before" ? this.newest?.portraits.get(name) : undefined;
  }

  /** Returns the share of a shape's area that the newest change moved. */
  moved(name) {
    return this.newest?.moved.get(name) ?? 0;
  }

  /** Shows the progress of the newest change. */
  async show() {
    const { app, newest } = this;
    const box = $("effect");
    $("redo").disabled = this.undone.length === 0;
    box.hidden = !newest;
    if (!newest) return;
    newest.moved.clear();
    for (const e of await app.events()) {
      if (e.kind !== "labels_changed" || e.sequence <= newest.since) continue;
      const share = (e.moves ?? []).reduce((sum, m) => sum + m.area_share, 0);
      newest.moved.set(e.shape, Math.min(this.moved(e.shape) + share, 1));
    }
    const n = [...newest.moved.values()].filter((share) => share > 0).length;
    const all =
      [...newest.moved.values()].reduce((sum, share) => sum + share, 0) /
      Math.max(app.shapes.length, 1);
    const waiting = app.about.n_stale;
    const first = make(
      "button",
      { id: "moved-first", "aria-pressed": String(app.view.order === "moved") },
      "Changed first",
    );
    first.onclick = () =>
      app.go({ order: app.view.order === "moved" ? "arrival" : "moved" }, { replace: true });
    const toggle = make(
      "button",
      { id: "before", "aria-pressed": String(this.shows === "before") },
      make("kbd", {}, "v"),
      "Before",
    );
    toggle.onclick = () => this.toggle();
    const close = make(
      "button",
      { className: "plain", id: "effect-close", "aria-label": "Close", title: "Close" },
      "✕",
    );
    close.onclick = () => {
      this.newest = null;
      this.toggle("after");
      this.show();
    };
    const wait = waiting ? `; ${counted(waiting, "shape")} to come` : "";
    keepingFocus(box, () =>
      box.replaceChildren(
        `Your last change moved ${percent(all)} of the area, on ${counted(n, "shape")}${wait}. `,
        first,
        toggle,
        close,
      ),
    );
  }

  toggle(shows = this.shows === "before" ? "after" : "before") {
    this.shows = shows;
    $("before")?.setAttribute("aria-pressed", String(shows === "before"));
    this.app.gallery.redraw();
    if (this.app.selected) this.app.stage.refresh();
  }
}

/** Returns whether this change is the one that was undone in the library. */
function isOf(made, undone) {
  const kinds = { correct: ["correct"], answer: ["answer"], review: ["approve", "doubt"] }[
    made.path
  ] ?? [made.path];
  return kinds.includes(undone.change) && (!made.body.shape || made.body.shape === undone.subject);
}
