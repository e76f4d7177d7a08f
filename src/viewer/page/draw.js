// Draws triangles with WebGL 2.

const VERTEX = `#version 300 es
uniform mat3 turn;
uniform vec2 scale;
uniform vec2 shift;
in vec3 place;
in vec3 normal;
in vec4 colour;
in vec4 border;
in float value;
out vec3 facing;
out vec3 seen;
out vec3 paint;
out vec3 side;
out float level;
void main() {
  vec3 p = turn * place;
  float w = 1.0 - 0.2 * p.z;
  gl_Position = vec4(p.xy * scale + shift * w, -0.45 * p.z * w, w);
  facing = turn * normal;
  seen = vec3(0.0, 0.0, 5.0) - p;
  paint = colour.rgb;
  side = border.rgb;
  level = value;
}`;

// A light from the upper right and a weaker one from the left move with the viewer; both sides of a
// face are lit.
const FRAGMENT = `#version 300 es
precision highp float;
uniform float contours;
uniform float lines;
in vec3 facing;
in vec3 seen;
in vec3 paint;
in vec3 side;
in float level;
out vec4 pixel;
void main() {
  vec3 n = normalize(facing);
  vec3 eye = normalize(seen);
  if (dot(n, eye) < 0.0) n = -n;
  vec3 base = pow(paint, vec3(2.2));
  float key = max(dot(n, normalize(vec3(0.45, 0.75, 0.65))), 0.0);
  float fill = max(dot(n, normalize(vec3(-0.8, 0.1, 0.5))), 0.0);
  float sky = 0.5 + 0.5 * n.y;
  vec3 light = vec3(0.30) + 0.16 * sky * vec3(0.9, 0.97, 1.1)
    + 0.62 * key * vec3(1.03, 1.0, 0.95) + 0.16 * fill;
  vec3 halfway = normalize(normalize(vec3(0.45, 0.75, 0.65)) + eye);
  float gloss = 0.06 * pow(max(dot(n, halfway), 0.0), 28.0);
  float rim = 0.10 * pow(1.0 - max(dot(n, eye), 0.0), 3.0);
  vec3 lit = base * light + gloss + rim * base;
  if (lines > 0.0) {
    vec3 near = side / max(fwidth(side), vec3(1e-6));
    float edge = min(near.x, min(near.y, near.z));
    lit *= mix(0.32, 1.0, smoothstep(lines * 0.5, lines * 0.5 + 1.0, edge));
  }
  if (contours > 0.0) {
    float x = level * contours;
    float off = abs(fract(x - 0.5) - 0.5) / max(fwidth(x), 1e-6);
    float zero = abs(level) / max(fwidth(level), 1e-6);
    lit *= mix(0.72, 1.0, smoothstep(0.2, 1.2, off)) * mix(0.45, 1.0, smoothstep(0.6, 1.8, zero));
  }
  pixel = vec4(pow(lit, vec3(1.0 / 2.2)), 1.0);
}`;

/** The direction from which a shape is seen, and its position on the screen, in pixels of a box. */
class View {
  constructor() {
    this.yaw = 0.6;
    this.pitch = 0.35;
    this.zoom = 1;
    this.pan = [0, 0];
    this.box = [0, 0, 1, 1];
  }

  get turn() {
    const [sy, cy, sp, cp] = [
      Math.sin(this.yaw),
      Math.cos(this.yaw),
      Math.sin(this.pitch),
      Math.cos(this.pitch),
    ];
    // Rows: right, up, towards the viewer.
    return [cy, 0, -sy, -sp * sy, cp, -sp * cy, cp * sy, sp, cp * cy];
  }

  get scale() {
    const [, , width, height] = this.box;
    const size = Math.min(width, height) * 0.9 * this.zoom;
    return [size / width, size / height];
  }

