// Connects the controls of the page with what they do, and keys that mean the same everywhere.

class Keys {
  constructor(app) {
    this.app = app;
    this.listen();
  }

  listen() {
    const { app } = this;
    $("search").oninput = () => app.go({ search: $("search").value }, { replace: true });
    $("order").onchange = () => app.go({ order: $("order").value }, { replace: true });
    $("collections").onchange = () =>
      app.attempt(() =>
        app.go({ collection: $("collections").value, shape: null, label: null, search: "" }),
      );
    $("close").onclick = () => app.go({ shape: null });
    $("previous").onclick = () => app.step(-1);
    $("next").onclick = () => app.step(1);
    $("skip").onfocus = () =>
      ($("skip").textContent = app.selected ? "Skip to the shape" : "Skip to the shapes");
    $("skip").onclick = () => {
      const first = app.proposals.isOpen ? $("finer") : app.gallery.root.querySelector(".card");
      (app.selected ? app.tab() : first)?.focus();
    };
    $("theme").onclick = () =>
      setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark", true);
    $("undo").onclick = () => app.changes.undo();
    $("redo").onclick = () => app.changes.redo();
    $("ask").onclick = () => app.attempt(() => app.asker.next());
    $("propose").onclick = () => app.proposals.toggle();
    $("suggest").onclick = () => app.actions.suggest();
    $("help").onclick = () => $("keys").showModal();
    this.listenToTabs();
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("popstate", () => app.attempt(() => app.follow()));
  }

  listenToTabs() {
    const tabs = [...document.querySelectorAll("[data-mode]")];
    for (const tab of tabs)
      tab.onclick = () => this.app.go({ view: tab.dataset.mode, detail: null });
    document.querySelector("[role=tablist]").onkeydown = (event) => {
      const shown = tabs.filter((tab) => !tab.hidden);
      const next = moved(shown.indexOf(event.target), shown.length, 1, event.key);
      if (next === null) return;
      event.preventDefault();
      shown[next].focus();
      shown[next].click();
    };
  }

  /** Handles keys that mean the same wherever the focus is, except in fields. */
  key(event) {
    const { app } = this;
    if ($("keys").open || event.defaultPrevented) return;
    const slides = event.target.type === "range" && !/^(Arrow|Home|End|Page)/.test(event.key);
    if (/INPUT|SELECT|TEXTAREA/.test(event.target.tagName) && !slides) return;
    const letter = event.ctrlKey || event.metaKey ? event.key.toLowerCase() : "";
    if (letter === "z" || letter === "y") {
      event.preventDefault();
      return event.shiftKey || letter === "y" ? app.changes.redo() : app.changes.undo();
    }
    if (event.key === "?" && !event.ctrlKey && !event.altKey) return $("keys").showModal();
    if (event.ctrlKey || event.altKey || event.metaKey || event.shiftKey) return;
    if (event.key === "Escape") return this.escape();
    if (app.edit && app.loaded && this.everywhere(event)) return event.preventDefault();
    if (app.proposals.isOpen && app.proposals.key(event)) return event.preventDefault();
    if (!app.selected) return;
    if (app.edit && this.besideAShape(event)) return event.preventDefault();
    if (event.target.closest("[role=tablist]")) return;
    // Arrows move between cards only while no shape is open.
    if (event.key === "ArrowLeft") app.step(-1);
    if (event.key === "ArrowRight") app.step(1);
  }

  /** Closes what was opened last. */
  escape() {
    const { app } = this;
    if (app.editor.isOpen) return app.editor.close();
    if (app.stage.mode === "link" && app.selected && app.linker.key("Escape")) return;
    if (app.selected) $("close").click();
    else if (app.proposals.isOpen) app.proposals.toggle();
  }

  /** Handles a key of a live page; returns whether it has a meaning. */
  everywhere(event) {
    const { app } = this;
    if (event.key === "q") app.attempt(() => app.asker.next());
    else if (event.key === "g") app.actions.suggest();
    else if (event.key === "p") app.proposals.toggle();
    else if (event.key === "k") app.linker.open();
    else if (event.key === "l") app.editor.openSome();
    else if (event.key === "v" && app.changes.newest) app.changes.toggle();
    else return false;
    return true;
  }

  /** Handles a key beside a shape of a live page; returns whether it has a meaning. */
  besideAShape(event) {
    const { app } = this;
    const { mode } = app.stage;
    if (event.key === "y") app.actions.approve();
    else if (event.key === "u") app.actions.doubt();
    else if (mode === "ask") return app.asker.key(event.key);
    else if (mode === "correct") return app.painter.key(event);
    else if (mode === "link") return app.linker.key(event.key);
    else return false;
    return true;
  }
}
