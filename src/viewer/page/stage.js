// Shows one shape, large: rotates it, colours it, and lets a person correct it.

/** Maximum number of triangles of a sent mesh that is shown instead of the proxy. */
const MAX_SURFACE = 120_000;
/**
 * Share of transferred labels that are expected to be right, below which a map is shown with a
 * warning: one face in four is wrong. This holds for the poorest fifth of the maps between shapes
 * of one class, which transfer 0.73 of the area correctly; the label model alone has 0.89
 * (docs/maps.md).
 */
const POOR_MAP = 0.75;
/** Share of its box that a shape fills. */
const ROOM = 0.88;

class Stage {
  constructor(app) {
    this.app = app;
    this.canvas = $("scene");
    this.view = new View();
    this.mode = "labels";
    this.eigen = 0;
    this.time = null;
    this.transferred = "labels";
    this.brush = { label: null, size: 0.1, tool: "brush" };
    this.painted = new Strokes();
    this.listen();
  }

  get renderer() {
    return (this._renderer ??= new Renderer(this.canvas));
  }

  /** Shows a shape in its first view. Resolves when everything that the mode needs is drawn. */
  async show(name) {
    this.name = name;
    this.painted.clear();
    this.highlight = null;
    this.fitted = false;
    await this.refresh();
  }

  /** Selects the view and the detail of an address. */
  choose({ view, detail }) {
    if (this.mode !== view) {
      this.highlight = null;
      this.functions = this.map = null;
    }
    this.mode = view;
    const at = /^\d+$/.test(detail ?? "") ? Math.max(Number(detail) - 1, 0) : null;
    if (view === "map") this.from = detail;
    if (view === "eigen") this.eigen = at ?? this.eigen;
    if (view === "hks") this.time = at ?? this.time;
  }

  close() {
    this.name = null;
    this.drop();
  }

  drop() {
    for (const scene of this.scenes ?? []) this.renderer.remove(scene.uploaded);
    this.scenes = [];
  }

  notice(text) {
    $("notice").textContent = text;
    $("notice").hidden = !text;
  }

  /** Shows a warning about the view. */
  advise(text) {
    $("advice").textContent = text;
    $("advice").hidden = !text;
  }

  /** Fetches and shows the data of shape and mode. A later call cancels an earlier one. */
  async refresh() {
    const ticket = (this.ticket = (this.ticket ?? 0) + 1);
    const { app, name, mode } = this;
    const portrait = app.portraits.get(name);
    if (!portrait) {
      this.notice("This shape is not loaded yet.");
      return;
    }
    this.notice("");
    this.advise("");
    $("loading").hidden = false;
    try {
      const scenes = await this.build(mode, name, portrait, ticket);
      if (ticket === this.ticket) this.present(scenes);
    } catch (error) {
      if (ticket !== this.ticket) return;
      this.present([{ mesh: new Mesh(portrait, app.up), caption: name }]);
      this.notice(error.message);
    } finally {
      if (ticket === this.ticket) {
        $("loading").hidden = true;
        app.panel.showControls();
        $("stage").dataset.shown = `${name} ${mode}`;
      }
    }
  }

