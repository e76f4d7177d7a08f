// Asks a person questions: one part at a time, one key for each answer.

/** Keys of the most likely labels. */
const ANSWER_KEYS = ["1", "2", "3"];

class Asker {
  constructor(app) {
    this.app = app;
    this.question = null;
  }

  /** Returns whether this is the shape that the question is about. */
  asks(shape) {
    return this.question?.shape === shape;
  }

  /**
   * Fetches the next question and goes to its shape; with `stays`, only if the person has not left
   * the questions meanwhile.
   */
  async next(stays = false) {
    const { app } = this;
    const question = await app.source.question(app.name);
    if (stays && app.stage.mode !== "ask") return;
    this.question = { ...question, faces: new Set(question.faces) };
    if (app.selected === question.shape && app.stage.mode === "ask") {
      app.stage.faceQuestion();
      app.stage.colour();
      app.stage.draw();
      app.panel.showControls();
    } else await app.go({ shape: question.shape, view: "ask", detail: null });
    $("controls").dataset.question = `${question.shape}:${question.part}`;
  }

  /**
   * Sends an answer and fetches the next question: `{label}`, `{named}`, `{skip}` or
   * `{cut_wrongly}`.
   */
  answer(answer) {
    const { app, question } = this;
    if (!question || this.busy) return;
    this.busy = true;
    return app.attempt(async () => {
      try {
        const body = {
          collection: app.name,
          shape: question.shape,
          part: question.part,
          ...answer,
        };
        if (answer.skip || answer.cut_wrongly) await app.source.change("answer", body);
        else await app.changes.inTurn(() => app.changes.send("answer", body));
        await this.next(true);
      } finally {
        this.busy = false;
      }
      // Meanwhile the next question can be answered.
      await app.reload();
    });
  }

  controls(box) {
    const { app, question } = this;
    if (!question || !this.asks(app.selected)) {
      const ask = make("button", { className: "primary", id: "ask-here" }, "Ask the next question");
      ask.onclick = () => app.attempt(() => this.next());
      return box.replaceChildren(
        ask,
        make("span", { className: "quiet" }, "the part whose label is worth most comes first"),
      );
    }
    const buttons = question.likeliest.map((offered, i) => {
      const button = make(
        "button",
        { "data-answer": i + 1, title: `${percent(offered.probability)} probable` },
        make("kbd", {}, ANSWER_KEYS[i]),
        swatch(app.colour(offered.label)),
        app.labelName(offered.label),
      );
      button.onclick = () => this.answer({ label: offered.label });
      return button;
    });
    const name = make("input", {
      placeholder: "another label, or a new one",
      maxLength: 128,
      "aria-label": "Name of the label",
      id: "ask-name",
    });
    name.setAttribute("list", "ask-names");
    const names = make("datalist", { id: "ask-names" },
      ...app.labelsInUse().filter((l) => l.name).map((l) => make("option", { value: l.name })));
    name.onkeydown = (event) => {
      event.stopPropagation();
      if (event.key === "Escape") name.blur();
      if (event.key !== "Enter" || !name.value.trim()) return;
      event.preventDefault();
      name.blur();
      this.answer({ named: name.value.trim() });
    };
    const skip = make("button", { id: "ask-skip" }, make("kbd", {}, "s"), "Skip");
    skip.onclick = () => this.answer({ skip: true });
    const cut = make("button", { id: "ask-cut" }, make("kbd", {}, "x"), "Cut wrongly");
    cut.onclick = () => this.answer({ cut_wrongly: true });
    box.replaceChildren(
      make("span", {}, `Which label does the bright part have? (${question.n_answered} answered)`),
      question.isHidden ? make("span", { className: "quiet" }, "It is inside, out of sight.") : "",
      make("div", { className: "palette" }, ...buttons),
      make("label", {}, make("kbd", {}, "n"), name),
      names,
      skip,
      cut,
    );
  }

  /** Handles a key; returns whether it has a meaning here. */
  key(key) {
    if (!this.asks(this.app.selected)) return false;
    const offered = this.question.likeliest[ANSWER_KEYS.indexOf(key)];
    if (offered) this.answer({ label: offered.label });
    else if (key === "n") $("ask-name")?.focus();
    else if (key === "s") this.answer({ skip: true });
    else if (key === "x") this.answer({ cut_wrongly: true });
    else return false;
    return true;
  }
}
