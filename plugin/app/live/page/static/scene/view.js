// Draws a scene: tissue that moves, scenery that does not, instruments and marks. The server says where
// things are; what a laparoscope adds to that, its lamp, wet surfaces and smoke, is made here.
import * as THREE from "../three/three.module.min.js";
import {Blood} from "./blood.js";
import {creased, normals, shape, unpack} from "./geometry.js";
import {Line} from "./line.js";
import {Organ} from "./organ.js";
import {Thread} from "./thread.js";
import {add, dot, scale, sub} from "./vectors.js";

const NODE = 4, BODY = 12, SITE = 19;  // numbers of a thread's node, a body and a site in a frame
const BESIDE = 0.006;  // from the lens to its lamp [m]
const EXPERT = 0x59f2bf;
const SHADES = 4, DARK = 0.6, SOFT = 0.006, LONG = 0.05;  // contact shadows: most, depth, reach [m], length of shaft [m]
const PUFFS = 24, LASTS = 1.6;  // of smoke, and how long [s]
const NEAR = 0.005, FAR = 2;  // [m]
// Light is added up on colours as they are, as MuJoCo's renderer does: tissue looks as in the films.
THREE.ColorManagement.enabled = false;
// A scene's lights fade as MuJoCo's do, a + b d^2; `distance` and `decay` of a light carry a and b.
THREE.ShaderChunk.lights_pars_begin = THREE.ShaderChunk.lights_pars_begin.replace(
  /(float getDistanceAttenuation\([^{]*\{)[\s\S]*?\n}/,
  "$1\n\treturn 1.0 / (cutoffDistance + decayExponent * lightDistance * lightDistance);\n}",
);

// Returns the parts of a frame: the nodes of the first organ and of all others, threads' nodes, bodies and sites.
export function parts({head, organs, threads, bodies, sites}, frame) {
  const strands = threads.reduce((sum, {nodes}) => sum + NODE * nodes, 0);
  const others = organs.slice(1).reduce((sum, {count}) => sum + 3 * count, 0);
  const sizes = [others, strands, BODY * bodies, SITE * sites.length], free = frame.length - sizes.reduce((a, b) => a + b, head.length);
  let at = head.length;
  return [free, ...sizes].map(size => frame.subarray(at, at += size));
}

export class View {
  // Throws where the browser has no WebGL 2. `wet` asks for the full picture from a processor too.
  constructor(canvas, wet) {
    this.canvas = canvas;
    this.slow = drawnByProcessor() && !wet;
    this.patient = wet;  // however long a picture takes
    this.gl = new THREE.WebGLRenderer({canvas, antialias: !this.slow, powerPreference: "high-performance"});
    this.gl.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.gl.toneMapping = THREE.NeutralToneMapping;
    this.gl.toneMappingExposure = 1.15;
    this.camera = new THREE.PerspectiveCamera(45, 1, NEAR, FAR);
    this.camera.matrixAutoUpdate = false;
    this.wire = this.free = this.pen = false;
    this.wet = !this.slow;  // wet tissue and mirrors, or what is fast to draw
    this.mirror = this.wet ? reflections(this.gl) : null;
    this.size = [canvas.clientWidth, canvas.clientHeight];
    new ResizeObserver(() => this.size = [canvas.clientWidth, canvas.clientHeight]).observe(canvas);
    this.home();
  }

  // The free view where the laparoscope is.
  home() {
    this.turn = [0, 0];
    this.shift = [0, 0];
    this.zoom = 1;
  }

  // What the picture depends on beside the frame.
  state() {
    const {size, wire, free, turn, shift, zoom, smoke, blood, line} = this;
    const smoking = smoke?.some(puff => puff.visible) || blood?.flows ? performance.now() : 0;
    return JSON.stringify([size, wire, free, turn, shift, zoom, smoking, line?.points.length]);
  }

  scale(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 5);
  }

  // Draws with fewer pixels from now on, where drawing is too slow.
  hurry() {
    if (!this.patient) this.fine = Math.max(0.7 * this.fine, 0.5);
  }

  load(scene) {
    this.fine = this.slow ? 1 : Math.min(devicePixelRatio || 1, 2);  // pixels for one of the page
    this.world?.traverse(each => {
      each.geometry?.dispose();
      each.material?.dispose();
    });
    this.papers?.forEach(paper => paper.dispose());
    this.scene = scene;
    this.shades = {value: scene.tips.slice(0, SHADES).flatMap(() => [new THREE.Vector3(9, 9, 9), new THREE.Vector3(9, 9, 9)])};
    this.world = new THREE.Scene();
    this.world.background = new THREE.Color(0x120505);
    this.papers = new Map(Object.entries(scene.textures).map(([key, value]) => [Number(key), paper(value, this.wet)]));
    this.lenses = [];  // lamps that go with the eye
    for (const light of scene.lights) {
      const made = lamps(light);
      this.world.add(...made);
      if (light.pos && light.lens) this.lenses.push(made[1]);
    }
    for (const each of scene.scenery) {
      const material = this.surface(each.look);
      this.world.add(new THREE.Mesh(shape(each), this.wet ? shade(material, this.shades) : material));
    }
    this.parts = scene.parts.map(part => {
      const mesh = new THREE.Mesh(creased(shape(part.shape)), this.surface(part.look, true));
      mesh.matrixAutoUpdate = false;
      mesh.userData = part;
      return mesh;
    });
    this.marks = scene.sites.map(kind => {
      const mesh = new THREE.Mesh(FORMS[kind], new THREE.MeshStandardMaterial({transparent: true, roughness: 0.4}));
      mesh.matrixAutoUpdate = false;
      mesh.userData = kind;
      return mesh;
    });
    this.world.add(...this.parts, ...this.marks);
    this.threads = scene.threads.map(({nodes, radius, look}) => new Thread(this.world, nodes, radius, this.surface(look, true)));
    this.blood = new Blood(this.world, this.wet);
    this.line = new Line(this.world);
    const tissue = (look, side) => shade(this.surface(look, false, side), this.shades);
    this.organs = scene.organs.map(each => new Organ(this.world, each, tissue));
    this.lead();
    this.smoke = Array.from({length: PUFFS}, () => {
      const puff = new THREE.Sprite(new THREE.SpriteMaterial({map: cloud(), transparent: true, depthWrite: false, color: 0xd8d4d0}));
      puff.visible = false;
      this.world.add(puff);
      return puff;
    });
    this.puffed = this.blown = 0;
  }

  // Takes the triangles of an organ that was cut.
  sew({organ, ...topology}) {
    const opened = this.organs[organ].sew(topology);
    if (organ === 0) this.blood.open(opened);
  }

  // What shows the expert: the instrument, and its path.
  lead() {
    const material = new THREE.MeshBasicMaterial({color: EXPERT, transparent: true, opacity: 0.4});
    this.ghosts = this.parts.filter(part => part.userData.mine).map(part => {
      const ghost = new THREE.Mesh(part.geometry, material);
      ghost.matrixAutoUpdate = ghost.visible = false;
      ghost.userData = part;
      this.world.add(ghost);
      return ghost;
    });
    this.way = null;
  }

  // Returns how a surface is drawn, tissue or an instrument's.
  surface({rgba, specular, shininess, texture, repeat}, hard = false, side = THREE.FrontSide) {
    const color = new THREE.Color().setRGB(rgba[0], rgba[1], rgba[2]);
    const map = this.papers.get(texture) ?? null, metal = hard && specular > 0.85;
    if (map && repeat) map.repeat.set(...repeat);
    const common = {color, map, side, transparent: rgba[3] < 1, opacity: rgba[3]};
    if (!this.wet) {
      const shine = new THREE.Color(1, 1, 1).multiplyScalar(metal ? 0.9 : 0.35 * specular);
      return new THREE.MeshPhongMaterial({...common, specular: shine, shininess: 20 + 60 * shininess});
    }
    const rough = {roughness: metal ? 0.3 : 0.5, metalness: metal ? 0.75 : 0};
    const film = hard ? {clearcoat: metal ? 0 : 0.4, clearcoatRoughness: 0.3} : {
      clearcoat: 0.35 + specular, clearcoatRoughness: 0.32 - 0.15 * shininess, bumpMap: map, bumpScale: 1.2,
    };
    return new THREE.MeshPhysicalMaterial({...common, ...rough, ...film, envMap: hard ? this.mirror : null});
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

  // Draws a frame: its numbers, and those at its head by name.
  draw(frame, head, expert) {
    const {scene, camera, size: [width, height]} = this, pixels = [width, height, this.fine].join();
    let from = 0, first = 0;
    if (pixels !== this.pixels) {  // each time the browser makes room anew
      this.gl.setPixelRatio(this.fine);
      this.gl.setSize(width, height, false);
      this.pixels = pixels;
    }
    this.follow(frame);
    const {at, axes, fovy} = this.eye([head.tip_x, head.tip_y, head.tip_z]);
    camera.fov = fovy;
    camera.aspect = width / Math.max(height, 1);
    camera.updateProjectionMatrix();
    camera.matrix.makeBasis(...axes.map(axis => new THREE.Vector3(...axis))).setPosition(...at);
    camera.matrixWorldNeedsUpdate = true;
    const [nodes, others, threads, bodies, sites] = parts(scene, frame), [organ, ...more] = this.organs;
    this.nodes = nodes;
    organ.drape(nodes, this.wire);
    for (const each of more) each.drape(others.subarray(first, first += each.count), this.wire);
    for (const thread of this.threads) thread.drape(threads.subarray(from, from += NODE * thread.nodes));
    this.darken(bodies);
    for (const part of this.parts) {
      pose(part.matrix, bodies.subarray(BODY * part.userData.body));
      part.matrixWorldNeedsUpdate = true;
    }
    this.marks.forEach((mark, i) => place(mark, sites.subarray(SITE * i, SITE * (i + 1))));
    this.show(expert, head);
    this.fume(head.current > 0, bodies);
    this.stain();
    this.line.drape(this.nodes);
    this.gl.render(this.world, camera);
  }

  // Takes the laparoscope's view of a frame; its lamp is beside the lens.
  follow(frame) {
    const {camera, head} = this.scene, first = head.indexOf("eye_x");
    camera.pos = [...frame.subarray(first, first + 3)];
    camera.mat = [...frame.subarray(first + 3, first + 12)];
    const [right, , back] = [0, 1, 2].map(j => [camera.mat[j], camera.mat[3 + j], camera.mat[6 + j]]);
    for (const lamp of this.lenses) {
      lamp.position.set(...add(camera.pos, scale(right, BESIDE)));
      lamp.target.position.set(...sub(lamp.position.toArray(), back));
    }
  }

  // Where instruments are close to tissue, that is darker: their tips, and the shafts above them.
  darken(bodies) {
    this.scene.tips.slice(0, SHADES).forEach(([body, ...at], i) => {
      const from = pose(new THREE.Matrix4(), bodies.subarray(BODY * body)), [tip, end] = this.shades.value.slice(2 * i);
      tip.set(...at).applyMatrix4(from);
      end.set(at[0], at[1], at[2] + LONG).applyMatrix4(from);
    });
  }

  // The expert's way, and the instrument where the expert has it now.
  show(expert, head) {
    this.ghosts.forEach(ghost => ghost.visible = Boolean(expert));
    if (this.way) this.way.visible = Boolean(expert);
    if (!expert) return;
    if (this.way?.userData !== expert) {
      this.way?.removeFromParent();
      this.way = new THREE.InstancedMesh(FORMS.ball, new THREE.MeshBasicMaterial({color: EXPERT}), expert.path.length);
      expert.path.forEach((at, i) => this.way.setMatrixAt(i, new THREE.Matrix4().makeScale(6e-4, 6e-4, 6e-4).setPosition(...at)));
      this.way.userData = expert;
      this.way.frustumCulled = false;
      this.world.add(this.way);
    }
    const now = (performance.now() - expert.since) / 1e3 % (expert.time.at(-1) + 1);
    let k = expert.time.findIndex(t => t >= now);
    if (k < 0) k = expert.time.length - 1;
    const [x, y, z, ...quat] = expert.pose[k];
    const tip = rigid([head.tip_x, head.tip_y, head.tip_z], [head.tip_qw, head.tip_qx, head.tip_qy, head.tip_qz]);
    const move = rigid([x, y, z], quat).multiply(tip.invert());
    for (const ghost of this.ghosts) {
      ghost.matrix.multiplyMatrices(move, ghost.userData.matrix);
      ghost.matrixWorldNeedsUpdate = true;
    }
  }

  // Smoke rises from where a hook's current acts.
  fume(burns, bodies) {
    const now = performance.now() / 1e3, {smoke, scene} = this;
    this.blown = burns && scene.hooks.length ? Math.max(this.blown, now - LASTS) : now;
    if (this.blown < now) {
      const [body, ...tip] = scene.hooks[0];
      const at = new THREE.Vector3(...tip).applyMatrix4(pose(new THREE.Matrix4(), bodies.subarray(BODY * body)));
      this.blood.burn(at, this.nodes);
      for (; now - this.blown > LASTS / PUFFS; this.blown += LASTS / PUFFS) {  // several, where pictures are far apart
        const puff = smoke[this.puffed++ % PUFFS], away = () => 0.004 * (Math.random() - 0.5);
        puff.userData = {born: this.blown, speed: [away(), away(), 0.018 + away()], at};
        puff.visible = true;
      }
    }
    for (const puff of smoke) {
      if (!puff.visible) continue;
      const {born, speed, at} = puff.userData, age = now - born;
      puff.visible = age < LASTS;
      puff.position.set(at.x + speed[0] * age, at.y + speed[1] * age, at.z + speed[2] * age);
      puff.scale.setScalar(0.004 + 0.014 * age);
      puff.material.opacity = 0.4 * Math.max(1 - age / LASTS, 0);
    }
  }

  // Draws on to the organ where a pointer is, in pixels of the page.
  write({clientX, clientY}) {
    const {canvas, camera, nodes, line} = this, box = canvas.getBoundingClientRect();
    const x = 2 * (clientX - box.left) / box.width - 1, y = 1 - 2 * (clientY - box.top) / box.height;
    const from = new THREE.Vector3().setFromMatrixPosition(camera.matrix);
    const to = new THREE.Vector3(x, y, 0.5).applyMatrix4(camera.projectionMatrixInverse).applyMatrix4(camera.matrix);
    if (nodes) line.add(from.toArray(), to.sub(from).toArray(), nodes, this.organs[0].elem);
  }

  // Blood and char go with the vertices of the mesh; what is drawn smooth lies close to these.
  stain() {
    const {blood, nodes} = this, {elem} = this.organs[0], {length} = nodes;
    if (!blood.wounds.size && !blood.burns.size) return;
    if (this.outward?.length !== length) this.outward = new Float32Array(length);
    normals(nodes, elem, this.outward);
    blood.draw(nodes, this.outward, elem);
  }

  // How far a pixel is at the tip [m].
  pixel(head) {
    const {at, axes, fovy} = this.eye([head.tip_x, head.tip_y, head.tip_z]);
    const depth = dot(sub(at, [head.tip_x, head.tip_y, head.tip_z]), axes[2]);
    return 2 * Math.max(depth, 0.05) * Math.tan(fovy * Math.PI / 360) / this.canvas.clientHeight;
  }
}

// Whether there is no graphics card to draw with: wet surfaces would then cost most pictures.
function drawnByProcessor() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) throw new Error("no WebGL 2");
  const about = gl.getExtension("WEBGL_debug_renderer_info");
  const name = about ? gl.getParameter(about.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

// What marks are drawn as, of unit size.
const FORMS = {ball: new THREE.SphereGeometry(1, 20, 14), box: new THREE.BoxGeometry(2, 2, 2)};
FORMS.ellipsoid = FORMS.ball;
FORMS.cylinder = new THREE.CylinderGeometry(1, 1, 2, 20).rotateX(Math.PI / 2);

// A place and a matrix in rows, as MuJoCo has it.
const pose = (out, [x, y, z, a, b, c, d, e, f, g, h, i]) => out.set(a, b, c, x, d, e, f, y, g, h, i, z, 0, 0, 0, 1);

// Puts a mark where its numbers say: place, colour, size, matrix.
function place(mark, n) {
  mark.visible = n[6] > 0.05;
  if (!mark.visible) return;
  pose(mark.matrix, [n[0], n[1], n[2], ...n.subarray(10, 19)]);
  const [a, b, c] = n.subarray(7, 10), sizes = {ball: [a, a, a], cylinder: [a, a, b]};
  mark.matrix.scale(new THREE.Vector3(...sizes[mark.userData] ?? [a, b, c]));
  mark.matrixWorldNeedsUpdate = true;
  mark.material.color.setRGB(n[3], n[4], n[5]);
  mark.material.emissive.copy(mark.material.color).multiplyScalar(0.35);
  mark.material.opacity = n[6];
}

function rigid([x, y, z], [w, a, b, c]) {
  return new THREE.Matrix4().makeRotationFromQuaternion(new THREE.Quaternion(a, b, c, w)).setPosition(x, y, z);
}

// Darkens a surface softly near the capsules of `shades`: pairs of ends, in the world.
function shade(material, shades) {
  const count = shades.value.length / 2;
  if (!count) return material;
  material.customProgramCacheKey = () => `shades ${count}`;
  material.onBeforeCompile = shader => {
    shader.uniforms.shades = shades;
    shader.vertexShader = `varying vec3 shadeAt;\n${shader.vertexShader}`.replace(
      "#include <project_vertex>", "#include <project_vertex>\n\tshadeAt = (modelMatrix * vec4(transformed, 1.0)).xyz;");
    shader.fragmentShader = `varying vec3 shadeAt;
uniform vec3 shades[${2 * count}];
float shadeOf() {
\tfloat near = 1.0;
\tfor (int i = 0; i < ${count}; i++) {
\t\tvec3 along = shades[2 * i + 1] - shades[2 * i], from = shadeAt - shades[2 * i];
\t\tfloat far = distance(from, along * clamp(dot(from, along) / max(dot(along, along), 1e-9), 0.0, 1.0)) / ${SOFT};
\t\tnear = min(near, 1.0 - exp(-0.5 * far * far));
\t}
\treturn 1.0 - ${DARK} * (1.0 - near);
}
${shader.fragmentShader}`.replace("#include <opaque_fragment>", "outgoingLight *= shadeOf();\n\t#include <opaque_fragment>");
  };
  return material;
}

// Pictures and lights.
function paper({width, height, pixels}, fine) {
  const rgb = unpack(pixels), rgba = new Uint8Array(4 * width * height).fill(255);
  for (let i = 0; i < width * height; i++) rgba.set(rgb.subarray(3 * i, 3 * i + 3), 4 * i);
  const texture = new THREE.DataTexture(rgba, width, height);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.magFilter = THREE.LinearFilter;
  texture.minFilter = fine ? THREE.LinearMipmapLinearFilter : THREE.LinearMipmapNearestFilter;
  texture.generateMipmaps = true;
  texture.anisotropy = fine ? 8 : 1;
  texture.needsUpdate = true;
  return texture;
}

function lamps({pos, dir, directed, cutoff, fade, colour, around}) {
  const made = [], tone = rgb => new THREE.Color().setRGB(...rgb);
  made.push(new THREE.AmbientLight(tone(around), 1.8));
  if (!pos) return made;
  let lamp;
  if (directed) lamp = new THREE.DirectionalLight(tone(colour), 2.2);
  else {
    lamp = new THREE.SpotLight(tone(colour), 4, fade[0] + fade[1] * 0.15, Math.min(cutoff, 85) * Math.PI / 180, 0.9, fade[2]);
  }
  lamp.position.set(...pos);
  lamp.target.position.set(...add(pos, dir));
  made.push(lamp, lamp.target);
  return made;
}

// What steel mirrors: a cavity of tissue, and the lamp.
function reflections(gl) {
  const room = new THREE.Scene(), maker = new THREE.PMREMGenerator(gl);
  const box = (size, at, color) => {
    const mesh = new THREE.Mesh(new THREE.BoxGeometry(...size), new THREE.MeshBasicMaterial({color, side: THREE.DoubleSide}));
    mesh.position.set(...at);
    room.add(mesh);
  };
  box([10, 10, 10], [0, 0, 0], new THREE.Color(0.22, 0.12, 0.1));
  box([3, 3, 0.1], [1, 2, 4.5], new THREE.Color(9, 8.8, 8.4));
  box([0.1, 2, 6], [-4.8, 1, 0], new THREE.Color(1.4, 1.3, 1.2));
  const made = maker.fromScene(room, 0.03).texture;
  maker.dispose();
  return made;
}

let puff = null;
function cloud() {
  if (puff) return puff;
  const size = 64, pixels = new Uint8Array(4 * size * size);
  for (let i = 0; i < size * size; i++) {
    const far = Math.hypot(i % size - size / 2, Math.floor(i / size) - size / 2) / (size / 2);
    pixels.set([255, 255, 255, 255 * Math.max(1 - far, 0) ** 2], 4 * i);
  }
  puff = new THREE.DataTexture(pixels, size, size);
  puff.needsUpdate = true;
  return puff;
}