  async build(mode, name, portrait, ticket) {
    const { app } = this;
    const proxy = new Mesh(portrait, app.up);
    const before = app.changes.before(name);
    if (before && mode === "labels")
      return [{ mesh: new Mesh(before, app.up), caption: name, note: "before the last change" }];
    if (mode === "labels" || mode === "history" || mode === "correct" || mode === "ask") {
      const info = app.shape(name);
      const fine = app.source.live && info.n_polygons <= MAX_SURFACE;
      if (!fine && mode === "correct")
        throw new Error(
          `With ${info.n_polygons} faces this shape is corrected with “coseg correct”.`,
        );
      if (!fine && mode === "ask")
        throw new Error(
          `With ${info.n_polygons} faces this shape is asked about with “coseg ask --png FILE”.`,
        );
      if (!fine) return [{ mesh: proxy, caption: name, note: this.resolution(portrait, info) }];
      // The proxy appears at once, the sent mesh as soon as it is loaded.
      if (!this.scenes?.some((s) => s.mesh.portrait.name === name))
        this.present([{ mesh: proxy, caption: name }]);
      const surface = await app.surface(name);
      if (ticket !== this.ticket) return [];
      return [
        {
          mesh: new Mesh(surface, app.up),
          caption: name,
          note: `${info.n_polygons} faces, as sent`,
        },
      ];
    }
    if (mode === "map") return this.buildMap(name, proxy);
    const functions = await app.functions(name);
    this.functions = functions;
    const scene = { mesh: proxy, caption: name };
    if (mode === "eigen") {
      this.eigen = Math.min(this.eigen, functions.eigenvalues.length - 1);
      const values = column(functions.eigenvectors, this.eigen);
      const largest = values.reduce((m, v) => Math.max(m, Math.abs(v)), 1e-12);
      scene.values = values.map((v) => v / largest);
      scene.colours = vertexColours(proxy, (v) => shade(DIVERGING, 0.5 + scene.values[v] / 2));
      scene.contours = 5;
      scene.note = `eigenfunction ${this.eigen + 1}`;
    } else {
      this.time = Math.min(
        this.time ?? Math.floor(functions.times.length / 3),
        functions.times.length - 1,
      );
      const values = column(functions.hks, this.time);
      const sorted = Float32Array.from(values).sort();
      const [low, high] = [sorted[0], sorted[Math.floor(0.98 * (sorted.length - 1))]];
      scene.values = values.map((v) => (v - low) / (high - low || 1));
      scene.colours = vertexColours(proxy, (v) => shade(SEQUENTIAL, scene.values[v]));
      scene.note = `heat kernel signature at t = ${functions.times[this.time].toPrecision(3)}`;
    }
    return [scene];
  }

  async buildMap(name, proxy) {
    const { app } = this;
    const sources = app.mapSources(name);
    if (sources.length === 0)
      throw new Error(
        app.source.live
          ? "A map needs a second shape."
          : "No map to this shape is in this file. Write it with --maps N to have more.",
      );
    const missing = this.from && !sources.includes(this.from) ? this.from : null;
    if (!sources.includes(this.from)) this.from = sources[0];
    const map = (this.map = await app.map(this.from, name));
    const right = map.quality?.confidence ?? 1;
    if (missing)
      this.advise(`There is no map from “${missing}” here; this one is from “${this.from}”.`);
    if (right < POOR_MAP)
      this.advise(
        `This map is poor: ${percent(right)} of the labels that it transfers are expected ` +
          "to be right. Do not build on it; another shape under “From” may fit better.",
      );
    const source = new Mesh(app.portraits.get(this.from), app.up);
    const colour = this.transferred === "labels" ? labelColours(source, app) : placeColours(source);
    const back = map.p2p_21.data;
    return [
      {
        mesh: source,
        caption: this.from,
        note: "from this shape",
        colours: vertexColours(source, colour),
        plain: true,
      },
      {
        mesh: proxy,
        caption: name,
        note: `mapped to this one, ${percent(right)} right as expected`,
        colours: vertexColours(proxy, (v) => colour(back[v])),
        plain: true,
      },
    ];
  }

  resolution(portrait, info) {
    const shown = portrait.labels.data.length;
    return shown === info.n_polygons
      ? `${shown} faces`
      : `working resolution: ${shown} of ${info.n_polygons} faces`;
  }

  /** Sets the meshes that are drawn. */
  present(scenes) {
    if (scenes.length === 0) return;
    this.drop();
    this.scenes = scenes;
    for (const scene of scenes) {
      scene.uploaded = this.renderer.upload(scene.mesh);
      if (scene.values)
        this.renderer.update(
          scene.uploaded,
          "value",
          Float32Array.from(scene.mesh.faces, (v) => scene.values[v]),
        );
    }
    this.colour();
    $("captions").replaceChildren(
      ...scenes.map((s) => make("div", {}, s.caption, s.note ? make("small", {}, s.note) : null)),
    );
    this.resize();
    if (!this.fitted) this.fit();
    else if (!this.moved) this.fill();
    this.draw();
  }

  /** Returns to the first view of a shape. */
  fit() {
    this.fitted = true;
    const turned = new View();
    Object.assign(this.view, { yaw: turned.yaw, pitch: turned.pitch });
    this.fill();
  }

