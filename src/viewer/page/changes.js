// Changes that a person makes on this page: sends, undoes and repeats them, and shows their
// progress.

/** Paths of changes that record who made them. */
const SIGNED = ["correct", "answer", "review", "link"];

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

  /** Does one thing after the other, in the order in which a person asked for them. */
  inTurn(work) {
    const turn = (this.last ?? Promise.resolve()).then(work);
    this.last = turn.catch(() => {});
    return turn;
  }

  /** Sends a change and records it. */
  async send(path, body) {
    const by = SIGNED.includes(path) ? { by: this.app.verdicts.reviewer } : {};
    const change = { path, body: { ...body, ...by }, text: changeText(this.app, path, body) };
    const done = await this.make(change);
    this.undone = [];
    return done;
  }

  async make(change) {
    const { app } = this;
    const since = app.about.sequence;
    const done = await app.source.change(change.path, change.body);
    // The same link was there: there is nothing to undo.
    if (done.changed === false) return done;
    change.created = created(change, done);
    if (change.path === "unlink") change.parts = [done.link.a, done.link.b];
    this.made.push(change);
    this.begin(since, change, change.text);
    return done;
  }

  /** Begins to follow what a change moves. Names and doubts move nothing. */
  begin(since, change, text) {
    const moves = change?.path !== "name" && change?.body.state !== "doubtful";
    if (!moves) return;
    this.newest = { since, text, portraits: new Map(), moved: new Map() };
    this.shows = "after";
  }

  /** Undoes a stroke that was not sent yet, or else the newest change by a person. */
  undo() {
    const { app } = this;
    if (app.stage.mode === "correct" && app.stage.painting.step(false)) return;
    if (!app.edit) return;
    return app.attempt(() => this.inTurn(async () => {
      if (!app.about?.n_undoable) return;
      const since = app.about.sequence;
      const undone = await app.source.change("undo", { collection: app.name });
      let change = this.made.pop();
      if (change && isOf(change, undone)) this.undone.push(change);
      else [this.made, this.undone, change] = [[], [], null];
      const text = change?.text ?? undoneText(app, undone);
      this.begin(since, change, `taking back ${text}`);
      const left = undone.n_left
        ? `${counted(undone.n_left, "earlier change")} can be undone too.`
        : "Nothing else can be undone.";
      app.toast(`Undone: ${text}. ${left}`);
      await app.reload();
    }));
  }

  /** Repeats the change that was undone last. */
  redo() {
    const { app } = this;
    if (app.stage.mode === "correct" && app.stage.painting.step(true)) return;
    return app.attempt(() => this.inTurn(async () => {
      const change = this.undone.at(-1);
      if (!change) return;
      const was = change.created;
      await this.make(change);
      this.undone.pop();
      // A label or a link that is made again has another id.
      if (was !== undefined)
        for (const later of this.undone) replaceId(later, change.path, was, change.created);
      app.toast(`Redone: ${change.text}.`);
      await app.reload();
    }));
  }

  /** Says what Undo and Redo would do, and disables what does nothing. */
  showButtons() {
    const { app } = this;
    const { strokes } = app.stage.painting;
    const paints = app.stage.mode === "correct";
    const n = app.about?.n_undoable ?? 0;
    const stroke = paints && strokes.done.length > 0;
    const newest = this.made.length > 0 && this.made.length <= n ? this.made.at(-1).text : null;
    $("undo").disabled = !stroke && !n;
    $("undo").title = stroke
      ? "Take back the newest stroke (Ctrl+Z)"
      : n
        ? `Take back ${newest ?? "the newest change by a person"} (Ctrl+Z)`
        : "Nothing to undo: nobody has changed anything";
    const again = paints && strokes.undone.length > 0;
    $("redo").disabled = !again && this.undone.length === 0;
    $("redo").title = again
      ? "Paint the stroke again that was taken back (Ctrl+Shift+Z)"
      : this.undone.length
        ? `Make ${this.undone.at(-1).text} again (Ctrl+Shift+Z)`
        : "Nothing to redo: nothing was taken back on this page";
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
    this.showButtons();
    if (newest) {
      const moved = new Map();
      for (const e of await app.events()) {
        if (e.kind !== "labels_changed" || e.sequence <= newest.since) continue;
        const share = (e.moves ?? []).reduce((sum, m) => sum + m.area_share, 0);
        moved.set(e.shape, Math.min((moved.get(e.shape) ?? 0) + share, 1));
      }
      newest.moved = moved;
    }
    if (newest === this.newest) this.showEffect();
  }

  showEffect() {
    const { app, newest } = this;
    const box = $("effect");
    box.hidden = !newest;
    if (!newest) return;
    const shares = [...newest.moved.values()].filter((share) => share > 0);
    const all = shares.reduce((sum, share) => sum + share, 0) / Math.max(app.shapes.length, 1);
    const n = counted(app.shapes.length, "shape");
    const waiting = app.about.n_stale;
    const more = waiting ? `; ${counted(waiting, "shape")} still to come` : "";
    const text = shares.length
      ? `${capital(newest.text)} changed ${percent(all)} of all area, on ${shares.length} of ${n}`
      : `${capital(newest.text)} changed no label`;
    keepingFocus(box, () =>
      box.replaceChildren(make("span", {}, `${text}${more}.`), ...this.effectButtons()),
    );
  }

  effectButtons() {
    const { app } = this;
    const isFirst = app.view.order === "moved";
    const first = make(
      "button",
      { id: "moved-first", "aria-pressed": String(isFirst) },
      "Changed first",
    );
    first.onclick = () => app.go({ order: isFirst ? "arrival" : "moved" }, { replace: true });
    const toggle = make(
      "button",
      { id: "before", "aria-pressed": String(this.shows === "before"),
        title: "Show the shapes as they were before (v)" },
      make("kbd", { "aria-hidden": "true" }, "v"),
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
      app.gallery.describeAll();
      this.show();
    };
    return [first, toggle, close];
  }

  toggle(shows = this.shows === "before" ? "after" : "before") {
    this.shows = shows;
    $("before")?.setAttribute("aria-pressed", String(shows === "before"));
    this.app.gallery.redraw();
    if (this.app.selected) this.app.stage.refresh();
  }
}

