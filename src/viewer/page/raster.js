// Draws triangles as small pictures on the processor. An emulated graphics card takes longer to
// return a picture than this takes to draw it, and for a real one the pictures are too few to be
// worth its start.

/** Number of samples in a pixel, in each direction. */
const SAMPLES = 2;
/**
 * A corner is lit by the mean normal around its vertex if its face is within this angle of the
 * mean.
 */
const SMOOTH = Math.cos((36 * Math.PI) / 180);
/** Half the width of lines between labels, in pixels; then the distance over which they fade. */
const LINE = [0.35, 1.35];
/** Darkness of such lines. */
const LINE_SHADE = 0.32;
/** Number of steps of light from none to full, enough for a screen. */
const STEPS = 1023;
const GAMMA = 2.2;
const ON_SCREEN = Uint8Array.from({ length: STEPS + 1 }, (_, i) =>
  Math.round(255 * (i / STEPS) ** (1 / GAMMA)),
);
/**
 * Directions from `FRAGMENT` in draw.js: of both lights, and halfway between the first light and
 * the eye.
 */
const KEY = direction(0.45, 0.75, 0.65);
const FILL = direction(-0.8, 0.1, 0.5);

function direction(x, y, z) {
  const length = Math.hypot(x, y, z);
  return [x / length, y / length, z / length];
}

/** Draws one mesh after the other. */
class Raster {
  constructor() {
    this.depth = new Float32Array(0);
    this.colours = new Uint32Array(0);
    this.light = new Float32Array(0);
  }

  /** Returns the first view of a mesh, with its faces in the colours of their labels. */
  picture(mesh, colour, width, height) {
    const view = new View();
    const [columns, rows] = [width * SAMPLES, height * SAMPLES];
    view.box = [0, 0, columns, rows];
    view.fit([mesh]);
    const n = columns * rows;
    if (this.depth.length !== n)
      [this.depth, this.colours] = [new Float32Array(n), new Uint32Array(n)];
    this.depth.fill(-Infinity);
    this.colours.fill(0);
    this.fill(mesh, view, colour, columns, rows);
    return this.averaged(width, height);
  }

