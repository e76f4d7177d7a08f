// Follows a library that changes: looks at it again and again, and loads what is new.

/** Milliseconds between polls of a live library. */
const LOOK_MS = 1_500;

/** Estimates when something is done whose rest is counted again and again. */
class Pace {
  /**
   * Returns how many seconds `n` things are expected to take; null if none was done since they were
   * counted first, or more have come.
   */
  left(n, now) {
    if (!this.begin || n > this.last) this.begin = { n, now };
    this.last = n;
    const done = this.begin.n - n;
    return n > 0 && done > 0 ? (((now - this.begin.now) / 1000) * n) / done : null;
  }
}

class Live {
  constructor(app) {
    this.app = app;
    this.pace = new Pace();
  }

  async look() {
    const { app } = this;
    try {
      const library = await app.source.library(app.name, app.gallery.inSight());
      app.setLibrary(library);
      const names = library.collections.map((c) => c.name);
      const mine = library.collections.find((c) => c.name === app.name);
      const busy = [];
      if (mine?.n_queued) busy.push(`${mine.n_queued} to place`);
      if (mine?.n_stale) busy.push(`${mine.n_stale} to relabel`);
      const left = this.pace.left(mine?.n_stale ?? 0, performance.now());
      // Shapes that are still to be placed may make others stale.
      if (left !== null && !mine.n_queued) busy.push(`about ${Math.ceil(left)} s`);
      this.status(busy.join(" · ") || "live", busy.length ? "work" : "");
      if (!mine && names.length) await app.go({ collection: names[0], shape: null });
      else if (mine && app.loaded && this.differs(mine)) await this.reload();
      // Proposals are made in the background, without an event.
      else if (app.proposals.isOpen) await app.proposals.look();
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
      (key) => now[key] !== this.app.about[key],
    );
  }

  /** Loads what changed, and redraws only that. */
  async reload() {
    const { app } = this;
    const found = await app.source.collection(app.name);
    app.setCollection(found);
    for (const name of app.portraits.keys())
      if (!app.byName.has(name)) app.portraits.delete(name);
    const changed = app.shapes
      .filter((s) => app.portraits.get(s.name)?.version !== s.version)
      .map((s) => s.name);
    for (let i = 0; i < changed.length; i += 16)
      for (const portrait of await app.source.portraitsOf(app.name, changed.slice(i, i + 16))) {
        app.changes.replaced(app.portraits.get(portrait.name));
        app.portraits.set(portrait.name, portrait);
        app.gallery.draw(portrait.name, true);
      }
    app.linker.labelsChanged();
    await app.changes.show();
    if (app.proposals.isOpen) await app.proposals.look();
    if (app.view.order === "moved") app.filter();
    else app.gallery.describeAll();
    const { selected, stage } = app;
    if (!selected) return;
    if (!app.byName.has(selected)) return app.go({ shape: null }, { replace: true });
    app.panel.show(selected);
    const shown = ["labels", "history", "correct", "ask"].includes(stage.mode);
    const isNew = changed.includes(selected) && shown && stage.painting.size === 0;
    if (isNew || (changed.length && stage.mode === "link")) await stage.refresh();
    else app.panel.showControls();
  }
}
