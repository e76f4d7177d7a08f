// Mouse and keys on the stage: they turn, move and scale the shape, paint on it, and tell what is
// under the pointer.

/** Angle in radians for each pixel of a drag, and for each key. */
const TURN = 0.009;
const TURN_STEP = 0.15;
const TILT_STEP = 0.1;
const MAX_TILT = 1.5;
const ZOOM_STEP = 1.15;
/** Pixels by which an arrow key moves the cursor. */
const CURSOR_STEP = 12;
/** Maximum number of faces of a mesh on which the pointer looks for one at each move. */
const MAX_HOVER = 30_000;
/** Pixels by which the pointer may move during a click. */
const CLICK = 4;

class Pointer {
  constructor(app) {
    this.app = app;
    this.stage = app.stage;
    this.canvas = app.stage.canvas;
    this.drag = null;
    /** Position of the cursor in the page that the arrow keys move. */
    this.at = null;
    this.listen();
  }

  get paints() {
    return this.stage.mode === "correct";
  }

  get links() {
    return this.stage.mode === "link";
  }

  /** Returns whether the arrow keys move a cursor. */
  get points() {
    return this.paints || this.links;
  }

  listen() {
    const { canvas, stage } = this;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => {
      const chooses = this.links && this.drag?.travelled <= CLICK;
      this.release();
      if (chooses) this.choosePart(event);
      this.hover(event);
    });
    canvas.addEventListener("pointercancel", () => this.release());
    canvas.addEventListener("pointerleave", () => this.hide());
    canvas.addEventListener("blur", () => this.hide());
    canvas.addEventListener("dblclick", () => {
      if (this.paints || !stage.scenes?.length) return;
      stage.fit();
      stage.draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      stage.zoom(Math.exp(-event.deltaY * 0.0012));
      this.showCursor();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.altKey || event.metaKey || !stage.scenes?.length) return;
      if (this.key(event)) event.preventDefault();
    });
  }

  press(event) {
    const { canvas, stage } = this;
    const { strokes } = stage.painting;
    canvas.setPointerCapture(event.pointerId);
    const shift = event.shiftKey || event.button === 2;
    if (this.paints) strokes.begin();
    const paint = this.paints && !shift && !event.altKey && stage.painting.paint(event);
    this.drag = { x: event.clientX, y: event.clientY, shift, paint, travelled: 0 };
    if (paint) return;
    strokes.open = null;
    canvas.classList.add("turning");
  }

  move(event) {
    const { drag, stage, canvas } = this;
    this.at = { clientX: event.clientX, clientY: event.clientY };
    this.showCursor();
    if (!drag) return this.hover(event);
    if (drag.paint) {
      $("hint").hidden = true;
      return void stage.painting.paint(event);
    }
    const [dx, dy] = [event.clientX - drag.x, event.clientY - drag.y];
    [drag.x, drag.y] = [event.clientX, event.clientY];
    drag.travelled += Math.hypot(dx, dy);
    // The shape does not move under a click.
    if (this.links && drag.travelled <= CLICK) return;
    if (drag.shift) {
      stage.moved = true;
      stage.view.pan[0] += (2 * dx * stage.scenes.length) / canvas.clientWidth;
      stage.view.pan[1] -= (2 * dy) / canvas.clientHeight;
      stage.draw();
    } else this.turn(-dx * TURN, dy * TURN);
  }

  release() {
    if (this.drag?.paint) this.stage.painting.strokes.end();
    this.drag = null;
    this.app.painter.paintedChanged();
    this.canvas.classList.remove("turning");
  }

  /** Chooses the part at a position of the page for a link. */
  choosePart(at) {
    const found = this.stage.pick(at);
    if (!found) return void ($("spoken").textContent = "beside the shape");
    const { mesh } = found.scene;
    this.app.linker.pick(mesh.portrait.name, mesh.parts[found.face]);
  }

  turn(yaw, tilt) {
    const { view } = this.stage;
    view.yaw += yaw;
    view.pitch = Math.min(Math.max(view.pitch + tilt, -MAX_TILT), MAX_TILT);
    this.stage.draw();
  }

  /** Handles a key on the stage; returns whether it has a meaning. */
  key(event) {
    const { stage } = this;
    const zoom = { "+": ZOOM_STEP, "=": ZOOM_STEP, "-": 1 / ZOOM_STEP }[event.key];
    const arrow = event.key.startsWith("Arrow") ? event.key.slice(5) : null;
    // The letters have other meanings where a person answers questions or links parts.
    const isFree = !["ask", "link"].includes(stage.mode);
    const letters = isFree ? { a: "Left", d: "Right", w: "Up", s: "Down" } : {};
    const to = arrow && event.shiftKey ? arrow : letters[event.key];
    if (zoom) stage.zoom(zoom);
    else if (event.key === "0") {
      stage.fit();
      stage.draw();
    } else if (to) {
      const [x, y] = { Left: [-1, 0], Right: [1, 0], Up: [0, 1], Down: [0, -1] }[to];
      this.turn(x * TURN_STEP, y * TILT_STEP);
    } else if (arrow && this.points) this.step(arrow);
    else if (event.key === " " && this.points) this.dab();
    else return false;
    return true;
  }

  /** Moves the cursor by one step; it begins in the middle. */
  step(arrow) {
    const box = this.canvas.getBoundingClientRect();
    const begin = { clientX: box.left + box.width / 2, clientY: box.top + box.height / 2 };
    const at = this.at ?? begin;
    const [x, y] = { Left: [-1, 0], Right: [1, 0], Up: [0, -1], Down: [0, 1] }[arrow];
    const within = (v, low, size) => Math.min(Math.max(v, low + 1), low + size - 1);
    this.at = {
      clientX: within(at.clientX + x * CURSOR_STEP, box.left, box.width),
      clientY: within(at.clientY + y * CURSOR_STEP, box.top, box.height),
    };
    this.showCursor(true);
    this.hover(this.at);
    const found = this.stage.pick(this.at);
    $("spoken").textContent = found ? this.labelAt(found) : "beside the shape";
  }

  /** Does at the cursor what a click does. */
  dab() {
    const { painting } = this.stage;
    if (!this.at) return this.step("Up");
    if (this.links) return this.choosePart(this.at);
    painting.strokes.begin();
    const painted = painting.paint(this.at);
    painting.strokes.end();
    const n = counted(painting.size, "face");
    $("spoken").textContent = painted ? `${n} painted` : "beside the shape";
    this.hover(this.at);
  }

  hide() {
    $("hint").hidden = $("cursor").hidden = true;
    this.at = null;
  }

  /**
   * Shows the size of the tool at the cursor; beside the shape only if a person moves it by keys.
   */
  showCursor(byKeys = false) {
    const { stage, at } = this;
    const { painting } = stage;
    const cursor = $("cursor");
    const shown = at && (this.paints ? byKeys || stage.pick(at) : this.links && byKeys);
    cursor.hidden = !shown;
    if (!shown) return;
    const box = this.canvas.getBoundingClientRect();
    // The same factor as in View.scale.
    const diameter = 0.9 * painting.reach() * stage.view.zoom * Math.min(box.width, box.height);
    const tool = this.links ? "part" : painting.tool;
    const pixels = tool === "part" ? CURSOR_STEP : diameter;
    Object.assign(cursor.style, {
      left: `${at.clientX - box.left}px`,
      top: `${at.clientY - box.top}px`,
      width: `${pixels}px`,
      height: `${pixels}px`,
    });
    cursor.dataset.tool = tool;
  }

  labelAt({ face, scene }) {
    const { mesh } = scene;
    const name = this.app.labelName(this.stage.painting.labelsOf(mesh)[face]);
    return this.links ? `${mesh.portrait.name}:${mesh.parts[face]}, ${name}` : name;
  }

  /** Shows beside the pointer what is under it. */
  hover(at) {
    const { app, stage } = this;
    const hint = $("hint");
    const shown = stage.scenes?.[0]?.mesh;
    const found = shown && shown.nFaces <= MAX_HOVER && stage.pick(at);
    hint.hidden = !found;
    if (!found) return;
    const { mesh, values } = found.scene;
    if (values) {
      const value = values[mesh.faces[3 * found.face]];
      hint.replaceChildren(value.toFixed(2));
    } else {
      const label = stage.painting.labelsOf(mesh)[found.face];
      hint.replaceChildren(swatch(app.colour(label)), this.labelAt(found));
    }
    hint.dataset.polygon = mesh.polygons?.[found.face] ?? "";
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [at.clientX - box.left + 14, at.clientY - box.top + 14];
    hint.style.left = `${Math.max(Math.min(x, box.width - hint.offsetWidth - 6), 6)}px`;
    hint.style.top = `${Math.max(Math.min(y, box.height - hint.offsetHeight - 6), 6)}px`;
  }
}
