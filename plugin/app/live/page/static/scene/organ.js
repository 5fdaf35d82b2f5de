// An organ: what is drawn for it, its mesh, and what cuts have opened.
import * as THREE from "../three/three.module.min.js";
import {fill, normals, put, unpack} from "./geometry.js";
import {add, dot, scale, sub} from "./vectors.js";

const LIP = 8e-4;  // width of the edge of a cut [m]

export class Organ {
  // `surface` makes the material of a look, on a side.
  constructor(world, {look, inside, topology, smooth, count}, surface) {
    this.count = 3 * count;  // numbers of all vertices that there may be
    this.smooth = smooth && {
      from: unpack(smooth.indptr), nodes: unpack(smooth.indices), share: unpack(smooth.data), count: unpack(smooth.indptr).length - 1,
    };
    this.skin = new THREE.Mesh(new THREE.BufferGeometry(), surface(look, smooth ? THREE.FrontSide : THREE.DoubleSide));
    if (smooth) {
      this.skin.geometry.setIndex(new THREE.BufferAttribute(unpack(smooth.triangles), 1));
      put(this.skin.geometry, "position", 3 * this.smooth.count);
      if (smooth.uv) this.skin.geometry.setAttribute("uv", new THREE.BufferAttribute(unpack(smooth.uv), 2));
    }
    this.mesh = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({wireframe: true, color: 0xf0b8a0}));
    this.walls = new THREE.Mesh(new THREE.BufferGeometry(), surface({rgba: [...inside.slice(0, 3), 1], specular: 0.7, shininess: 0.8}, THREE.DoubleSide));
    for (const each of [this.skin, this.mesh, this.walls]) each.frustumCulled = false;
    world.add(this.skin, this.mesh, this.walls);
    this.sew(topology);
  }

  // Takes the triangles; after a cut its own surface is drawn, for a skin knows of no cut. Returns the vertices that have opened.
  sew({triangles, outer, lips, uv}) {
    const elem = unpack(triangles), before = new Set([...this.lips ?? [], ...this.opened ?? []]);
    this.lips = unpack(lips);
    this.elem = elem.subarray(0, 3 * outer);
    this.opened = elem.subarray(3 * outer);
    const open = [...this.lips, ...this.opened];
    if (open.length) this.smooth = null;
    this.mesh.geometry.setIndex(new THREE.BufferAttribute(this.elem, 1));
    if (this.smooth) return [];
    if (this.skin.geometry.index) {
      this.skin.geometry.dispose();
      this.skin.geometry = new THREE.BufferGeometry();
      this.skin.material.side = THREE.DoubleSide;
      this.skin.material.needsUpdate = true;
    }
    this.skin.geometry.setIndex(new THREE.BufferAttribute(this.elem, 1));
    if (uv) this.skin.geometry.setAttribute("uv", new THREE.BufferAttribute(unpack(uv), 2));
    const n = this.lips.length / 3, quads = [];
    for (let i = 0; i < n; i++) quads.push(4 * i, 4 * i + 1, 4 * i + 2, 4 * i, 4 * i + 2, 4 * i + 3);
    this.walls.geometry.setIndex(n ? quads : new THREE.BufferAttribute(this.opened, 1));
    return open.filter(v => !before.has(v));
  }

  // Lays the surfaces over its nodes, or the mesh alone.
  drape(nodes, wire) {
    const {skin, mesh, walls, smooth} = this;
    skin.visible = !wire;
    mesh.visible = wire;
    if (wire) fill(mesh.geometry, nodes, null);
    this.nodes = nodes;
    if (smooth) {
      const out = skin.geometry.attributes.position.array, {from, nodes: near, share, count} = smooth;
      for (let i = 0; i < count; i++) {
        let x = 0, y = 0, z = 0;
        for (let k = from[i]; k < from[i + 1]; k++) {
          const j = 3 * near[k], s = share[k];
          x += s * nodes[j];
          y += s * nodes[j + 1];
          z += s * nodes[j + 2];
        }
        out[3 * i] = x;
        out[3 * i + 1] = y;
        out[3 * i + 2] = z;
      }
      fill(skin.geometry, out, skin.geometry.index.array);
    } else {
      fill(skin.geometry, nodes, this.elem);
    }
    walls.visible = !wire && (this.lips.length > 0 || this.opened.length > 0);
    if (!walls.visible) return;
    if (this.lips.length) fill(walls.geometry, ribbons(this.lips, nodes), walls.geometry.index.array);
    else fill(walls.geometry, nodes, this.opened);
  }
}

// Quads along opened edges: start, end, and both moved into their triangle.
function ribbons(lips, x) {
  const out = new Float32Array(4 * lips.length);
  for (let i = 0; i < lips.length; i += 3) {
    const [a, b, c] = [0, 1, 2].map(k => [0, 1, 2].map(j => x[3 * lips[i + k] + j]));
    const along = sub(b, a), side = sub(c, a), inward = sub(side, scale(along, dot(side, along) / Math.max(dot(along, along), 1e-12)));
    const step = scale(inward, LIP / Math.max(Math.hypot(...inward), 1e-9));
    [a, b, add(b, step), add(a, step)].forEach((p, k) => out.set(p, 4 * i + 3 * k));
  }
  return out;
}