  /** Draws all triangles. */
  fill(mesh, view, colour, columns, rows) {
    const { depth, colours } = this;
    const { faces, nFaces, labels } = mesh;
    const seen = view.project(mesh.positions);
    if (this.light.length < 12 * nFaces) this.light = new Float32Array(12 * nFaces);
    const { light } = this;
    shine(mesh, view, light);
    const between = sidesBetween(mesh);
    const paints = new Map();
    const [solid, faded] = LINE.map((x) => x * SAMPLES);
    for (let f = 0; f < nFaces; f++) {
      const a = 3 * faces[3 * f], b = 3 * faces[3 * f + 1], c = 3 * faces[3 * f + 2];
      const ax = seen[a], ay = seen[a + 1], az = seen[a + 2];
      const bx = seen[b] - ax, by = seen[b + 1] - ay, bz = seen[b + 2] - az;
      const cx = seen[c] - ax, cy = seen[c + 1] - ay, cz = seen[c + 2] - az;
      const area = bx * cy - by * cx;
      if (area === 0) continue;
      const left = Math.max(Math.ceil(ax + Math.min(0, bx, cx) - 0.5), 0);
      const right = Math.min(Math.floor(ax + Math.max(0, bx, cx) - 0.5), columns - 1);
      const top = Math.max(Math.ceil(ay + Math.min(0, by, cy) - 0.5), 0);
      const bottom = Math.min(Math.floor(ay + Math.max(0, by, cy) - 0.5), rows - 1);
      if (left > right || top > bottom) continue;
      let paint = paints.get(labels[f]);
      if (!paint) paints.set(labels[f], (paint = colour(labels[f]).map((x) => (x / 255) ** GAMMA)));
      // Red, green and blue of the first corner, and the differences of the others. A loop, or
      // arrays, would cost as much as everything else here.
      const l = 12 * f;
      const pr = paint[0], pg = paint[1], pk = paint[2];
      const r = pr * light[l] + light[l + 3];
      const g = pg * light[l + 1] + light[l + 3];
      const k = pk * light[l + 2] + light[l + 3];
      const rb = pr * light[l + 4] + light[l + 7] - r, rc = pr * light[l + 8] + light[l + 11] - r;
      const gb = pg * light[l + 5] + light[l + 7] - g, gc = pg * light[l + 9] + light[l + 11] - g;
      const kb = pk * light[l + 6] + light[l + 7] - k, kc = pk * light[l + 10] + light[l + 11] - k;
      // Distance of a sample from each side, where the side is between two labels.
      const lines = between[f];
      const toA = lines & 1 ? Math.abs(area) / Math.hypot(cx - bx, cy - by) : Infinity;
      const toB = lines & 2 ? Math.abs(area) / Math.hypot(cx, cy) : Infinity;
      const toC = lines & 4 ? Math.abs(area) / Math.hypot(bx, by) : Infinity;
      // Shares of the second and the third corner, and their increments from sample to sample.
      const right1 = cy / area, down1 = -cx / area, right2 = -by / area, down2 = bx / area;
      for (let y = top; y <= bottom; y++) {
        const px = left + 0.5 - ax, py = y + 0.5 - ay;
        let u = px * right1 + py * down1;
        let v = px * right2 + py * down2;
        for (
          let at = y * columns + left, end = y * columns + right;
          at <= end;
          at++, u += right1, v += right2
        ) {
          if (u < 0 || v < 0 || u + v > 1) continue;
          const near = az + u * bz + v * cz;
          if (near <= depth[at]) continue;
          depth[at] = near;
          let shade = STEPS;
          if (lines) {
            const edge = (Math.min((1 - u - v) * toA, u * toB, v * toC) - solid) / (faded - solid);
            const smooth = edge <= 0 ? 0 : edge >= 1 ? 1 : edge * edge * (3 - 2 * edge);
            shade *= LINE_SHADE + (1 - LINE_SHADE) * smooth;
          }
          const red = ON_SCREEN[Math.min(shade * (r + u * rb + v * rc), STEPS) | 0];
          const green = ON_SCREEN[Math.min(shade * (g + u * gb + v * gc), STEPS) | 0];
          const blue = ON_SCREEN[Math.min(shade * (k + u * kb + v * kc), STEPS) | 0];
          colours[at] = 0xff000000 | (blue << 16) | (green << 8) | red;
        }
      }
    }
  }

  /**
   * Returns pixels as means of their samples; a pixel that is covered in part is transparent in
   * part.
   */
  averaged(width, height) {
    const { colours } = this;
    const columns = width * SAMPLES;
    const picture = new ImageData(width, height);
    const { data } = picture;
    for (let y = 0, p = 0; y < height; y++)
      for (let x = 0; x < width; x++, p += 4) {
        let n = 0, r = 0, g = 0, b = 0;
        for (let j = 0; j < SAMPLES; j++)
          for (let i = 0; i < SAMPLES; i++) {
            const sample = colours[(y * SAMPLES + j) * columns + x * SAMPLES + i];
            if (sample === 0) continue;
            n++;
            r += sample & 255;
            g += (sample >> 8) & 255;
            b += (sample >> 16) & 255;
          }
        if (n === 0) continue;
        data[p] = r / n;
        data[p + 1] = g / n;
        data[p + 2] = b / n;
        data[p + 3] = (255 * n) / (SAMPLES * SAMPLES);
      }
    return picture;
  }
}

/**
 * Returns, for each face, which of the sides opposite its corners (1, 2, 4) are between two labels.
 */
