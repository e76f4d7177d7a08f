// The controls for painting: tool, size, label, and what is painted.

/** Tools with their keys and names. */
const TOOLS = [
  ["brush", "b", "Brush"],
  ["part", "f", "Fill a part"],
  ["eraser", "e", "Eraser"],
];
/** Factor by which a key changes the size of the brush. */
const SIZE_STEP = 1.25;

class Painter {
  constructor(app) {
    this.app = app;
  }

  get painting() {
    return this.app.stage.painting;
  }

  controls(box) {
    const { app, painting } = this;
    const ids = app.labelsInUse().map((l) => l.id);
    const fresh = Math.max(-1, ...app.labels.keys()) + 1;
    this.choices = [...ids, fresh];
    if (!this.choices.includes(painting.label)) painting.label = this.choices[0];
    this.makeActions();
    box.replaceChildren(
      make("div", { className: "tools", role: "group", "aria-label": "Tool" }, ...this.tools()),
      make("label", {}, "Size", this.size()),
      make(
        "div",
        { className: "palette", role: "group", "aria-label": "Label to paint" },
        ...this.choices.map((id) => this.choice(id, id === fresh)),
      ),
      make("span", { className: "ends" }, this.amount, this.discard, this.apply),
    );
    this.paintedChanged();
  }

  tools() {
    const { painting } = this;
    return TOOLS.map(([tool, key, name]) => {
      const pressed = String(painting.tool === tool);
      const button = make(
        "button",
        { "aria-pressed": pressed, "data-tool": tool, title: `${name} (${key})` },
        make("kbd", { "aria-hidden": "true" }, key),
        name,
      );
      button.onclick = () => this.choose({ tool });
      return button;
    });
  }

  size() {
    const { painting } = this;
    const [min, max] = BRUSH_SIZES;
    const size = make("input", {
      type: "range",
      min,
      max,
      step: 0.01,
      value: painting.brushSize,
      disabled: painting.tool === "part",
      title: "Size of the brush ([ and ])",
      "aria-label": "Size of the brush",
    });
    size.oninput = () => {
      painting.brushSize = Number(size.value);
      this.app.pointer.showCursor();
    };
    return size;
  }

  choice(label, isFresh) {
    const { app, painting } = this;
    const key = this.choices.indexOf(label) + 1;
    const button = make(
      "button",
      { "aria-pressed": String(painting.label === label), "data-label": label },
      key < 10 ? make("kbd", { "aria-hidden": "true" }, String(key)) : null,
      swatch(app.colour(label)),
      isFresh ? "new label" : app.labelName(label),
    );
    if (isFresh) button.title = `Paint with a label that no shape has yet, label ${label}`;
    button.onclick = () => this.choose({ label });
    return button;
  }

  makeActions() {
    const { app, painting } = this;
    this.apply = make("button", { className: "primary", id: "apply" }, "Apply");
    this.apply.title = "Send what is painted, and let the other shapes follow (Enter)";
    this.apply.onclick = () => app.actions.correct();
    this.discard = make("button", { id: "discard" }, "Discard");
    this.discard.title = "Erase all that is painted";
    this.discard.onclick = () => painting.discard();
    this.amount = make("span", { className: "quiet", id: "amount", role: "status" });
  }

  /** Chooses a tool or a label. */
  choose(chosen) {
    Object.assign(this.painting, chosen);
    this.app.panel.showControls();
    this.app.pointer.showCursor();
  }

  /** Handles a key; returns whether it has a meaning here. */
  key(event) {
    const { app, painting } = this;
    const { key } = event;
    const tool = TOOLS.find((t) => t[1] === key)?.[0];
    const label = /^[1-9]$/.test(key) ? this.choices?.[Number(key) - 1] : undefined;
    const factor = { "[": 1 / SIZE_STEP, "]": SIZE_STEP }[key];
    if (tool) this.choose({ tool });
    else if (label !== undefined) this.choose({ label });
    else if (factor) {
      painting.resize(factor);
      this.choose({});
    } else if (key === "Enter" && painting.size && event.target === app.stage.canvas)
      app.actions.correct();
    else return false;
    return true;
  }

  /** Shows how much is painted, and what can be done with it. */
  paintedChanged() {
    const n = this.painting.size;
    this.app.changes.showButtons();
    if (!this.apply) return;
    this.apply.disabled = this.discard.disabled = n === 0;
    const text = n
      ? `${counted(n, "face")} painted`
      : "paint on the shape, or press its parts in the list; drag beside it to turn";
    if (this.amount.textContent !== text) this.amount.textContent = text;
  }
}
