// What a person does to labels and shapes on this page. Each action is sent through `Changes`,
// which can undo and repeat it, and says what it did.

class Actions {
  constructor(app) {
    this.app = app;
  }

  /**
   * Sends a change, says what was done and loads what changed. Returns whether it was made; `fault`
   * says why not.
   */
  change(path, body, said, fault) {
    const { app } = this;
    const work = async () => {
      const done = await app.changes.send(path, { collection: app.name, ...body });
      app.toast(said(done));
      await app.reload();
    };
    return attempt(() => app.changes.inTurn(work), fault);
  }

  /** Sends what is painted. */
  correct() {
    const { app } = this;
    const { painting } = app.stage;
    const shape = app.shape(app.selected);
    if (!painting.size) return;
    const body = { shape: shape.name, n_polygons: shape.n_polygons, runs: painting.runs() };
    return this.change("correct", body, (done) => {
      painting.forget();
      const share = `${percent(done.area_share)} of ${shape.name} is labelled by hand`;
      return `${share}; ${followers(done, shape)}.`;
    });
  }

  /** Approves all labels of the shape. */
  approve() {
    const { app } = this;
    const shape = app.shape(app.selected);
    if (!shape || !app.edit) return;
    if (app.stage.painting.size)
      return app.toast("Apply or discard what is painted first; then approve the shape.", true);
    const body = { shape: shape.name, state: "approved" };
    return this.change("review", body, ({ corrected }) =>
      `${shape.name} is approved; ${followers(corrected, shape)}.`);
  }

  /** Notes that the labels of the shape are not right. */
  doubt() {
    const { app } = this;
    const shape = app.shape(app.selected);
    if (!shape || !app.edit) return;
    const body = { shape: shape.name, state: "doubtful" };
    return this.change("review", body, () => `${shape.name} is doubtful; no label changes.`);
  }

  rename(label, name, fault) {
    const was = this.app.labelName(label);
    return this.change("name", { label, name }, () => `“${was}” is “${name}” now.`, fault);
  }

  merge(label, into, fault) {
    const [from, to] = [label, into].map((id) => this.app.labelName(id));
    const said = (done) => `“${from}” is “${to}” now, on ${counted(done.n_shapes, "shape")}.`;
    return this.change("merge", { label, into }, said, fault);
  }

  split(label, fault) {
    const name = this.app.labelName(label);
    const said = (done) =>
      `A part of “${name}” is “label ${done.label.id}” now: give it a name with its pencil.`;
    return this.change("split", { label }, said, fault);
  }

  /** Makes a proposal of a set the labels. */
  choose(n, set) {
    const said = (done) => {
      const follow = done.n_stale ? `; ${counted(done.n_stale, "shape")} still to follow` : "";
      return `Proposal ${n} is the labels now: ${counted(done.n_labels, "label")}${follow}.`;
    };
    return this.change("choose", { n, set }, said);
  }

  /** Links two parts. */
  link(kind, a, b, fault) {
    const part = ({ shape, part }) => ({ shape, part });
    return this.change("link", { kind, a: part(a), b: part(b) }, (done) => {
      const words = kind === "same" ? "have one label" : "have different labels";
      const there = done.changed ? "from now on" : "already: the same link is there";
      const follow = done.n_stale ? `; ${counted(done.n_stale, "shape")} still to follow` : "";
      return `${partText(a)} and ${partText(b)} ${words} ${there}${follow}.`;
    }, fault);
  }

  /** Removes a link. */
  unlink({ id, a, b }) {
    const said = () => `${partText(a)} and ${partText(b)} are not linked any more.`;
    return this.change("unlink", { id }, said);
  }

  /** Goes to the shape that is most worth labelling. */
  suggest() {
    const { app } = this;
    if (!app.edit) return;
    return app.attempt(async () => {
      const { shape, reason } = await app.source.suggest(app.name);
      await app.go({ shape, view: "correct", detail: null });
      app.toast(`${shape}: ${reason}.`);
    });
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

/** Returns a text with a capital at its beginning. */
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);
