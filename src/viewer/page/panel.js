// Shows the data of the shape on the stage, and the controls for it.

/** Maximum number of lines of the history beside other data; its own view has all. */
const MAX_LINES = 60;

class Panel {
  constructor(app) {
    this.app = app;
    this.root = $("panel");
  }

  /** Shows all data of a shape. */
  async show(name) {
    const { app } = this;
    const shape = app.shape(name);
    if (!shape) return;
    const ticket = (this.ticket = (this.ticket ?? 0) + 1);
    const near = make("div", { className: "near" });
    const log = make("ol", { className: "log" });
    this.mapBox = make("div");
    const state = shape.stale ? ", waits to be relabelled" : "";
    const past = [make("h3", {}, "History"), log];
    const links = app.stage.mode === "link" ? app.linker.section() : [];
    const sections = app.stage.mode === "history" ? past : [
      this.mapBox,
      make("h3", {}, `Parts (${shape.parts.length})`),
      this.parts(shape),
      ...links,
      make("h3", {}, "Most alike"),
      near,
      ...past,
      make("h3", {}, "Mesh"),
      make("div", { className: "facts" }, meshText(shape)),
    ];
    keepingFocus(this.root, () => this.root.replaceChildren(
      make("h2", {}, name),
      make("div", { className: "facts" },
        `${counted(shape.n_polygons, "face")} · labels version ${shape.version}${state}`),
      make("div", { className: "facts", id: "verdict" }, capital(verdictText(shape))),
      app.edit ? this.verdicts() : "",
      ...sections,
    ));
    const [neighbours, events] = await Promise.all([
      app.nearest(name).catch(() => []),
      app.events().catch(() => []),
    ]);
    if (ticket !== this.ticket) return;
    this.neighbours(near, neighbours);
    this.history(log, name, events);
  }

  /** Makes the buttons that give a verdict on the shape. */
  verdicts() {
    const { actions } = this.app;
    const approve = make(
      "button",
      { id: "approve", title: "All labels of this shape are right (y)" },
      make("kbd", { "aria-hidden": "true" }, "y"),
      "Approve",
    );
    approve.onclick = () => actions.approve();
    const doubtful = make(
      "button",
      { id: "doubtful", title: "Some labels of this shape are not right (u)" },
      make("kbd", { "aria-hidden": "true" }, "u"),
      "Doubtful",
    );
    doubtful.onclick = () => actions.doubt();
    return make("div", { className: "give" }, approve, doubtful);
  }

  parts(shape) {
    const { app } = this;
    const list = make("div", { className: "parts" });
    let pressed = null;
    const links = app.stage.mode === "link";
    const largest = Math.max(...shape.parts.map((p) => p.area_share), 1e-9);
    shape.parts.forEach((part, i) => {
      const colour = app.colour(part.label);
      const fill = make("span", { className: "fill" });
      fill.style.width = `${(100 * part.area_share) / largest}%`;
      fill.style.background = css(colour);
      const row = make(
        "button",
        { className: "part", "aria-pressed": "false", "data-label": part.label },
        swatch(colour),
        make("span", {}, links && i < 9 ? make("kbd", {}, String(i + 1)) : null,
          app.labelName(part.label)),
        make("span", { className: "share" }, percent(part.area_share)),
        make("span", { className: "track" }, fill),
      );
      row.title = `part ${i}, mean probability ${part.confidence.toFixed(2)}`;
      const highlight = { part: i, label: part.label, share: part.area_share };
      const lit = () => app.stage.setHighlight(highlight);
      const unlit = () => app.stage.setHighlight(pressed?.highlight ?? null);
      [row.onmouseenter, row.onfocus, row.onmouseleave, row.onblur] = [lit, lit, unlit, unlit];
      if (links && app.linker.isFirst(shape.name, i)) row.setAttribute("aria-pressed", "true");
      row.onclick = () => {
        if (links) return app.linker.pick(shape.name, i);
        if (app.stage.mode === "correct") return app.stage.painting.paintPart(highlight);
        pressed?.row.setAttribute("aria-pressed", "false");
        pressed = pressed?.row === row ? null : { row, highlight };
        pressed?.row.setAttribute("aria-pressed", "true");
        app.stage.setHighlight(pressed?.highlight ?? null);
      };
      list.append(row);
    });
    return list;
  }

  neighbours(box, neighbours) {
    if (neighbours.length === 0)
      box.replaceWith(make("div", { className: "facts" }, "no other shape"));
    for (const [name, distance] of neighbours) {
      const canvas = make("canvas", { "aria-hidden": "true" });
      const button = make("button", { title: `${name}, distance ${distance.toFixed(3)}` }, canvas,
        make("span", {}, name));
      button.onclick = () => this.app.go({ shape: name, detail: null });
      box.append(button);
      if (this.app.portraits.has(name)) this.app.thumbnails.ask(canvas, name);
    }
  }

