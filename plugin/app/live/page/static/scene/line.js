// A line that somebody draws on the organ with the pointer, to follow or to cut along: it goes with the tissue.
import * as THREE from "../three/three.module.min.js";
import {cross, dot} from "./vectors.js";

const MOST = 600, STEP = 0.0012, DOT = 7e-4;  // dots; between two, and of one [m]
const NEAR = 0.003, TOUCH = 0.02;  // of the tip that follows it [m], [N]
const COLOUR = 0xffd21f;

export class Line {
  constructor(world) {
    const material = new THREE.MeshBasicMaterial({color: COLOUR, depthTest: false, transparent: true});
    this.dots = new THREE.InstancedMesh(new THREE.SphereGeometry(1, 8, 6), material, MOST);
    this.dots.frustumCulled = false;
    this.dots.renderOrder = 1;
    world.add(this.dots);
    this.clear();
  }

  clear() {
    this.points = [];  // vertices of a triangle and their shares
    this.at = [];  // where they are now
    this.followed = new Set();
    this.sum = this.count = 0;
    this.dots.count = 0;
  }

  // Takes where a ray meets the organ's triangles first.
  add(eye, way, x, elem) {
    let best = Infinity, point = null;
    for (let i = 0; i < elem.length; i += 3) {
      const [a, b, c] = [3 * elem[i], 3 * elem[i + 1], 3 * elem[i + 2]];
      const u = [x[b] - x[a], x[b + 1] - x[a + 1], x[b + 2] - x[a + 2]], v = [x[c] - x[a], x[c + 1] - x[a + 1], x[c + 2] - x[a + 2]];
      const p = cross(way, v), size = dot(u, p);
      if (Math.abs(size) < 1e-14) continue;
      const from = [eye[0] - x[a], eye[1] - x[a + 1], eye[2] - x[a + 2]], s = dot(from, p) / size;
      if (s < 0 || s > 1) continue;
      const q = cross(from, u), r = dot(way, q) / size, far = dot(v, q) / size;
      if (r < 0 || s + r > 1 || far <= 0 || far >= best) continue;
      [best, point] = [far, {nodes: [elem[i], elem[i + 1], elem[i + 2]], share: [1 - s - r, s, r]}];
    }
    if (!point) return;
    const last = this.at.at(-1), here = place(point, x);
    if (this.points.length >= MOST || (last && Math.hypot(...here.map((y, k) => y - last[k])) < STEP)) return;
    this.points.push(point);
    this.at.push(here);
  }

  // Goes where the vertices are.
  drape(x) {
    this.at = this.points.map(point => place(point, x));
    this.at.forEach((at, i) => this.dots.setMatrixAt(i, new THREE.Matrix4().makeScale(DOT, DOT, DOT).setPosition(...at)));
    this.dots.count = this.at.length;
    this.dots.instanceMatrix.needsUpdate = true;
  }

  // Measures how well the tip follows it: the share that it has passed [-] and the mean distance [m] while it touches.
  measure({tip_x, tip_y, tip_z, force}) {
    if (force > TOUCH && this.at.length) {
      const far = this.at.map(([x, y, z]) => Math.hypot(x - tip_x, y - tip_y, z - tip_z));
      far.forEach((d, i) => d < NEAR && this.followed.add(i));
      this.sum += Math.min(...far);
      this.count++;
    }
    return [this.followed.size / Math.max(this.points.length, 1), this.sum / Math.max(this.count, 1)];
  }
}

const place = ({nodes, share}, x) => [0, 1, 2].map(k => share.reduce((sum, s, i) => sum + s * x[3 * nodes[i] + k], 0));
