// Converts portraits to triangles that can be drawn, picked and painted.

/** Faces that meet at less than this angle share their normals. */
const CREASE = Math.cos((38 * Math.PI) / 180);
const UNLABELLED = [150, 150, 150];
/** Rows and columns of the coarse picture that tells what is in front. */
const FRONT_CELLS = 28;

const AXES = {
  "+x": [1, 0, 0],
  "-x": [-1, 0, 0],
  "+y": [0, 1, 0],
  "-y": [0, -1, 0],
  "+z": [0, 0, 1],
  "-z": [0, 0, -1],
};

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];

/**
 * Returns the directions right, up and front. With a known up axis they are the same for all
 * shapes. Otherwise the shape's middle side stands, and its longest lies across.
 */
function uprightBasis(positions, up) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < positions.length; i++) {
    low[i % 3] = Math.min(low[i % 3], positions[i]);
    high[i % 3] = Math.max(high[i % 3], positions[i]);
  }
  const axes = [0, 1, 2].sort((a, b) => high[b] - low[b] - (high[a] - low[a]) || a - b);
  const unit = (axis) => [0, 1, 2].map((i) => (i === axis ? 1 : 0));
  const upright = AXES[up] ?? unit(axes[1]);
  const order = AXES[up] ? [0, 1, 2] : axes;
  const right = order.map(unit).find((a) => Math.abs(dot(a, upright)) < 0.5);
  const middle = [0, 1, 2].map((i) => (low[i] + high[i]) / 2);
  return { rows: [right, upright, cross(right, upright)], middle };
}

/** A mesh that stands upright, centred, within a ball of radius 1. */
class Mesh {
  constructor(portrait, up) {
    this.portrait = portrait;
    this.kind = portrait.kind;
    const raw = numbers(portrait.positions);
    const { rows, middle } = uprightBasis(raw, up);
    const at = new Float32Array(raw.length);
    let radius = 1e-12;
    const [right, above, front] = rows;
    for (let v = 0; v < raw.length; v += 3) {
      const x = raw[v] - middle[0], y = raw[v + 1] - middle[1], z = raw[v + 2] - middle[2];
      at[v] = right[0] * x + right[1] * y + right[2] * z;
      at[v + 1] = above[0] * x + above[1] * y + above[2] * z;
      at[v + 2] = front[0] * x + front[1] * y + front[2] * z;
      radius = Math.max(radius, x * x + y * y + z * z);
    }
    radius = Math.sqrt(radius);
    for (let i = 0; i < at.length; i++) at[i] /= radius;
    this.positions = at;
    this.faces = portrait.faces.data;
    this.nFaces = this.faces.length / 3;
    this.setLabels(portrait);
    this.weld = portrait.kind === "surface" ? welded(portrait.positions.data) : null;
  }

  /** Sets the label of each face, and its part if known. */
  setLabels(portrait) {
    const { palette, labels } = portrait;
    this.labels = new Int32Array(labels.data.length);
    for (let f = 0; f < this.labels.length; f++) this.labels[f] = palette[labels.data[f]];
    this.parts = portrait.parts?.data ?? null;
    this.polygons = portrait.polygons?.data ?? null;
  }

  /**
   * Returns, for each side of each face (opposite its corners), the face across it; none if there
   * are several.
   */
  get across() {
    if (this._across) return this._across;
    const { faces, nFaces, weld } = this;
    const across = new Int32Array(3 * nFaces).fill(-1);
    const n = this.positions.length / 3;
    const open = new Map();
    for (let side = 0; side < 3 * nFaces; side++) {
      const f = side - (side % 3);
      let a = faces[f + ((side + 1) % 3)];
      let b = faces[f + ((side + 2) % 3)];
      if (weld) [a, b] = [weld[a], weld[b]];
      const key = a < b ? a * n + b : b * n + a;
      const other = open.get(key);
      if (other === undefined) {
        open.set(key, side);
      } else if (across[other] < 0) {
        across[other] = (side / 3) | 0;
        across[side] = (other / 3) | 0;
      } else {
        across[side] = (other / 3) | 0;
      }
    }
    return (this._across = across);
  }

  /** Returns twice the area of each face. */
  get faceAreas() {
    const n = this.faceNormals;
    return Float32Array.from({ length: this.nFaces }, (_, f) =>
      Math.hypot(n[3 * f], n[3 * f + 1], n[3 * f + 2]));
  }

