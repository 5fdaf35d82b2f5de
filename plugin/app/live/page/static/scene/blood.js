// What cuts and currents leave on tissue: beads of blood that grow and run down, and char. Drawn only.
import * as THREE from "../three/three.module.min.js";

const MOST = 200;  // beads and spots of char
const VESSELS = 4;  // of so many vertices of a cut one bleeds
const GROWS = 6, RUNS = 1.5, FAR = 4;  // of a bead [s], between one and the next below [s], at most so many
const SIZE = 0.0013, SPOT = 0.002;  // [m]
const BLOOD = 0x6d0a0c, CHAR = 0x1c100c;

export class Blood {
  constructor(world, wet) {
    const Material = wet ? THREE.MeshPhysicalMaterial : THREE.MeshPhongMaterial;
    const bead = new THREE.SphereGeometry(1, 14, 8);
    this.beads = new THREE.InstancedMesh(bead, new Material(wet ? {color: BLOOD, roughness: 0.18, clearcoat: 1} : {color: BLOOD, shininess: 90}), MOST);
    this.spots = new THREE.InstancedMesh(bead, new Material({color: CHAR}), MOST);
    for (const mesh of [this.beads, this.spots]) {
      mesh.count = 0;
      mesh.frustumCulled = false;
      world.add(mesh);
    }
    this.wounds = new Map();  // vertex -> when it began, size, how far down it may run, what it came from
    this.burns = new Set();
    this.near = null;
  }

  // Vertices that a cut has opened; they bleed where a vessel was.
  open(vertices) {
    this.near = null;  // the triangles are others
    for (const v of vertices) if (v * 2654435761 % 2 ** 32 % VESSELS === 0) this.wound(v, 0.7 + (v % 7) / 10, FAR);
  }

  wound(v, size, far) {
    if (!this.wounds.has(v) && this.wounds.size < MOST) this.wounds.set(v, {since: performance.now() / 1e3, size, far, ran: false});
  }

  // A current acts at a place; what it does to tissue begins at the vertex that is nearest.
  burn(at, x) {
    let best = 0.004 ** 2, v = -1;
    for (let i = 0; i < x.length; i += 3) {
      const far = (x[i] - at.x) ** 2 + (x[i + 1] - at.y) ** 2 + (x[i + 2] - at.z) ** 2;
      if (far < best) [best, v] = [far, i / 3];
    }
    if (v < 0 || this.burns.size >= MOST || this.burns.has(v)) return;
    this.burns.add(v);
    if (v % 4 === 0) this.wound(v, 0.5, 1);
  }

  // Lays them on the tissue; `x` and `normal` are those of the vertices.
  draw(x, normal, elem) {
    const now = performance.now() / 1e3, turn = new THREE.Quaternion(), up = new THREE.Vector3(0, 0, 1), way = new THREE.Vector3();
    const put = (mesh, v, size, flat) => {
      way.set(normal[3 * v], normal[3 * v + 1], normal[3 * v + 2]);
      turn.setFromUnitVectors(up, way);
      const place = new THREE.Vector3(x[3 * v], x[3 * v + 1], x[3 * v + 2]);
      mesh.setMatrixAt(mesh.count++, new THREE.Matrix4().compose(place, turn, new THREE.Vector3(size, size, flat * size)));
    };
    this.beads.count = this.spots.count = 0;
    for (const [v, wound] of [...this.wounds]) {
      const age = now - wound.since;
      put(this.beads, v, SIZE * wound.size * Math.min(0.25 + age / GROWS, 1), 0.35);
      if (wound.far && !wound.ran && age > RUNS) {
        wound.ran = true;
        const below = this.below(v, x, elem);
        if (below !== v) this.wound(below, 0.8 * wound.size, wound.far - 1);
      }
    }
    for (const v of this.burns) put(this.spots, v, SPOT, 0.12);
    this.beads.instanceMatrix.needsUpdate = this.spots.instanceMatrix.needsUpdate = true;
  }

  // Whether there is something that changes by itself.
  get flows() {
    const now = performance.now() / 1e3;
    return [...this.wounds.values()].some(({since}) => now - since < GROWS + RUNS);
  }

  // The neighbour of a vertex that lies lowest, or itself.
  below(v, x, elem) {
    if (!this.near) {
      this.near = new Map();
      for (let i = 0; i < elem.length; i += 3) {
        for (let k = 0; k < 3; k++) {
          const a = elem[i + k];
          if (!this.near.has(a)) this.near.set(a, new Set());
          this.near.get(a).add(elem[i + (k + 1) % 3]).add(elem[i + (k + 2) % 3]);
        }
      }
    }
    return [...this.near.get(v) ?? []].reduce((low, w) => x[3 * w + 2] < x[3 * low + 2] ? w : low, v);
  }
}