  /** Lists the events of the shape and of the labels that all shapes share, newest first. */
  history(list, name, events) {
    const { app } = this;
    const lines = [];
    for (const e of [...events].reverse()) {
      const about =
        e.shape === name ? shapeEvent(e) : e.shape === undefined ? labelEvent(e, app) : null;
      if (!about) continue;
      const moves = (e.moves ?? []).filter((m) => m.area_share >= 0.002).slice(0, 6);
      const items = moves.map((m) =>
        make("span", { title: `${app.labelName(m.from)} to ${app.labelName(m.to)}` },
          swatch(app.colour(m.from)), "→", swatch(app.colour(m.to)), percent(m.area_share)));
      lines.push(make("li", { className: about.person ? "person" : "" }, about.text,
        items.length ? make("div", { className: "moves" }, ...items) : null));
      if (lines.length === MAX_LINES && app.stage.mode !== "history") break;
    }
    list.replaceChildren(...lines);
    if (lines.length === 0) list.append(make("li", {}, "nothing yet"));
  }

  /** Shows the controls of the stage's mode. */
  showControls() {
    keepingFocus($("controls"), () => this.controls($("controls")));
  }

  controls(box) {
    const { app } = this;
    const { stage } = app;
    const at = (value) => app.go({ detail: String(value + 1) }, { replace: true });
    this.mapBox?.replaceChildren();
    if (stage.mode === "eigen" && stage.functions)
      box.replaceChildren(
        ...slider(
          "Eigenfunction",
          stage.eigen,
          stage.functions.eigenvalues.length,
          at,
          `${stage.eigen + 1}, λ = ${stage.functions.eigenvalues[stage.eigen].toPrecision(4)}`,
        ),
        bar(DIVERGING),
        make("span", { className: "quiet" }, "− to +, lines of equal value"),
      );
    else if (stage.mode === "hks" && stage.functions)
      box.replaceChildren(
        ...slider(
          "Time",
          stage.time,
          stage.functions.times.length,
          at,
          `t = ${stage.functions.times[stage.time].toPrecision(3)}`,
        ),
        bar(SEQUENTIAL),
        make("span", { className: "quiet" }, "little to much heat left"),
      );
    else if (stage.mode === "map") this.mapControls(box);
    else if (stage.mode === "correct") app.painter.controls(box);
    else if (stage.mode === "ask") app.asker.controls(box);
    else if (stage.mode === "link") app.linker.controls(box);
    else
      box.replaceChildren(
        make(
          "span",
          { className: "quiet" },
          "Drag to turn · scroll to zoom · Shift and drag to move · double-click to start over. " +
            "With keys: Shift and arrows turn, + and − zoom, 0 starts over, " +
              "← and → go to other shapes",
        ),
      );
  }

  mapControls(box) {
    const { stage, source, selected } = this.app;
    const from = make("select", { "aria-label": "Carried from" },
      ...this.app.mapSources(selected).map((name) => make("option", { value: name }, name)));
    from.value = stage.from ?? "";
    from.onchange = () => this.app.go({ detail: from.value });
    const what = make(
      "select",
      { "aria-label": "What the map transfers" },
      make("option", { value: "labels" }, "labels"),
      make("option", { value: "place" }, "colours of places"),
    );
    what.value = stage.transferred;
    what.onchange = () => {
      stage.transferred = what.value;
      stage.refresh();
    };
    box.replaceChildren(make("label", {}, "From", from), make("label", {}, "Carry", what),
      make("span", { className: "quiet" }, source.live ? "" : "maps that are in this file"));
    if (stage.map && stage.map.to === selected) this.heatMap(stage.map);
  }