  get faceNormals() {
    if (this._faceNormals) return this._faceNormals;
    const { positions: p, faces, nFaces } = this;
    const out = new Float32Array(3 * nFaces);
    for (let f = 0; f < 3 * nFaces; f += 3) {
      const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      out[f] = uy * vz - uz * vy;
      out[f + 1] = uz * vx - ux * vz;
      out[f + 2] = ux * vy - uy * vx;
    }
    return (this._faceNormals = out);
  }

  /** Returns the arrays of the shape for the graphics card: position and normal of each corner. */
  corners() {
    const { positions, faces, nFaces, weld } = this;
    const normals = this.faceNormals;
    const n = positions.length / 3;
    const vertex = (corner) => (weld ? weld[faces[corner]] : faces[corner]);
    // The corners around each vertex, one vertex after the other.
    const begin = new Uint32Array(n + 1);
    for (let c = 0; c < 3 * nFaces; c++) begin[vertex(c) + 1]++;
    for (let v = 0; v < n; v++) begin[v + 1] += begin[v];
    const around = new Uint32Array(3 * nFaces);
    const next = begin.slice(0, n);
    for (let c = 0; c < 3 * nFaces; c++) around[next[vertex(c)]++] = (c / 3) | 0;
    const lengths = new Float32Array(nFaces);
    for (let f = 0; f < nFaces; f++)
      lengths[f] = Math.hypot(normals[3 * f], normals[3 * f + 1], normals[3 * f + 2]) || 1e-30;
    const place = new Float32Array(9 * nFaces);
    const normal = new Int8Array(12 * nFaces);
    for (let c = 0; c < 3 * nFaces; c++) {
      const f = (c / 3) | 0;
      const v = vertex(c);
      const [nx, ny, nz] = [normals[3 * f], normals[3 * f + 1], normals[3 * f + 2]];
      let [sx, sy, sz] = [0, 0, 0];
      for (let i = begin[v]; i < begin[v + 1]; i++) {
        const g = around[i];
        const [gx, gy, gz] = [normals[3 * g], normals[3 * g + 1], normals[3 * g + 2]];
        if (nx * gx + ny * gy + nz * gz < CREASE * lengths[f] * lengths[g]) continue;
        sx += gx;
        sy += gy;
        sz += gz;
      }
      const length = Math.hypot(sx, sy, sz);
      const unit = length > 1e-30 ? 127 / length : 0;
      const own = 127 / lengths[f];
      normal[4 * c] = unit ? sx * unit : nx * own;
      normal[4 * c + 1] = unit ? sy * unit : ny * own;
      normal[4 * c + 2] = unit ? sz * unit : nz * own;
      const p = 3 * faces[c];
      place[3 * c] = positions[p];
      place[3 * c + 1] = positions[p + 1];
      place[3 * c + 2] = positions[p + 2];
    }
    return { place, normal };
  }

  /**
   * Returns the distance of each corner from each side between two labels; other sides do not
   * count.
   */
  borders(labels = this.labels) {
    const { across, nFaces } = this;
    const out = new Uint8Array(12 * nFaces);
    for (let f = 0; f < nFaces; f++)
      for (let i = 0; i < 3; i++) {
        const other = across[3 * f + i];
        const border = other >= 0 && labels[other] !== labels[f];
        for (let c = 0; c < 3; c++) out[12 * f + 4 * c + i] = border && c !== i ? 0 : 255;
      }
    return out;
  }

  /**
   * Returns the face at a position of the screen, and the point on it; `view` is that of the
   * picture.
   */
  pick(view, x, y) {
    const { positions: p, faces, nFaces } = this;
    const screen = view.project(p);
    let best = null;
    for (let f = 0; f < nFaces; f++) {
      const [a, b, c] = [3 * faces[3 * f], 3 * faces[3 * f + 1], 3 * faces[3 * f + 2]];
      const bx = screen[b] - screen[a], by = screen[b + 1] - screen[a + 1];
      const cx = screen[c] - screen[a], cy = screen[c + 1] - screen[a + 1];
      const area = bx * cy - by * cx;
      if (area === 0) continue;
      const px = x - screen[a], py = y - screen[a + 1];
      const u = (px * cy - py * cx) / area;
      const w = (bx * py - by * px) / area;
      if (u < 0 || w < 0 || u + w > 1) continue;
      const depth =
        screen[a + 2] + u * (screen[b + 2] - screen[a + 2]) + w * (screen[c + 2] - screen[a + 2]);
      if (best && depth <= best.depth) continue;
      const point = [0, 1, 2].map(
        (i) => p[a + i] + u * (p[b + i] - p[a + i]) + w * (p[c + i] - p[a + i]),
      );
      best = { face: f, depth, point };
    }
    return best;
  }

