// Draws an exercise: the organ, whose nodes move, the instrument, the targets.

const VERTEX = `#version 300 es
in vec3 place, normal;
uniform mat4 clip, pose;
out vec3 at, n;
void main() {
  vec4 world = pose * vec4(place, 1.0);
  at = world.xyz;
  n = mat3(pose) * normal;
  gl_Position = clip * world;
}`;
// A light at the eye, as a laparoscope has it: Lambert and Blinn.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 at, n;
uniform vec3 eye;
uniform vec4 colour;
out vec4 pixel;
void main() {
  vec3 to = normalize(eye - at);
  float cosine = abs(dot(normalize(n), to));
  float far = clamp(0.16 / max(length(eye - at), 0.01), 0.35, 1.15);
  pixel = vec4(colour.rgb * (0.16 + 0.84 * cosine) * far + 0.25 * pow(cosine, 40.0), colour.a);
}`;

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.slow = drawnByProcessor();
    this.gl = canvas.getContext("webgl2", {antialias: !this.slow, alpha: false});
    if (!this.gl) throw new Error("this browser draws no WebGL 2");
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    this.at = name => gl.getUniformLocation(program, name);
    this.place = gl.getAttribLocation(program, "place");
    this.normal = gl.getAttribLocation(program, "normal");
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.wire = this.free = false;
    this.home();
    this.ball = this.shape(...sphere(12));
  }

  // The free view where the laparoscope is.
  home() {
    this.turn = [0, 0];
    this.shift = [0, 0];
    this.zoom = 1;
  }

  // What the picture depends on beside the frame.
  state() {
    const {canvas, wire, free, turn, shift, zoom} = this;
    return JSON.stringify([canvas.clientWidth, canvas.clientHeight, wire, free, turn, shift, zoom]);
  }

  scale(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 5);
  }

  shape(places, triangles) {
    const gl = this.gl, n = Float32Array.from(places), t = Uint32Array.from(triangles);
    const edges = new Uint32Array(2 * t.length);
    for (let i = 0; i < t.length; i += 3) {
      edges.set([t[i], t[i + 1], t[i + 1], t[i + 2], t[i + 2], t[i]], 2 * i);
    }
    const made = {count: t.length, triangles: t, buffers: [0, 1, 2, 3].map(() => gl.createBuffer())};
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.buffers[2]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, t, gl.STATIC_DRAW);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made.buffers[3]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, edges, gl.STATIC_DRAW);
    this.put(made, n);
    return made;
  }

  put(shape, places) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, shape.buffers[0]);
    gl.bufferData(gl.ARRAY_BUFFER, places, gl.DYNAMIC_DRAW);
    gl.bindBuffer(gl.ARRAY_BUFFER, shape.buffers[1]);
    gl.bufferData(gl.ARRAY_BUFFER, normals(places, shape.triangles), gl.DYNAMIC_DRAW);
  }

  // Draws with fewer pixels from now on, where the processor draws and is too slow at it.
  hurry() {
    if (this.slow) this.fine = Math.max(0.7 * this.fine, 0.5);
  }

  load(scene) {
    this.fine = 1;  // pixels for one of the page
    for (const old of this.scene ? [this.organ, ...this.geoms] : []) {
      old.buffers.forEach(buffer => this.gl.deleteBuffer(buffer));
    }
    this.scene = scene;
    this.organ = this.shape(new Float32Array(3 * scene.nodes), scene.triangles);
    this.geoms = scene.geoms.map(geom => this.shape(geom.vertices, geom.triangles));
  }

  // The eye: place, and the axes right, up, back; turned and moved in a free view.
  eye(tip) {
    const {pos, mat, fovy} = this.scene.camera;
    let axes = [0, 1, 2].map(j => [mat[j], mat[3 + j], mat[6 + j]]), at = pos;
    if (this.free) {
      const [a, b] = this.turn, [right, up, back] = axes;
      const far = Math.hypot(...sub(pos, tip)) * this.zoom;
      const side = add(scale(right, Math.cos(a)), scale(back, Math.sin(a)));
      const behind = add(scale(back, Math.cos(a)), scale(right, -Math.sin(a)));
      axes = [side, add(scale(up, Math.cos(b)), scale(behind, -Math.sin(b))),
        add(scale(behind, Math.cos(b)), scale(up, Math.sin(b)))];
      at = add(add(tip, scale(axes[2], far)),
        add(scale(axes[0], this.shift[0] * far), scale(axes[1], this.shift[1] * far)));
    }
    return {at, axes, fovy};
  }

  draw(frame, head, expert) {
    const gl = this.gl, {canvas, scene} = this;
    const fine = this.slow ? this.fine : Math.min(devicePixelRatio || 1, 2);
    const width = Math.round(fine * canvas.clientWidth), height = Math.round(fine * canvas.clientHeight);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clearColor(0.07, 0.02, 0.02, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const {at, axes, fovy} = this.eye([head.tip_x, head.tip_y, head.tip_z]);
    gl.uniformMatrix4fv(this.at("clip"), false, clip(at, axes, fovy, width / height));
    gl.uniform3fv(this.at("eye"), at);
    let from = scene.head.length;
    const places = from + 3 * scene.nodes;
    this.put(this.organ, frame.subarray(from, from += 3 * scene.nodes));
    this.paint(this.organ, UNIT, scene.organ, this.wire);
    this.geoms.forEach((geom, i) => {
      const p = frame.subarray(from, from += 12);
      this.paint(geom, pose(p, p.subarray(3)), scene.geoms[i].rgba, false);
    });
    for (let i = 0; i < scene.targets; i++) {
      const p = frame.subarray(from, from += 8);
      if (p[6] > 0.05) this.paint(this.ball, ball(p), p.subarray(3, 7), false);
    }
    if (expert) this.show(expert, frame, places, head);
  }

  // The expert's way, and the instrument where the expert has it now.
  show({time, pose: poses, path, since}, frame, from, head) {
    const now = (performance.now() - since) / 1e3 % (time.at(-1) + 1);
    path.forEach(([x, y, z]) => this.paint(this.ball, ball([x, y, z, 0, 0, 0, 0, 0.0006]), WAY, false));
    let k = time.findIndex(t => t >= now);
    if (k < 0) k = time.length - 1;
    const [x, y, z, ...quat] = poses[k];
    const tip = inverse(rigid([head.tip_x, head.tip_y, head.tip_z], [head.tip_qw, head.tip_qx, head.tip_qy, head.tip_qz]));
    const move = times(rigid([x, y, z], quat), tip);
    this.scene.geoms.forEach((geom, i) => {
      const p = frame.subarray(from + 12 * i, from + 12 * i + 12);
      if (geom.mine) this.paint(this.geoms[i], times(move, pose(p, p.subarray(3))), GHOST, false);
    });
  }

  paint(shape, matrix, colour, wire) {
    const gl = this.gl;
    gl.uniformMatrix4fv(this.at("pose"), false, matrix);
    gl.uniform4fv(this.at("colour"), colour);
    for (const [k, name] of [[0, this.place], [1, this.normal]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, shape.buffers[k]);
      gl.enableVertexAttribArray(name);
      gl.vertexAttribPointer(name, 3, gl.FLOAT, false, 0, 0);
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, shape.buffers[wire ? 3 : 2]);
    gl.drawElements(wire ? gl.LINES : gl.TRIANGLES, wire ? 2 * shape.count : shape.count,
      gl.UNSIGNED_INT, 0);
  }

  // How far a pixel is at the tip [m].
  pixel(head) {
    const {at, axes, fovy} = this.eye([head.tip_x, head.tip_y, head.tip_z]);
    const depth = dot(sub(at, [head.tip_x, head.tip_y, head.tip_z]), axes[2]);
    return 2 * Math.max(depth, 0.02) * Math.tan(fovy * Math.PI / 360) / this.canvas.clientHeight;
  }
}

// Whether there is no graphics card to draw with: smooth edges would then cost every third picture.
function drawnByProcessor() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const about = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

const WAY = [0.35, 0.95, 0.75, 1], GHOST = [0.35, 0.95, 0.75, 0.4];
const UNIT = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
const add = (a, b) => a.map((x, i) => x + b[i]);
const sub = (a, b) => a.map((x, i) => x - b[i]);
const scale = (a, s) => a.map(x => x * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// Columns of a matrix in rows, as MuJoCo has it, and a place.
const pose = (p, m) => [m[0], m[3], m[6], 0, m[1], m[4], m[7], 0, m[2], m[5], m[8], 0, p[0], p[1], p[2], 1];
const ball = p => [p[7], 0, 0, 0, 0, p[7], 0, 0, 0, 0, p[7], 0, p[0], p[1], p[2], 1];

// Motions as matrices in columns.
function rigid([x, y, z], [a, b, c, d]) {
  return [1 - 2 * (c * c + d * d), 2 * (b * c + a * d), 2 * (b * d - a * c), 0,
    2 * (b * c - a * d), 1 - 2 * (b * b + d * d), 2 * (c * d + a * b), 0,
    2 * (b * d + a * c), 2 * (c * d - a * b), 1 - 2 * (b * b + c * c), 0, x, y, z, 1];
}
function times(a, b) {
  return Array.from({length: 16}, (_, k) => [0, 1, 2, 3].reduce((sum, i) => sum + a[4 * i + k % 4] * b[4 * (k >> 2) + i], 0));
}
function inverse(m) {
  const [x, y, z] = [m[12], m[13], m[14]];
  return [m[0], m[4], m[8], 0, m[1], m[5], m[9], 0, m[2], m[6], m[10], 0,
    -(m[0] * x + m[1] * y + m[2] * z), -(m[4] * x + m[5] * y + m[6] * z), -(m[8] * x + m[9] * y + m[10] * z), 1];
}

function clip(at, [r, u, b], fovy, aspect, near = 0.005, far = 2) {
  const f = 1 / Math.tan(fovy * Math.PI / 360), [p, q] = [-dot(r, at), -dot(u, at)], s = -dot(b, at);
  const [c, d] = [(far + near) / (near - far), 2 * far * near / (near - far)];
  const x = f / aspect;
  return [x * r[0], f * u[0], c * b[0], -b[0], x * r[1], f * u[1], c * b[1], -b[1],
    x * r[2], f * u[2], c * b[2], -b[2], x * p, f * q, c * s + d, -s];
}

function normals(x, t) {
  const out = new Float32Array(x.length);
  for (let i = 0; i < t.length; i += 3) {
    const [a, b, c] = [3 * t[i], 3 * t[i + 1], 3 * t[i + 2]];
    const [u, v, w] = [x[b] - x[a], x[b + 1] - x[a + 1], x[b + 2] - x[a + 2]];
    const [p, q, r] = [x[c] - x[a], x[c + 1] - x[a + 1], x[c + 2] - x[a + 2]];
    const [l, m, n] = [v * r - w * q, w * p - u * r, u * q - v * p];
    for (const k of [a, b, c]) {
      out[k] += l;
      out[k + 1] += m;
      out[k + 2] += n;
    }
  }
  return out;
}

function sphere(n) {
  const places = [], triangles = [];
  for (let i = 0; i <= n; i++) {
    for (let j = 0; j <= 2 * n; j++) {
      const [a, b] = [Math.PI * i / n, Math.PI * j / n];
      places.push(Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a));
      const k = i * (2 * n + 1) + j;
      if (i < n && j < 2 * n) triangles.push(k, k + 2 * n + 1, k + 1, k + 1, k + 2 * n + 1, k + 2 * n + 2);
    }
  }
  return [places, triangles];
}