  /** Scales the shape to the available room in the present direction. */
  fill() {
    this.moved = false;
    this.view.box = [0, 0, this.canvas.width / this.scenes.length, this.canvas.height];
    this.view.fit(this.scenes.map((scene) => scene.mesh));
    // The room below the captions.
    const captions = $("captions");
    const taken =
      (captions.offsetTop + captions.offsetHeight) / Math.max(this.canvas.clientHeight, 1);
    const room = Math.max(Math.min(ROOM, 1 - taken), 0.4);
    this.view.zoom *= room;
    const [x, y] = this.view.pan;
    this.view.pan = [x * room, y * room - 2 * Math.max(taken - (1 - room) / 2, 0)];
  }

  /** Returns the label of each face, including painted labels. */
  paintedLabels(mesh) {
    if (this.painted.size === 0 || !mesh.polygons) return mesh.labels;
    return mesh.labels.map((label, f) => this.painted.labels.get(mesh.polygons[f]) ?? label);
  }

  colour() {
    const { app, renderer, highlight } = this;
    for (const { mesh, uploaded, colours, plain, values } of this.scenes) {
      if (colours) {
        renderer.update(uploaded, "colour", colours);
        if (plain || values)
          renderer.update(uploaded, "border", new Uint8Array(4 * uploaded.nCorners).fill(255));
        continue;
      }
      const labels = this.paintedLabels(mesh);
      const dim = (c) => c.map((x) => 0.2 * x + 0.8 * 178);
      const lit = this.asked(mesh) ?? this.highlighted(mesh, highlight);
      const of = (f) => {
        const c = app.shownColour(labels[f]);
        return !lit || lit(f) ? c : dim(c);
      };
      renderer.update(uploaded, "colour", faceColours(mesh.nFaces, of));
      renderer.update(uploaded, "border", mesh.borders(labels));
    }
  }

  /** Returns which faces of a mesh the question is about. */
  asked(mesh) {
    const { asker } = this.app;
    if (this.mode !== "ask" || !mesh.polygons || !asker.asks(this.name)) return null;
    return (f) => asker.question.faces.has(mesh.polygons[f]);
  }

  /** Returns which faces of a mesh a highlighted part or label covers. */
  highlighted(mesh, highlight) {
    if (!highlight) return null;
    if (mesh.parts && highlight.part !== undefined) return (f) => mesh.parts[f] === highlight.part;
    if (highlight.part === undefined) return (f) => mesh.labels[f] === highlight.label;
    // The sent mesh has no parts of its own. Among the pieces of the label, this takes the one with
    // about the same share of the area.
    const pieces = mesh.pieces ?? (mesh.pieces = piecesOf(mesh));
    let best = null;
    for (const piece of pieces)
      if (piece.label === highlight.label) {
        const off = Math.abs(piece.share - highlight.share);
        if (!best || off < best.off) best = { off, piece };
      }
    const faces = best?.piece.faces;
    return faces ? (f) => faces.has(f) : () => false;
  }

