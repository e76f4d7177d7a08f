// Lists the labels of the collection: selects the one that is shown alone, or opens its editor.

class Legend {
  constructor(app) {
    this.app = app;
    this.root = $("legend");
  }

  show() {
    const chips = this.app.labelsInUse().map((label) => this.chip(label));
    keepingFocus(this.root, () => this.root.replaceChildren(...chips));
  }

  chip(label) {
    const { app } = this;
    const name = app.labelName(label.id);
    const chosen = app.only === label.id;
    const choose = make(
      "button",
      {
        className: "choose",
        "aria-pressed": String(chosen),
        title: chosen ? "Show all labels again" : "Show only shapes with this label",
      },
      swatch(label.rgb),
      make("span", { className: "text" }, name),
      make("span", { className: "n", title: counted(label.n_shapes, "shape") },
        String(label.n_shapes)),
    );
    choose.onclick = () => app.go({ label: chosen ? null : label.id }, { replace: true });
    const chip = make(
      "span",
      { className: chosen ? "chip chosen" : "chip", "data-label": label.id },
      choose,
    );
    if (app.edit) {
      const title = "Rename, merge or split this label (l)";
      const pencil = make(
        "button",
        { className: "pencil", title, "aria-label": `Rename, merge or split ${name}` },
        "✎",
      );
      pencil.onclick = () => app.editor.open(label.id);
      chip.append(pencil);
    }
    return chip;
  }

  /** Gives the focus to the pencil of a label, or to the first one. */
  focus(label) {
    const pencils = [...this.root.querySelectorAll(".pencil")];
    const mine = this.root.querySelector(`[data-label="${label}"] .pencil`);
    (mine ?? pencils[0])?.focus();
  }
}
