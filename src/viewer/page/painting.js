// What a person paints on the shape of the stage, before it is sent.

/** Limits of the size of the brush, in radii of the shape. */
const BRUSH_SIZES = [0.02, 0.5];

class Painting {
  constructor(stage) {
    this.stage = stage;
    this.label = null;
    this.tool = "brush";
    this.brushSize = 0.1;
    this.strokes = new Strokes();
  }

  /** Number of painted polygons. */
  get size() {
    return this.strokes.size;
  }

  /** Forgets what is painted and its strokes: it was sent, or another shape is shown. */
  forget() {
    this.strokes.clear();
  }

  /** Returns the radius of the brush in units of the shape. */
  reach() {
    return this.brushSize / Math.max(this.stage.view.zoom, 0.5);
  }

  /** Multiplies the size of the brush. */
  resize(factor) {
    const [low, high] = BRUSH_SIZES;
    this.brushSize = Math.min(Math.max(this.brushSize * factor, low), high);
  }

  /** Returns the label of each face of a mesh, including painted labels. */
  labelsOf(mesh) {
    if (this.size === 0 || !mesh.polygons) return mesh.labels;
    const { labels } = this.strokes;
    return mesh.labels.map((label, f) => labels.get(mesh.polygons[f]) ?? label);
  }

  /** Returns the faces that the tool covers at a point of a mesh. */
  covered({ face, point, scene }) {
    const { mesh } = scene;
    if (this.tool === "part") {
      const labels = this.labelsOf(mesh);
      return mesh.flood(face, (f) => labels[f] === labels[face]);
    }
    const reach = this.reach();
    const near = (f) => Math.hypot(...mesh.centre(f).map((x, i) => x - point[i])) < reach;
    return mesh.flood(face, near);
  }

  /**
   * Paints at a position of the page, within an open stroke. Returns false if it is not on the
   * shape.
   */
  paint(event) {
    const found = this.label !== null && this.stage.pick(event);
    if (!found?.scene.mesh.polygons) return false;
    const { polygons } = found.scene.mesh;
    for (const f of this.covered(found))
      this.strokes.paint(polygons[f], this.tool === "eraser" ? null : this.label);
    this.changed();
    return true;
  }

  /** Paints or erases a part of the list: does without a mouse what the brush does. */
  paintPart(highlight) {
    const mesh = this.stage.scenes?.[0]?.mesh;
    if (!mesh?.polygons || this.label === null) return;
    const covers = this.stage.highlighted(mesh, highlight);
    const label = this.tool === "eraser" ? null : this.label;
    this.strokes.begin();
    for (let f = 0; f < mesh.nFaces; f++)
      if (covers(f)) this.strokes.paint(mesh.polygons[f], label);
    this.strokes.end();
    this.changed();
  }

  /** Erases all that is painted. Like a stroke, this can be undone. */
  discard() {
    this.strokes.begin();
    for (const polygon of [...this.strokes.labels.keys()]) this.strokes.paint(polygon, null);
    this.strokes.end();
    this.changed();
  }

  /** Undoes or repeats a stroke. Returns false if there is none. */
  step(redo) {
    const stepped = redo ? this.strokes.redo() : this.strokes.undo();
    if (stepped) this.changed();
    return stepped;
  }

  changed() {
    const { stage } = this;
    stage.colour();
    stage.draw();
    stage.app.painter.paintedChanged();
  }

  /** Returns runs of polygons with the same painted label: first, count, label. */
  runs() {
    const runs = [];
    const { labels } = this.strokes;
    for (const polygon of [...labels.keys()].sort((a, b) => a - b)) {
      const label = labels.get(polygon);
      const last = runs.at(-1);
      if (last && last[0] + last[1] === polygon && last[2] === label) last[1]++;
      else runs.push([polygon, 1, label]);
    }
    return runs;
  }
}