  setHighlight(highlight) {
    this.highlight = highlight;
    if (!this.scenes?.length || this.mode === "map") return;
    this.colour();
    this.draw();
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(this.canvas.clientWidth * ratio), 1);
    const height = Math.max(Math.round(this.canvas.clientHeight * ratio), 1);
    if (this.canvas.width !== width || this.canvas.height !== height)
      [this.canvas.width, this.canvas.height] = [width, height];
  }

  draw() {
    if (this.drawing) return;
    this.drawing = requestAnimationFrame(() => {
      this.drawing = null;
      if (!this.scenes?.length) return;
      this.resize();
      this.renderer.clear();
      const width = this.canvas.width / this.scenes.length;
      this.scenes.forEach(({ uploaded, contours, values, plain }, i) => {
        this.view.box = [Math.round(i * width), 0, Math.round(width), this.canvas.height];
        this.renderer.draw(uploaded, this.view, {
          contours: contours ?? 0,
          lines: values || plain ? 0 : 1.4,
        });
      });
    });
  }

  /** Returns the face and the mesh at a position of the page. */
  pick(event) {
    if (!this.scenes?.length) return null;
    const box = this.canvas.getBoundingClientRect();
    const ratio = this.canvas.width / box.width;
    const x = (event.clientX - box.left) * ratio;
    const y = (event.clientY - box.top) * ratio;
    const width = this.canvas.width / this.scenes.length;
    const at = Math.min(Math.floor(x / width), this.scenes.length - 1);
    const scene = this.scenes[at];
    this.view.box = [at * width, 0, width, this.canvas.height];
    const found = scene.mesh.pick(this.view, x - at * width, y);
    return found && { ...found, scene };
  }

  listen() {
    const { canvas, view } = this;
    let drag = null;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const shift = event.shiftKey || event.button === 2;
      if (this.mode === "correct") this.painted.begin();
      const paint = this.mode === "correct" && !shift && !event.altKey && this.paint(event);
      drag = { x: event.clientX, y: event.clientY, shift, paint };
      if (!paint) this.painted.open = null;
      if (!paint) canvas.classList.add("turning");
    });
    canvas.addEventListener("pointermove", (event) => {
      this.moveCursor(event);
      if (!drag) return this.hover(event);
      if (drag.paint) return void this.paint(event);
      const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
      [drag.x, drag.y] = [event.clientX, event.clientY];
      if (drag.shift) {
        this.moved = true;
        view.pan[0] += (2 * dx * this.scenes.length) / canvas.clientWidth;
        view.pan[1] -= (2 * dy) / canvas.clientHeight;
      } else {
        view.yaw -= dx * 0.009;
        view.pitch = Math.min(Math.max(view.pitch + dy * 0.009, -1.5), 1.5);
      }
      this.draw();
    });
    const end = () => {
      if (drag?.paint) this.painted.end();
      drag = null;
      this.app.panel.paintedChanged();
      canvas.classList.remove("turning");
    };
    canvas.addEventListener("pointerup", end);
    canvas.addEventListener("pointercancel", end);
    canvas.addEventListener("pointerleave", () => ($("hint").hidden = $("cursor").hidden = true));
    canvas.addEventListener("dblclick", () => {
      if (this.mode === "correct" || !this.scenes?.length) return;
      this.fit();
      this.draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * 0.0012));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.altKey || event.metaKey || !this.scenes?.length) return;
      const zoom = { "+": 1.15, "=": 1.15, "-": 1 / 1.15 }[event.key];
      if (zoom) return this.zoom(zoom);
      if (event.key === "0") {
        this.fit();
        return this.draw();
      }
      const arrow =
        event.shiftKey && event.key.startsWith("Arrow") ? event.key.slice(5) : event.key;
      const step = { a: [-0.15, 0], d: [0.15, 0], w: [0, 0.1], s: [0, -0.1],
        Left: [-0.15, 0], Right: [0.15, 0], Up: [0, 0.1], Down: [0, -0.1] }[arrow];
      if (!step) return;
      event.preventDefault();
      view.yaw += step[0];
      view.pitch = Math.min(Math.max(view.pitch + step[1], -1.5), 1.5);
      this.draw();
    });
    new ResizeObserver(() => {
      this.resize();
      if (this.scenes?.length && !this.moved) this.fill();
      this.draw();
    }).observe(canvas);
  }

  zoom(factor) {
    const { view } = this;
    this.moved = true;
    view.zoom = Math.min(Math.max(view.zoom * factor, 0.2), 30);
    view.pan = view.pan.map((p) => p * factor);
    this.draw();
  }

  /** Shows the size of the brush at the pointer. */
  moveCursor(event) {
    const cursor = $("cursor");
    const shown = this.mode === "correct" && this.brush.tool !== "part" && this.pick(event);
    cursor.hidden = !shown;
    if (!shown) return;
    const box = this.canvas.getBoundingClientRect();
    // The same factor as in View.scale.
    const pixels = 0.9 * this.reach() * this.view.zoom * Math.min(box.width, box.height);
    Object.assign(cursor.style, {
      left: `${event.clientX - box.left}px`,
      top: `${event.clientY - box.top}px`,
      width: `${pixels}px`,
      height: `${pixels}px`,
    });
  }

  /** Returns the radius of the brush in units of the shape. */
  reach() {
    return this.brush.size / Math.max(this.view.zoom, 0.5);
  }

  hover(event) {
    const hint = $("hint");
    const shown = this.scenes?.[0]?.mesh;
    const found = shown && shown.nFaces <= 30_000 && this.pick(event);
    hint.hidden = !found;
    if (!found) return;
    const { mesh, values } = found.scene;
    const box = this.canvas.getBoundingClientRect();
    hint.style.left = `${Math.min(event.clientX - box.left + 14, box.width - 150)}px`;
    hint.style.top = `${event.clientY - box.top + 14}px`;
    if (values) {
      const value = values[mesh.faces[3 * found.face]];
      hint.replaceChildren(value.toFixed(2));
    } else {
      const label = this.paintedLabels(mesh)[found.face];
      hint.replaceChildren(swatch(this.app.colour(label)), this.app.labelName(label));
    }
  }

  /**
   * Paints at the pointer. Returns false if the pointer is not on the shape, or no label is
   * selected.
   */
  paint(event) {
    const { brush } = this;
    const found = brush.label !== null && this.pick(event);
    if (!found) return false;
    const { mesh } = found.scene;
    let faces;
    if (brush.tool === "part") {
      const labels = this.paintedLabels(mesh);
      const label = labels[found.face];
      faces = mesh.flood(found.face, (f) => labels[f] === label);
    } else {
      const reach = this.reach();
      const near = (f) => Math.hypot(...mesh.centre(f).map((x, i) => x - found.point[i])) < reach;
      faces = mesh.flood(found.face, near);
    }
    for (const f of faces)
      this.painted.paint(mesh.polygons[f], brush.tool === "eraser" ? null : brush.label);
    this.colour();
    this.draw();
    this.app.panel.paintedChanged();
    return true;
  }

  /** Paints a part of the list: does without a mouse what the brush does. */
  paintPart(highlight) {
    const mesh = this.scenes?.[0]?.mesh;
    if (!mesh?.polygons || this.brush.label === null) return;
    const covers = this.highlighted(mesh, highlight);
    this.painted.begin();
    for (let f = 0; f < mesh.nFaces; f++)
      if (covers(f)) this.painted.paint(mesh.polygons[f], this.brush.label);
    this.painted.end();
    this.colour();
    this.draw();
    this.app.panel.paintedChanged();
  }

  discard() {
    this.painted.clear();
    this.repaint();
  }

  /** Undoes or repeats a stroke. Returns false if there is none. */
  stroke(redo) {
    const moved = redo ? this.painted.redo() : this.painted.undo();
    if (moved) this.repaint();
    return moved;
  }

  repaint() {
    this.colour();
    this.draw();
    this.app.panel.paintedChanged();
  }

  /** Returns runs of polygons with the same painted label: first, count, label. */
  runs() {
    const runs = [];
    const { labels } = this.painted;
    for (const polygon of [...labels.keys()].sort((a, b) => a - b)) {
      const label = labels.get(polygon);
      const last = runs.at(-1);
      if (last && last[0] + last[1] === polygon && last[2] === label) last[1]++;
      else runs.push([polygon, 1, label]);
    }
    return runs;
  }
}