  heatMap(map) {
    const [rows, columns] = map.c_12.shape;
    const canvas = make("canvas", { className: "heat", role: "img", width: columns, height: rows,
      title: `C, ${rows} × ${columns}: coefficients on ${map.from} to coefficients on ${map.to}`,
      "aria-label": `The matrix of the functional map, ${rows} by ${columns}` });
    const values = numbers(map.c_12);
    const largest = values.reduce((m, v) => Math.max(m, Math.abs(v)), 1e-9);
    const pixels = new ImageData(columns, rows);
    values.forEach((v, i) => {
      const t = Math.sign(v) * Math.sqrt(Math.abs(v) / largest);
      pixels.data.set([...shade(DIVERGING, 0.5 + t / 2), 255], 4 * i);
    });
    canvas.getContext("2d").putImageData(pixels, 0, 0);
    canvas.style.aspectRatio = `${columns} / ${rows}`;
    const q = map.quality;
    const facts = q
      ? [["area of the source that is hit", percent(q.coverage)],
         ["off an isometry, ‖CᵀC − I‖/√k", q.orthogonality.toFixed(2)],
         ["entries near zero", percent(q.near_zero)],
         ["descriptor residual", q.descriptor_residual.toPrecision(3)],
         ["area that something matches", percent(q.matched)],
         ["transferred labels expected to be right", percent(q.confidence)]]
      : [];
    this.mapBox.replaceChildren(
      make("h3", {}, "Functional map"),
      canvas,
      make(
        "div",
        { className: "quality" },
        ...facts.flatMap(([k, v]) => [make("span", {}, k), make("b", {}, v)]),
      ),
    );
  }
}

/** Returns a number with its noun. */
function counted(n, noun) {
  return `${n.toLocaleString("en")} ${noun}${n === 1 ? "" : "s"}`;
}

function slider(text, value, count, changed, shown) {
  const output = make("output", {}, shown);
  const input = make("input", { type: "range", min: 0, max: count - 1, step: 1 });
  input.value = value;
  input.setAttribute("aria-label", text);
  input.oninput = () => changed(Number(input.value));
  const label = make("label", {}, text, input);
  // The slider that is being moved must stay.
  const now = $("controls").querySelector("input[type=range]");
  if (now && now.getAttribute("aria-label") === text && document.activeElement === now) {
    now.oninput = input.oninput;
    return [now.parentElement, output];
  }
  return [label, output];
}

function bar(scale) {
  const element = make("span", { className: "scale" });
  element.style.background = `linear-gradient(90deg, ${scale.map(css).join(", ")})`;
  return element;
}

const CAUSES = {
  reclustering: "the collection was clustered again",
  correction: "corrected by a person",
  carrying: "a correction was propagated here",
  merge: "labels were merged",
  split: "a label was split",
  undo: "a change was undone",
  choice: "a proposal was chosen",
};

function shapeEvent(e) {
  switch (e.kind) {
    case "shape_added": return { text: `added, labels version ${e.version}` };
    case "labels_changed":
      return {
        text: `version ${e.version}: ${CAUSES[e.cause] ?? e.cause}`,
        person: e.cause === "correction",
      };
    case "corrected":
      return {
        text: `${e.n_faces} faces (${percent(e.area_share)}) labelled by hand`,
        person: true,
      };
    default: return null;
  }
}

function labelEvent(e, app) {
  const name = (id) => app.labelName(id);
  switch (e.kind) {
    case "label_named":
      return { text: `label ${e.label} named “${e.name}”`, person: true };
    case "label_merged":
      return { text: `${name(e.from)} merged into ${name(e.into)}`, person: true };
    case "label_split":
      return { text: `${name(e.from)} split`, person: true };
    case "undone":
      return { text: `${e.change} undone`, person: true };
    case "up_changed":
      return { text: `up axis ${e.to} in place of ${e.from}`, person: true };
    case "chosen":
      return { text: `proposal ${e.proposal} chosen, ${e.n_labels} labels`, person: true };
    case "parts_linked": {
      const words = e.demand === "same" ? "has the label of" : "has another label than";
      return { text: `${partText(e.a)} ${words} ${partText(e.b)}: link ${e.link}`, person: true };
    }
    case "parts_unlinked":
      return { text: `link ${e.link} removed`, person: true };
    default:
      return null;
  }
}

function meshText(shape) {
  const r = shape.report ?? {};
  const found = [
    [r.n_components > 1 && r.n_components, "components"],
    [r.n_welded_vertices, "vertices welded"],
    [r.n_degenerate_triangles, "degenerate triangles dropped"],
    [r.n_duplicate_triangles, "duplicate triangles dropped"],
    [r.n_nonmanifold_edges, "non-manifold edges"],
    [r.n_boundary_edges, "boundary edges"],
    [r.n_inner_walls, "inner walls left to those around them"],
    [r.n_bridges, "virtual edges"],
    [r.n_concave_polygons, "concave polygons"],
    [r.n_nonplanar_polygons, "polygons not planar"],
    [r.n_nonsimple_polygons, "polygons that cross themselves or have no area"],
    [r.n_tolerated_statements, "statements that programs differ about read"],
    [r.n_unread_statements, "other statements not read"],
  ]
    .filter(([n]) => n > 0)
    .map(([n, what]) => `${n} ${what}`);
  return `${found.join(", ") || "clean"}; worked on with ${r.n_proxy_faces} faces`;
}
