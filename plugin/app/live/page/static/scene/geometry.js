// Arrays of the server, and geometries of them.
import * as THREE from "../three/three.module.min.js";
import {cross, unit} from "./vectors.js";

// Arrays as the server packs them, see `pack` in picture.py.
const KINDS = {f: Float32Array, b: Uint8Array, h: Uint16Array, u: Uint32Array};
export function unpack(packed) {
  const [[kind, text]] = Object.entries(packed), bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  return new KINDS[kind](bytes.buffer);
}

// Geometries. A vertex's numbers change in place.
export function put(geometry, name, length) {
  const held = geometry.attributes[name];
  if (held?.array.length === length) return held;
  const made = new THREE.BufferAttribute(new Float32Array(length), 3);
  made.setUsage(THREE.DynamicDrawUsage);
  geometry.setAttribute(name, made);
  return made;
}
export function fill(geometry, places, triangles) {
  const position = put(geometry, "position", places.length);
  if (position.array !== places) position.array.set(places);
  position.needsUpdate = true;
  if (!triangles) return;
  const normal = put(geometry, "normal", places.length);
  normals(places, triangles, normal.array);
  normal.needsUpdate = true;
}
export function shape({vertices, triangles, uv}) {
  const geometry = new THREE.BufferGeometry(), places = unpack(vertices), elem = unpack(triangles);
  geometry.setIndex(new THREE.BufferAttribute(elem, 1));
  fill(geometry, places, elem);
  if (uv) geometry.setAttribute("uv", new THREE.BufferAttribute(unpack(uv), 2));
  return geometry;
}

// The same with edges where faces meet at more than 35 degrees: hard things have some.
export function creased(geometry) {
  const flat = geometry.toNonIndexed(), {array} = flat.attributes.position, n = array.length / 9, near = new Map();
  const face = new Float32Array(3 * n);
  for (let i = 0; i < n; i++) {
    const [u, v] = [1, 2].map(k => [0, 1, 2].map(j => array[9 * i + 3 * k + j] - array[9 * i + j]));
    face.set(unit(cross(u, v)), 3 * i);
    for (let k = 0; k < 3; k++) {
      const key = [0, 1, 2].map(j => Math.round(1e6 * array[9 * i + 3 * k + j])).join();
      if (!near.has(key)) near.set(key, []);
      near.get(key).push(i);
    }
  }
  const normal = new Float32Array(array.length);
  for (let v = 0; v < 3 * n; v++) {
    const i = Math.floor(v / 3), key = [0, 1, 2].map(j => Math.round(1e6 * array[3 * v + j])).join();
    for (const k of near.get(key)) {
      const same = face[3 * i] * face[3 * k] + face[3 * i + 1] * face[3 * k + 1] + face[3 * i + 2] * face[3 * k + 2];
      if (same > 0.82) for (let j = 0; j < 3; j++) normal[3 * v + j] += face[3 * k + j];
    }
  }
  flat.setAttribute("normal", new THREE.BufferAttribute(normal, 3));
  flat.normalizeNormals();
  return flat;
}

export function normals(x, t, out) {
  out.fill(0);
  for (let i = 0; i < t.length; i += 3) {
    const a = 3 * t[i], b = 3 * t[i + 1], c = 3 * t[i + 2];
    const u0 = x[b] - x[a], u1 = x[b + 1] - x[a + 1], u2 = x[b + 2] - x[a + 2];
    const v0 = x[c] - x[a], v1 = x[c + 1] - x[a + 1], v2 = x[c + 2] - x[a + 2];
    const l = u1 * v2 - u2 * v1, m = u2 * v0 - u0 * v2, n = u0 * v1 - u1 * v0;
    for (let k = 0; k < 3; k++) {
      const at = 3 * t[i + k];
      out[at] += l;
      out[at + 1] += m;
      out[at + 2] += n;
    }
  }
  for (let i = 0; i < out.length; i += 3) {
    const size = Math.hypot(out[i], out[i + 1], out[i + 2]) || 1;
    out[i] /= size;
    out[i + 1] /= size;
    out[i + 2] /= size;
  }
}