  /**
   * Returns, for each point of the shape, (x, y, z): pixels from the upper left corner of the box,
   * and nearness.
   */
  project(points) {
    const t = this.turn;
    const [sx, sy] = this.scale;
    const [, , width, height] = this.box;
    const [panX, panY] = this.pan;
    const out = new Float32Array(points.length);
    for (let i = 0; i < points.length; i += 3) {
      const x = points[i], y = points[i + 1], z = points[i + 2];
      const near = t[6] * x + t[7] * y + t[8] * z;
      const w = 1 - 0.2 * near;
      out[i] = (((t[0] * x + t[1] * y + t[2] * z) * sx) / w + panX + 1) * 0.5 * width;
      out[i + 1] = (1 - (((t[3] * x + t[4] * y + t[5] * z) * sy) / w + panY)) * 0.5 * height;
      out[i + 2] = near;
    }
    return out;
  }

  /**
   * Scales and centres meshes, which are drawn in the same place, to fill the box in the present
   * direction.
   */
  fit(meshes) {
    [this.zoom, this.pan] = [1, [0, 0]];
    let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const mesh of meshes) {
      const seen = this.project(mesh.positions);
      for (let i = 0; i < seen.length; i += 3) {
        left = Math.min(left, seen[i]);
        right = Math.max(right, seen[i]);
        top = Math.min(top, seen[i + 1]);
        bottom = Math.max(bottom, seen[i + 1]);
      }
    }
    const [, , width, height] = this.box;
    this.zoom = Math.min(width / (right - left || 1), height / (bottom - top || 1)) * 0.92;
    this.pan = [
      -((left + right) / width - 1) * this.zoom,
      ((top + bottom) / height - 1) * this.zoom,
    ];
    return this;
  }
}

/** Draws meshes on one canvas. */
class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    const options = {
      antialias: true,
      alpha: true,
      premultipliedAlpha: true,
      preserveDrawingBuffer: true,
    };
    const gl = canvas.getContext("webgl2", options);
    if (!gl) throw new Error("This browser has no WebGL 2, or it is switched off.");
    this.gl = gl;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS))
        throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    ["place", "normal", "colour", "border", "value"].forEach((name, i) =>
      gl.bindAttribLocation(program, i, name),
    );
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS))
      throw new Error(gl.getProgramInfoLog(program));
    this.uniform = Object.fromEntries(
      ["turn", "scale", "shift", "contours", "lines"].map((name) => [
        name,
        gl.getUniformLocation(program, name),
      ]),
    );
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
  }

  /** Copies a mesh to the graphics card. */
  upload(mesh) {
    const { gl } = this;
    const { place, normal } = mesh.corners();
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = {};
    const attribute = (name, at, size, type, normalised, data) => {
      buffers[name] = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, type, normalised, 0, 0);
    };
    const nCorners = 3 * mesh.nFaces;
    attribute("place", 0, 3, gl.FLOAT, false, place);
    attribute("normal", 1, 4, gl.BYTE, true, normal);
    attribute("colour", 2, 4, gl.UNSIGNED_BYTE, true, new Uint8Array(4 * nCorners).fill(200));
    attribute("border", 3, 4, gl.UNSIGNED_BYTE, true, mesh.borders());
    attribute("value", 4, 1, gl.FLOAT, false, new Float32Array(nCorners));
    return { mesh, array, buffers, nCorners };
  }

  /** Replaces colours, borders or values of an uploaded mesh. */
  update(uploaded, name, data) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, uploaded.buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  }

  remove(uploaded) {
    const { gl } = this;
    gl.deleteVertexArray(uploaded.array);
    for (const buffer of Object.values(uploaded.buffers)) gl.deleteBuffer(buffer);
  }

  clear() {
    const { gl, canvas } = this;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** Draws into the view's box, in pixels of the canvas. */
  draw(uploaded, view, { contours = 0, lines = 1.2 } = {}) {
    const { gl, uniform } = this;
    const [x, y, width, height] = view.box;
    gl.viewport(x, this.canvas.height - y - height, width, height);
    gl.uniformMatrix3fv(uniform.turn, true, view.turn);
    gl.uniform2fv(uniform.scale, view.scale);
    gl.uniform2fv(uniform.shift, view.pan);
    gl.uniform1f(uniform.contours, contours);
    gl.uniform1f(uniform.lines, lines);
    gl.bindVertexArray(uploaded.array);
    gl.drawArrays(gl.TRIANGLES, 0, uploaded.nCorners);
  }
}
