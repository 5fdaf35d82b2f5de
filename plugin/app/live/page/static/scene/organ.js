// An organ: what is drawn for it, its mesh, and what cuts have opened.
import * as THREE from "../three/three.module.min.js";
import {fill, put, unpack} from "./geometry.js";
import {add, cross, scale, sub, unit} from "./vectors.js";

export class Organ {
  // `surface` makes the material of a look, on a side.
  constructor(world, {look, inside, topology, smooth, count, profile}, surface) {
    this.profile = [...profile, ...profile.map(([far, high]) => [far, -high]).reverse()];  // of the lips of cuts
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
    const raw = surface({rgba: [...inside.slice(0, 3), 1], specular: 0.7, shininess: 0.8}, THREE.DoubleSide);
    [this.walls, this.rims] = [0, 1].map(() => new THREE.Mesh(new THREE.BufferGeometry(), raw));
    for (const each of [this.skin, this.mesh, this.walls, this.rims]) each.frustumCulled = false;
    world.add(this.skin, this.mesh, this.walls, this.rims);
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
    this.ends = new Map([...new Set(this.lips)].map((v, i) => [v, i]));
    const n = this.profile.length, band = [];
    for (let i = 0; i < this.lips.length; i += 2) {
      const [a, b] = [0, 1].map(k => n * this.ends.get(this.lips[i + k]));
      for (let k = 0; k < n - 1; k++) band.push(a + k, b + k, b + k + 1, a + k, b + k + 1, a + k + 1);
    }
    this.rims.geometry.setIndex(band);
    this.walls.geometry.setIndex(new THREE.BufferAttribute(this.opened, 1));
    return open.filter(v => !before.has(v));
  }

  // Lays the surfaces over its nodes, or the mesh alone.
  drape(nodes, wire) {
    const {skin, mesh, walls, rims, smooth} = this;
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
    rims.visible = !wire && this.lips.length > 0;
    walls.visible = !wire && this.opened.length > 0;
    if (rims.visible) fill(rims.geometry, profiles(this.profile, this.lips, this.ends, nodes, skin.geometry.attributes.normal.array), rims.geometry.index.array);
    if (walls.visible) fill(walls.geometry, nodes, this.opened);
  }
}

// Places of the lips of cuts: a profile at each vertex, as in palpate/engine/cutting/walls.py.
function profiles(profile, lips, ends, x, normal) {
  const at = (array, v) => [array[3 * v], array[3 * v + 1], array[3 * v + 2]];
  const inward = new Map([...ends.keys()].map(v => [v, [0, 0, 0]])), ahead = new Map(inward), out = new Float32Array(3 * profile.length * ends.size);
  for (let i = 0; i < lips.length; i += 2) {
    const along = unit(sub(at(x, lips[i + 1]), at(x, lips[i])));
    for (const [v, sign] of [[lips[i], -1], [lips[i + 1], 1]]) {
      inward.set(v, add(inward.get(v), cross(at(normal, v), along)));
      ahead.set(v, add(ahead.get(v), scale(along, sign)));
    }
  }
  for (const [v, k] of ends) {
    const into = unit(Math.hypot(...inward.get(v)) < 0.7 ? ahead.get(v) : inward.get(v));
    profile.forEach(([far, high], j) => out.set(add(at(x, v), add(scale(into, far), scale(at(normal, v), high))), 3 * (profile.length * k + j)));
  }
  return out;
}
