// Lists the labels of the collection: names them, and selects the one that is shown alone.

class Legend {
  constructor(app) {
    this.app = app;
    this.root = $("legend");
  }

  show() {
    // A name that is being typed must stay.
    if (this.root.querySelector("input")) return;
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
        title: "Show only shapes with this label",
      },
      swatch(label.rgb),
      make("span", { className: "text" }, name),
      make("span", { className: "n" }, String(label.n_shapes)),
    );
    choose.onclick = () => app.go({ label: chosen ? null : label.id }, { replace: true });
    const chip = make(
      "span",
      { className: chosen ? "chip chosen" : "chip", "data-label": label.id },
      choose,
    );
    if (app.edit) {
      const pencil = make(
        "button",
        { className: "pencil", title: "Rename", "aria-label": `Rename ${name}` },
        "✎",
      );
      pencil.onclick = () => this.rename(chip, label);
      chip.append(pencil);
    }
    return chip;
  }

  rename(chip, label) {
    const { app } = this;
    const input = make("input", {
      value: label.name ?? "",
      placeholder: `label ${label.id}`,
      maxLength: 128,
      "aria-label": "Name of the label",
    });
    const choose = chip.querySelector(".choose");
    choose.replaceWith(input);
    input.focus();
    input.select();
    let over = false;
    const end = async (keep, byKey) => {
      if (over) return;
      over = true;
      const name = input.value.trim();
      input.replaceWith(choose);
      if (byKey) chip.querySelector(".pencil").focus();
      if (!keep || !name || name === label.name) return;
      await app.attempt(async () => {
        await app.source.change("name", { collection: app.name, label: label.id, name });
        await app.reload();
        app.toast(`Label ${label.id} is “${name}” now.`);
      });
    };
    input.onkeydown = (event) => {
      event.stopPropagation();
      if (event.key !== "Enter" && event.key !== "Escape") return;
      // Otherwise the key would press the pencil, which gets the focus next.
      event.preventDefault();
      end(event.key === "Enter", true);
    };
    input.onblur = () => end(true, false);
  }
}
