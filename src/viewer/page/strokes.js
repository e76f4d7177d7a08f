// Records what is painted on a shape, stroke by stroke. Each stroke can be undone and repeated
// until it is sent.

class Strokes {
  constructor() {
    this.clear();
  }

  clear() {
    this.done = [];
    this.undone = [];
    /** Painted label of each polygon. */
    this.labels = new Map();
    this.open = null;
  }

  get size() {
    return this.labels.size;
  }

  begin() {
    this.open = { before: new Map() };
  }

  /** Paints a polygon within the stroke; null removes the painted label. */
  paint(polygon, label) {
    const { open, labels } = this;
    const was = labels.get(polygon);
    if (was === (label ?? undefined)) return;
    if (!open.before.has(polygon)) open.before.set(polygon, was);
    if (label === null) labels.delete(polygon);
    else labels.set(polygon, label);
  }

  /** Ends a stroke. One that changed nothing is no step. */
  end() {
    const { open } = this;
    this.open = null;
    if (!open?.before.size) return;
    this.done.push(open);
    this.undone = [];
  }

  /** Moves the newest stroke of one list to the other. Returns false if there is none. */
  step(from, to) {
    this.end();
    const stroke = from.pop();
    if (!stroke) return false;
    const now = new Map();
    for (const [polygon, label] of stroke.before) {
      now.set(polygon, this.labels.get(polygon));
      if (label === undefined) this.labels.delete(polygon);
      else this.labels.set(polygon, label);
    }
    to.push({ before: now });
    return true;
  }

  undo() {
    return this.step(this.done, this.undone);
  }

  redo() {
    return this.step(this.undone, this.done);
  }
}