/** Returns connected pieces of equal label, with their shares of the area. */
function piecesOf(mesh) {
  const { nFaces, labels } = mesh;
  const normals = mesh.faceNormals;
  const area = (f) => Math.hypot(normals[3 * f], normals[3 * f + 1], normals[3 * f + 2]);
  const seen = new Uint8Array(nFaces);
  const pieces = [];
  let all = 0;
  for (let f = 0; f < nFaces; f++) {
    all += area(f);
    if (seen[f]) continue;
    const faces = new Set(mesh.flood(f, (g) => labels[g] === labels[f]));
    let sum = 0;
    for (const g of faces) {
      seen[g] = 1;
      sum += area(g);
    }
    pieces.push({ label: labels[f], share: sum, faces });
  }
  for (const piece of pieces) piece.share /= all || 1;
  return pieces;
}

/** Returns the colour of each vertex: that of the labels around it. */
function labelColours(mesh, app) {
  const of = new Int32Array(mesh.positions.length / 3).fill(-1);
  for (let c = 0; c < mesh.faces.length; c++) of[mesh.faces[c]] = mesh.labels[(c / 3) | 0];
  return (v) => app.colour(of[v]);
}

/** Returns the colour of each vertex by its position, so that the map's targets can be seen. */
function placeColours(mesh) {
  const p = mesh.positions;
  const low = [1, 1, 1];
  const high = [-1, -1, -1];
  for (let i = 0; i < p.length; i++) {
    low[i % 3] = Math.min(low[i % 3], p[i]);
    high[i % 3] = Math.max(high[i % 3], p[i]);
  }
  return (v) =>
    [0, 1, 2].map((i) => 40 + (205 * (p[3 * v + i] - low[i])) / (high[i] - low[i] || 1));
}
