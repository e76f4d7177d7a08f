// Shows one shape, large, in the colours of a view.

/** Maximum number of triangles of a sent mesh that is shown instead of the proxy. */
const MAX_SURFACE = 120_000;
/**
 * Share of transferred labels that are expected to be right, below which a map is shown with a
 * warning: one face in four is wrong. This holds for the poorest fifth of the maps between shapes
 * of one class, which transfer 0.73 of the area correctly; the label model alone has 0.89
 * (docs/maps.md).
 */
const POOR_MAP = 0.75;
/** Directions that are tried to show a part: so many around the shape. */
const N_TURNS = 12;
const TURN_ALL = 2 * Math.PI;
/** Tilts that are tried besides the present one: from above, into what is open, and from below. */
const TILTS = [1.1, -0.7];
/** Views that show labels. */
const LABEL_VIEWS = ["labels", "history", "correct", "ask"];
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
    this.painting = new Painting(this);
    this.listen();
  }

  get renderer() {
    return (this._renderer ??= new Renderer(this.canvas));
  }

  /** Shows a shape in its first view. Resolves when everything that the mode needs is drawn. */
  async show(name) {
    this.name = name;
    this.painting.forget();
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
    if (LABEL_VIEWS.includes(mode)) return this.buildLabels(name, portrait, ticket);
    const proxy = new Mesh(portrait, this.app.up);
    if (mode === "map") return this.buildMap(name, proxy);
    if (mode === "link") return this.buildLink(name, proxy);
    return [await this.buildFunction(mode, name, proxy)];
  }

  async buildLabels(name, portrait, ticket) {
    const { app, mode } = this;
    const before = this.painting.size === 0 && app.changes.before(name);
    if (before) {
      const surface = await app.surfaceAt(name, before.version);
      const mesh = new Mesh(surface ?? before, app.up);
      return [{ mesh, caption: name, note: "before the last change" }];
    }
    const info = app.shape(name);
    const proxy = new Mesh(portrait, app.up);
    const fine = app.source.live && info.n_polygons <= MAX_SURFACE;
    const otherwise = {
      correct: "is corrected with “coseg correct”",
      ask: "is asked about with “coseg ask --png FILE”",
    }[mode];
    if (!fine && otherwise)
      throw new Error(`With ${info.n_polygons} faces this shape ${otherwise}.`);
    if (!fine) return [{ mesh: proxy, caption: name, note: this.resolution(portrait, info) }];
    // The proxy appears at once, the sent mesh as soon as it is loaded.
    if (!this.scenes?.some((s) => s.mesh.portrait.name === name))
      this.present([{ mesh: proxy, caption: name }]);
    const surface = await app.surface(name);
    if (ticket !== this.ticket) return [];
    const note = `${counted(info.n_polygons, "face")}, as sent`;
    return [{ mesh: new Mesh(surface, app.up), caption: name, note }];
  }

  /**
   * Shows the parts of the proxy, which are those that the daemon knows. A part of another shape
   * that is chosen already is shown beside it.
   */
  buildLink(name, mesh) {
    const { app } = this;
    const { first } = app.linker;
    const scene = { mesh, caption: name, note: "click a part" };
    const portrait = first && first.shape !== name && app.portraits.get(first.shape);
    if (!portrait) return [scene];
    const note = `part ${first.part} is chosen`;
    return [{ mesh: new Mesh(portrait, app.up), caption: first.shape, note }, scene];
  }

  async buildFunction(mode, name, mesh) {
    const functions = (this.functions = await this.app.functions(name));
    const scene = { mesh, caption: name };
    if (mode === "eigen") {
      this.eigen = Math.min(this.eigen, functions.eigenvalues.length - 1);
      const values = column(functions.eigenvectors, this.eigen);
      const largest = values.reduce((m, v) => Math.max(m, Math.abs(v)), 1e-12);
      scene.values = values.map((v) => v / largest);
      scene.colours = vertexColours(mesh, (v) => shade(DIVERGING, 0.5 + scene.values[v] / 2));
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
      scene.colours = vertexColours(mesh, (v) => shade(SEQUENTIAL, scene.values[v]));
      scene.note = `heat kernel signature at t = ${functions.times[this.time].toPrecision(3)}`;
    }
    return scene;
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
    this.faceQuestion();
    this.draw();
  }

  /** Turns the shape so that the part that the question is about can be seen, once for each. */
  faceQuestion() {
    const { question } = this.app.asker;
    const { mesh } = this.scenes[0];
    const asked = this.asked(mesh);
    if (!asked || question.isFaced) return;
    question.isFaced = true;
    const { yaw, pitch } = this.view;
    const ways = [pitch, ...TILTS].flatMap((tilt) =>
      Array.from({ length: N_TURNS }, (_, i) =>
        ({ yaw: yaw + (i / N_TURNS) * TURN_ALL, pitch: tilt })));
    const areas = ways.map((way) => mesh.inFront(Object.assign(new View(), way), asked));
    const best = areas.indexOf(Math.max(...areas));
    question.isHidden = areas[best] === 0;
    // A shape that shows the part well enough stays as the person has turned it.
    if (areas[0] >= areas[best] / 2) return;
    Object.assign(this.view, ways[best]);
    this.fill();
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

  colour() {
    const { app, renderer, highlight } = this;
    for (const { mesh, uploaded, colours, plain, values } of this.scenes) {
      if (colours) {
        renderer.update(uploaded, "colour", colours);
        if (plain || values)
          renderer.update(uploaded, "border", new Uint8Array(4 * uploaded.nCorners).fill(255));
        continue;
      }
      const labels = this.painting.labelsOf(mesh);
      const dim = (c) => c.map((x) => 0.2 * x + 0.8 * 178);
      const lit = this.mode === "link"
        ? this.linked(mesh)
        : this.asked(mesh) ?? this.highlighted(mesh, highlight);
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

  /** Returns which faces of a mesh belong to the chosen part, or to one that is pointed at. */
  linked(mesh) {
    const { name } = mesh.portrait;
    const { first } = this.app.linker;
    const parts = [
      name === first?.shape ? first.part : undefined,
      name === this.name ? this.highlight?.part : undefined,
    ];
    if (parts.every((part) => part === undefined)) return null;
    return (f) => parts.includes(mesh.parts[f]);
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
    new ResizeObserver(() => {
      this.resize();
      if (this.scenes?.length && !this.moved) this.fill();
      this.draw();
    }).observe(this.canvas);
  }

  zoom(factor) {
    const { view } = this;
    this.moved = true;
    view.zoom = Math.min(Math.max(view.zoom * factor, 0.2), 30);
    view.pan = view.pan.map((p) => p * factor);
    this.draw();
  }
}