function sidesBetween({ positions, faces, nFaces, labels }) {
  const n = positions.length / 3;
  // Such a side is between two vertices with faces of several labels, and these vertices are few.
  const of = new Int32Array(n).fill(-2);
  const mixed = new Uint8Array(n);
  for (let c = 0; c < 3 * nFaces; c++) {
    const v = faces[c], label = labels[(c / 3) | 0];
    if (of[v] === -2) of[v] = label;
    else if (of[v] !== label) mixed[v] = 1;
  }
  const sides = new Uint8Array(nFaces);
  const open = new Map();
  for (let f = 0; f < nFaces; f++)
    for (let i = 0; i < 3; i++) {
      const a = faces[3 * f + ((i + 1) % 3)];
      const b = faces[3 * f + ((i + 2) % 3)];
      if (!mixed[a] || !mixed[b]) continue;
      const key = a < b ? a * n + b : b * n + a;
      const other = open.get(key);
      if (other === undefined) open.set(key, 4 * f + i);
      else if (labels[other >> 2] !== labels[f]) {
        sides[f] |= 1 << i;
        sides[other >> 2] |= 1 << (other & 3);
      }
    }
  return sides;
}

/**
 * Computes, for each corner, the factors of light for red, green and blue, and the light added to
 * all, as `FRAGMENT` in draw.js does.
 */
function shine(mesh, view, out) {
  const { positions: p, faces, nFaces } = mesh;
  const own = mesh.faceNormals;
  const mean = new Float32Array(p.length);
  for (let c = 0; c < 3 * nFaces; c++) {
    const f = c - (c % 3);
    const v = 3 * faces[c];
    for (let i = 0; i < 3; i++) mean[v + i] += own[f + i];
  }
  const t = view.turn;
  const half = direction(KEY[0], KEY[1], KEY[2] + 1);
  const lit = (to, x, y, z, v) => {
    // Rotated with the shape, and facing the eye.
    const size = Math.sqrt(x * x + y * y + z * z) || 1;
    let nx = (t[0] * x + t[1] * y + t[2] * z) / size;
    let ny = (t[3] * x + t[4] * y + t[5] * z) / size;
    let nz = (t[6] * x + t[7] * y + t[8] * z) / size;
    const ex = -(t[0] * p[v] + t[1] * p[v + 1] + t[2] * p[v + 2]);
    const ey = -(t[3] * p[v] + t[4] * p[v + 1] + t[5] * p[v + 2]);
    const ez = 5 - (t[6] * p[v] + t[7] * p[v + 1] + t[8] * p[v + 2]);
    let facing = (nx * ex + ny * ey + nz * ez) / Math.sqrt(ex * ex + ey * ey + ez * ez);
    if (facing < 0) {
      nx = -nx;
      ny = -ny;
      nz = -nz;
      facing = -facing;
    }
    const key = 0.62 * Math.max(nx * KEY[0] + ny * KEY[1] + nz * KEY[2], 0);
    const fill = 0.16 * Math.max(nx * FILL[0] + ny * FILL[1] + nz * FILL[2], 0);
    const sky = 0.16 * (0.5 + 0.5 * ny);
    const rim = 0.1 * (1 - facing) ** 3;
    const all = 0.3 + fill + rim;
    out[to] = all + 0.9 * sky + 1.03 * key;
    out[to + 1] = all + 0.97 * sky + key;
    out[to + 2] = all + 1.1 * sky + 0.95 * key;
    out[to + 3] = 0.06 * Math.max(nx * half[0] + ny * half[1] + nz * half[2], 0) ** 28;
  };
  // A vertex with a smooth neighbourhood is lit once.
  const known = new Int32Array(p.length / 3).fill(-1);
  for (let c = 0; c < 3 * nFaces; c++) {
    const f = c - (c % 3);
    const v = 3 * faces[c];
    const x = own[f], y = own[f + 1], z = own[f + 2];
    const mx = mean[v], my = mean[v + 1], mz = mean[v + 2];
    const along = x * mx + y * my + z * mz;
    const smooth =
      along > SMOOTH * Math.sqrt((x * x + y * y + z * z) * (mx * mx + my * my + mz * mz));
    if (!smooth) lit(4 * c, x, y, z, v);
    else if (known[faces[c]] < 0) {
      lit(4 * c, mx, my, mz, v);
      known[faces[c]] = 4 * c;
    } else for (let i = 0, from = known[faces[c]]; i < 4; i++) out[4 * c + i] = out[from + i];
  }
}