  /**
   * Returns how many places of a coarse picture have a face in front that `of` accepts, judged by
   * the centres of faces.
   */
  inFront(view, of) {
    view.box = [0, 0, FRONT_CELLS, FRONT_CELLS];
    const centres = new Float32Array(3 * this.nFaces);
    for (let f = 0; f < this.nFaces; f++) centres.set(this.centre(f), 3 * f);
    const screen = view.project(centres);
    const front = new Map();
    for (let f = 0; f < this.nFaces; f++) {
      const cell = FRONT_CELLS * Math.floor(screen[3 * f + 1]) + Math.floor(screen[3 * f]);
      const now = front.get(cell);
      if (now === undefined || screen[3 * f + 2] > screen[3 * now + 2]) front.set(cell, f);
    }
    return [...front.values()].filter(of).length;
  }

  /** Returns the faces that are connected with one, across sides that `over` accepts. */
  flood(face, over) {
    const seen = new Uint8Array(this.nFaces);
    const found = [face];
    seen[face] = 1;
    for (let i = 0; i < found.length; i++)
      for (let side = 0; side < 3; side++) {
        const next = this.across[3 * found[i] + side];
        if (next < 0 || seen[next] || !over(next)) continue;
        seen[next] = 1;
        found.push(next);
      }
    return found;
  }

  centre(face) {
    const { positions: p, faces } = this;
    return [0, 1, 2].map(
      (i) =>
        (p[3 * faces[3 * face] + i] +
          p[3 * faces[3 * face + 1] + i] +
          p[3 * faces[3 * face + 2] + i]) /
        3,
    );
  }
}

/** Returns, for each vertex, the first one at its position. */
function welded(steps) {
  const first = new Map();
  const out = new Uint32Array(steps.length / 3);
  const factor = steps instanceof Uint8Array ? 256 : 65536;
  for (let v = 0; v < out.length; v++) {
    const key = (steps[3 * v] * factor + steps[3 * v + 1]) * factor + steps[3 * v + 2];
    const found = first.get(key);
    if (found === undefined) first.set(key, v);
    out[v] = found ?? v;
  }
  return out;
}

/** Returns the colour of each corner from a colour of each face. */
function faceColours(nFaces, colour) {
  const out = new Uint8Array(12 * nFaces);
  for (let f = 0; f < nFaces; f++) {
    const [r, g, b] = colour(f);
    for (let c = 0; c < 3; c++) out.set([r, g, b, 255], 12 * f + 4 * c);
  }
  return out;
}

/** Returns the colour of each corner from a colour of each vertex. */
function vertexColours(mesh, colour) {
  const { faces } = mesh;
  const out = new Uint8Array(4 * faces.length);
  for (let c = 0; c < faces.length; c++) {
    const [r, g, b] = colour(faces[c]);
    out.set([r, g, b, 255], 4 * c);
  }
  return out;
}

const DIVERGING = [
  [8, 64, 129], [43, 121, 182], [120, 179, 214], [199, 221, 235], [245, 245, 242],
  [250, 219, 178], [238, 160, 84], [201, 97, 24], [127, 52, 6],
];
const SEQUENTIAL = [
  [0, 34, 78], [28, 58, 110], [64, 77, 107], [93, 98, 111], [124, 123, 120],
  [154, 146, 117], [187, 172, 108], [221, 201, 87], [254, 232, 56],
];

/** Returns the colour of a scale at a value from 0 to 1. */
function shade(scale, t) {
  const x = Math.min(Math.max(t, 0), 1) * (scale.length - 1);
  const i = Math.min(Math.floor(x), scale.length - 2);
  return scale[i].map((low, c) => low + (x - i) * (scale[i + 1][c] - low));
}
