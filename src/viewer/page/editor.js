// Changes one label: its name, into which other label it is merged, whether it is split. Each
// change says before what it will do, and the shapes show it.

class Editor {
  constructor(app) {
    this.app = app;
    this.root = $("editor");
    this.label = null;
    this.into = null;
    this.root.addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      event.stopPropagation();
      this.close();
    });
  }

  get isOpen() {
    return this.label !== null;
  }

  /** Opens the editor of the label that is shown alone, or painted, or else of the first. */
  openSome() {
    const { app } = this;
    const ids = app.labelsInUse().map((l) => l.id);
    const painted = app.stage.mode === "correct" ? app.stage.painting.label : undefined;
    const label = [app.only, painted, ids[0]].find((id) => ids.includes(id));
    if (label !== undefined) this.open(label);
  }

  open(label) {
    this.label = label;
    this.into = null;
    this.build();
    this.preview();
    this.name.focus();
    this.name.select();
  }

  close(focus = this.label) {
    const { app } = this;
    if (!this.isOpen) return;
    const inside = this.root.contains(document.activeElement);
    [this.label, this.into] = [null, null];
    this.root.hidden = true;
    this.preview();
    if (inside) app.legend.focus(focus);
  }

  /** Shows the present numbers; closes if the label is no longer in use. */
  refresh() {
    if (!this.isOpen || this.busy) return;
    const ids = this.app.labelsInUse().map((l) => l.id);
    if (!ids.includes(this.label)) return this.close();
    if (!ids.includes(this.into)) this.into = null;
    const typed = this.name.value;
    const error = this.error.textContent;
    keepingFocus(this.root, () => this.build());
    this.name.value = typed;
    this.error.textContent = error;
    this.nameChanged();
  }

  /** Returns how many shapes have a label, and its share of the area of all shapes. */
  extent(label) {
    const { shapes } = this.app;
    const shares = shapes.map((s) =>
      s.parts.reduce((sum, p) => sum + (p.label === label ? p.area_share : 0), 0));
    const n = shares.filter((share) => share > 0).length;
    return { n, share: shares.reduce((a, b) => a + b, 0) / Math.max(shapes.length, 1) };
  }

  build() {
    const { app, label } = this;
    const { n, share } = this.extent(label);
    const name = app.labelName(label);
    const of = counted(app.shapes.length, "shape");
    this.error = make("span", { className: "error", role: "alert" });
    const close = make("button", { className: "plain", id: "editor-close", title: "Close (Esc)",
      "aria-label": "Close" }, "✕");
    close.onclick = () => this.close();
    this.root.hidden = false;
    this.root.setAttribute("aria-label", `The label ${name}`);
    this.root.replaceChildren(
      make("div", { className: "about" }, swatch(app.colour(label)), make("b", {}, name),
        make("span", { className: "quiet" }, `on ${n} of ${of}, ${percent(share)} of all area`),
        this.error, make("span", { className: "space" }), close),
      this.nameRow(),
      this.mergeRow(n, share),
      this.splitRow(n, share),
    );
  }

  row(id, controls, text) {
    const note = make("span", { className: "quiet", id: `${id}-effect` }, text);
    for (const control of controls) control.setAttribute("aria-describedby", note.id);
    return make("div", { className: "row" }, ...controls, note);
  }

  nameRow() {
    const { app, label } = this;
    const now = app.labels.get(label)?.name ?? "";
    this.name = make("input", { id: "label-name", value: now, placeholder: `label ${label}`,
      maxLength: 128, "aria-label": "Name of the label", autocomplete: "off" });
    this.name.oninput = () => this.nameChanged();
    this.name.onkeydown = (event) => {
      if (event.key === "Escape") return;
      event.stopPropagation();
      if (event.key !== "Enter") return;
      event.preventDefault();
      if (!this.renaming.disabled) this.renaming.click();
    };
    this.renaming = make("button", { id: "label-rename", disabled: true }, "Rename");
    this.renaming.onclick = () => this.change((actions, fault) =>
      actions.rename(label, this.name.value.trim(), fault));
    return this.row("label-rename", [this.name, this.renaming], this.nameText());
  }

  nameText() {
    const { app, label } = this;
    const name = this.name?.value.trim() ?? "";
    const same = app.labelsInUse().find((l) => l.id !== label && l.name === name && name);
    if (same) return `Another label is called “${name}”: merge this one into it below.`;
    return "The name changes everywhere; no face changes its label.";
  }

  nameChanged() {
    const name = this.name.value.trim();
    const text = this.nameText();
    $("label-rename-effect").textContent = shown(text);
    this.renaming.disabled =
      !name || name === this.app.labels.get(this.label)?.name || text.startsWith("Another");
  }

  mergeRow(n, share) {
    const { app, label } = this;
    const others = app.labelsInUse().filter((l) => l.id !== label);
    const into = make("select", { id: "label-into", "aria-label": "Merge into" },
      make("option", { value: "" }, others.length ? "merge into …" : "no other label"),
      ...others.map((l) => make("option", { value: l.id }, `merge into ${app.labelName(l.id)}`)));
    into.value = this.into ?? "";
    into.disabled = others.length === 0;
    into.onchange = () => {
      this.into = into.value === "" ? null : Number(into.value);
      keepingFocus(this.root, () => this.build());
      this.nameChanged();
      this.preview();
    };
    const merge = make("button", { id: "label-merge", disabled: this.into === null }, "Merge");
    merge.onclick = () =>
      this.change((actions, fault) => actions.merge(label, this.into, fault), this.into);
    const name = app.labelName(label);
    const text = this.into === null
      ? "Both labels become one; choose one to see it on the shapes."
      : `${counted(n, "shape")} will change: ${percent(share)} of all area becomes ` +
        `“${app.labelName(this.into)}”, and “${name}” goes out of use. The shapes show it.`;
    return this.row("label-merge", [into, merge], text);
  }

  splitRow(n, share) {
    const { label } = this;
    const split = make("button", { id: "label-split" }, "Split in two");
    split.onclick = () => this.change((actions, fault) => actions.split(label, fault));
    const text = `Divides it where its pieces differ most, on up to ${counted(n, "shape")} ` +
      `(${percent(share)} of all area, bright below); the smaller half gets a new label. ` +
      "Before and Undo show and take back what it did.";
    return this.row("label-split", [split], text);
  }

  /** Makes a change. Closes if it was made, and otherwise says here why not. */
  async change(make, focus = this.label) {
    if (this.busy) return;
    this.busy = true;
    this.error.textContent = "";
    const fault = (message) => (this.error.textContent = shown(message));
    const done = await make(this.app.actions, fault);
    this.busy = false;
    if (done) this.close(focus);
    else this.refresh();
  }

  /** Colours the shapes as they will be, and shows only those that have the label. */
  preview() {
    const { app, label, into } = this;
    const was = app.preview;
    if (label === null) app.preview = null;
    else app.preview = new Map([[label, app.colour(into ?? label)]]);
    if (into !== null) app.preview?.set(into, app.colour(into));
    if (!was && !app.preview) return;
    app.filter();
    app.recolour();
  }
}