/** Returns a noun for a change, with the names of the moment. */
function changeText(app, path, body) {
  const name = (label) => `“${app.labelName(label)}”`;
  switch (path) {
    case "correct": return `the correction of ${body.shape}`;
    case "answer": return `the answer about ${body.shape}`;
    case "review":
      return `the ${body.state === "approved" ? "approval" : "doubt"} of ${body.shape}`;
    case "name": return `the name “${body.name}”`;
    case "merge": return `the merge of ${name(body.label)} into ${name(body.into)}`;
    case "split": return `the split of ${name(body.label)}`;
    case "choose": return `the choice of proposal ${body.n}`;
    case "link": return `the link of ${partText(body.a)} and ${partText(body.b)}`;
    case "unlink": return `the removal of link ${body.id}`;
    default: return path;
  }
}

/** Returns a noun for a change that was not made on this page. */
function undoneText(app, { change, subject }) {
  const known = { approve: "the approval", doubt: "the doubt", name: "the newest name of a label",
    correct: "the correction", answer: "the answer", up: "the change of the up axis",
    choose: "the choice of proposal", same: "the link", differ: "the link",
    unlink: "the removal of the link" }[change];
  const label = app.labelName(Number(subject));
  if (change === "merge" || change === "split") return `the ${change} of “${label}”`;
  if (change === "choose") return `${known} ${subject}`;
  return `${known ?? change}${subject && change !== "up" ? ` of ${subject}` : ""}`;
}

/** Returns whether this change is the one that was undone in the library. */
function isOf({ path, body, parts }, undone) {
  const ends = path === "link" ? [body.a, body.b] : parts;
  const kinds = { review: body.state === "approved" ? "approve" : "doubt", link: body.kind };
  const subjects = { name: undone.subject, choose: String(body.n) };
  const subject =
    ends?.map(partText).join(" ") ?? subjects[path] ?? body.shape ?? String(body.label);
  return (kinds[path] ?? path) === undone.change && subject === undone.subject;
}

/** Returns the id of the label or the link that a change made, if it may have made one. */
function created({ path, body }, done) {
  if (path === "split") return done.label.id;
  if (path === "answer" && body.named) return done.label;
  if (path === "link") return done.link.id;
  return undefined;
}

/** Replaces the id of a label or a link, which a change of the kind `made` made, in a later one. */
function replaceId({ path, body }, made, was, now) {
  if (made === "link") {
    if (path === "unlink" && body.id === was) body.id = now;
    return;
  }
  for (const key of ["label", "into"]) if (body[key] === was) body[key] = now;
  for (const run of body.runs ?? []) if (run[2] === was) run[2] = now;
}
