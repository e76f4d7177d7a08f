// Verdicts on shapes: counts them, shows only the shapes with one of them, and records who gives
// them.

/** Marks of the verdicts. */
const MARKS = { unseen: "○", corrected: "✎", approved: "✓", doubtful: "?" };

class Verdicts {
  constructor(app) {
    this.app = app;
    this.root = $("verdicts");
    this.name = $("reviewer");
    this.name.value = keptSetting("reviewer");
    this.name.onchange = () => keepSetting("reviewer", this.reviewer);
    this.name.onkeydown = (event) => {
      if (event.key === "Enter" || event.key === "Escape") this.name.blur();
      event.stopPropagation();
    };
  }

  /** The name of the person at this page; may be empty. */
  get reviewer() {
    return this.name.value.trim();
  }

  /** Shows how many shapes have each verdict. */
  show() {
    const { app } = this;
    const counts = new Map(VERDICTS.map((v) => [v, 0]));
    for (const shape of app.shapes) counts.set(stateOf(shape), counts.get(stateOf(shape)) + 1);
    const buttons = [...counts].map(([state, n]) => {
      const pressed = app.view.review === state;
      const button = make(
        "button",
        { "data-review": state, "aria-pressed": String(pressed), disabled: n === 0 && !pressed,
          title: pressed ? "Show all shapes again" : `Show only ${state} shapes` },
        make("span", { className: `mark ${state}`, "aria-hidden": "true" }, MARKS[state]),
        make("span", { className: "n" }, String(n)),
        state,
      );
      button.onclick = () => app.go({ review: pressed ? null : state }, { replace: true });
      return button;
    });
    keepingFocus(this.root, () => this.root.replaceChildren(...buttons));
    $("reviewing").hidden = !app.edit;
    this.root.hidden = app.shapes.length === 0;
  }
}

/** Returns the state of a person's verdict on a shape. */
const stateOf = (shape) => shape.review?.state ?? "unseen";

/** Returns who gave a verdict on a shape and when; "" if nobody did. */
function signature({ by, unix_ms: at } = {}) {
  return [by, at ? timeText(at) : ""].filter(Boolean).join(", ");
}

/** Returns a time of today, or the day of another time. */
function timeText(unixMs) {
  const at = new Date(unixMs);
  const today = at.toDateString() === new Date().toDateString();
  const time = { hour: "2-digit", minute: "2-digit", hourCycle: "h23" };
  const day = { day: "numeric", month: "short", year: "numeric" };
  return today ? at.toLocaleTimeString([], time) : at.toLocaleDateString([], day);
}

/** Returns the text of a person's verdict, with name and time. */
function verdictText(shape) {
  const state = stateOf(shape);
  if (state === "unseen") return "nobody has given a verdict";
  const { by } = shape.review;
  return `${state}${by ? " by" : ""} ${signature(shape.review)}`.trim();
}
