// A thread as a tube, round and smooth through its nodes.
import * as THREE from "../three/three.module.min.js";
import {cross, dot, scale, sub, unit} from "./vectors.js";

const SIDES = 8, PIECES = 4;  // around, and from node to node

export class Thread {
  constructor(world, nodes, radius, material) {
    this.nodes = nodes;
    this.radius = radius;
    this.geometry = new THREE.BufferGeometry();
    const rings = PIECES * (nodes - 1) + 3, index = [];  // the first and the last one close the ends
    for (let i = 0; i < SIDES * (rings - 1); i++) {
      const beside = i - i % SIDES + (i + 1) % SIDES;
      index.push(i, beside, i + SIDES, beside, beside + SIDES, i + SIDES);
    }
    this.geometry.setIndex(index);
    for (const name of ["position", "normal"]) {
      this.geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(3 * SIDES * rings), 3).setUsage(THREE.DynamicDrawUsage));
    }
    const mesh = new THREE.Mesh(this.geometry, material);
    mesh.frustumCulled = false;
    world.add(mesh);
  }

  // Takes each node's place, and whether the thread is whole behind it.
  drape(n) {
    const {nodes, radius, geometry} = this, {position, normal} = geometry.attributes, pieces = PIECES * (nodes - 1);
    const node = k => 4 * Math.min(Math.max(k, 0), nodes - 1);
    let up = [0.36, 0.48, 0.8];  // is carried along without turning
    for (let ring = 0; ring < pieces + 3; ring++) {
      const at = Math.min(Math.max(ring - 1, 0), pieces), k = Math.min(Math.floor(at / PIECES), nodes - 2), s = at / PIECES - k;
      const [a, b, c, d] = [node(k - 1), node(k), node(k + 1), node(k + 2)], here = [0, 0, 0], way = [0, 0, 0];
      for (let j = 0; j < 3; j++) {  // Catmull and Rom's curve, and its derivative
        const [p, q, r, t] = [n[a + j], n[b + j], n[c + j], n[d + j]];
        const [u, v, w] = [(r - p) / 2, p - 2.5 * q + 2 * r - t / 2, (t - p) / 2 + 1.5 * (q - r)];
        here[j] = q + s * (u + s * (v + s * w));
        way[j] = u + s * (2 * v + s * 3 * w);
      }
      way.splice(0, 3, ...unit(way));
      up = unit(sub(up, scale(way, dot(up, way))));
      const side = cross(way, up), ends = ring === 0 || ring === pieces + 2 || (s > 0 && s < 1 && !n[b + 3]);
      for (let i = 0; i < SIDES; i++) {
        const x = Math.cos(2 * Math.PI * i / SIDES), y = Math.sin(2 * Math.PI * i / SIDES), to = 3 * (SIDES * ring + i);
        for (let j = 0; j < 3; j++) {
          const out = x * up[j] + y * side[j];
          normal.array[to + j] = out;
          position.array[to + j] = here[j] + (ends ? 0 : radius * out);
        }
      }
    }
    position.needsUpdate = normal.needsUpdate = true;
  }
}
