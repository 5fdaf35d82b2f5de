// What the hands do: mouse, touch, keys, buttons and gamepad, as displacements [m] and speeds: to the right, up, towards
// the person, about the shaft and, of a wrist, up and to the right.

const AXES = 6, WRIST = 4;  // of them, where those of a wrist begin
const KEYS = {
  ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowDown: [1, -1], ArrowUp: [1, 1], a: [0, -1], d: [0, 1],
  s: [1, -1], w: [1, 1], q: [2, -1], e: [2, 1], z: [3, -1], x: [3, 1],
};
const SCOPE = {
  j: [0, -1], l: [0, 1], k: [1, -1], i: [1, 1], u: [2, -1], o: [2, 1], n: [3, -1], m: [3, 1],
};
const TILT = {b: 1, v: -1};  // of the camera, against the scope
const HOLD = {g: "grip", " ": "grip", r: "report", c: "clutch"};
const DEPTH = 2e-5;  // of the wheel [m]
const PINCH = 3e-4;  // of two fingers [m]
const ROLL = 0.01, TURN = 1e-3;  // of a drag and of the wheel [rad]
const MOST = [0.04, 0.04, 0.04, 3, 3, 3];  // in a message [m], [rad]
const DEAD = 0.1;
const MOVES = "onpointerrawupdate" in window ? "pointerrawupdate" : "pointermove";  // the latter waits for a picture
const CALM = 0.5;  // share of a hand's speed that the laparoscope's keys have
const TILTS = 0.2;  // of the camera, half turns a second
const still = () => Array(AXES).fill(0);
export const CLOCK = 1e6;  // in which the clock of messages goes round [ms]

export class Hand {
  constructor(canvas, pad, view, head) {
    this.view = view;
    this.head = head;
    this.move = still();
    this.down = new Set();
    this.grip = false;
    this.fingers = new Map();
    this.pressed = new Set();  // buttons of the page
    this.said = {};
    this.since = null;  // of the first movement that was not told yet
    this.left = "";  // what is in the left hand: keyboard, pad
    this.scope = false;  // whether what moves the instrument moves the laparoscope
    this.turns = false;  // whether the instrument itself is one, whose camera turns
    this.wrist = false;  // whether it has one
    this.begin();
    canvas.addEventListener("pointerdown", event => this.press(canvas, event));
    canvas.addEventListener(MOVES, event => this.drag(event));
    for (const kind of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, event => {
        this.fingers.delete(event.pointerId);
        this.grip = false;
      });
    }
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("wheel", event => this.wheel(event), {passive: false});
    canvas.addEventListener("keydown", event => this.key(event, true));
    canvas.addEventListener("keyup", event => this.key(event, false));
    canvas.addEventListener("blur", () => this.down.clear());
    for (const button of pad.querySelectorAll("button")) this.button(button);
  }

  // An exercise begins, or what follows begins or ends: the camera is not turned.
  begin() {
    this.tilt = 0;  // of the camera, half turns
    this.tilted = performance.now();
  }

  // A button is held; the one that grips stays closed until it is pressed again.
  button(button) {
    const hold = on => {
      button.classList.toggle("held", on);
      if (on) this.pressed.add(button);
      else this.pressed.delete(button);
    };
    button.addEventListener("contextmenu", event => event.preventDefault());
    button.addEventListener("pointerdown", event => {
      event.preventDefault();
      hold(button.dataset.hold !== "grip" || !this.pressed.has(button));
    });
    for (const kind of ["pointerup", "pointercancel", "pointerleave"]) {
      button.addEventListener(kind, () => button.dataset.hold !== "grip" && hold(false));
    }
  }

  release() {
    for (const button of this.pressed) button.classList.remove("held");
    this.pressed.clear();
    this.said = {};
  }

  press(canvas, event) {
    canvas.focus();
    if (event.isTrusted) canvas.setPointerCapture(event.pointerId);
    if (event.pointerType === "touch") document.body.classList.add("touch");
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.view.pen) this.view.write(event);
    this.grip = event.button === 2 && !this.view.free;
    this.aside = event.button === 2 || event.shiftKey;
  }

  drag(event) {
    const last = this.fingers.get(event.pointerId);
    if (!last) return;
    if (this.view.pen) return this.view.write(event);
    const [x, y] = [event.clientX - last[0], event.clientY - last[1]], view = this.view;
    const before = this.span();
    this.since ??= event.timeStamp;
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    const two = this.fingers.size > 1, now = this.span();
    if (view.free) {
      if (two) view.scale(before.far / Math.max(now.far, 1));
      const part = two || this.aside ? view.shift : view.turn, share = two ? 0.0012 : 0.005;
      part[0] -= share * x;
      part[1] += share * y;
    } else if (two) {
      this.move[2] += PINCH * y / this.fingers.size;
      this.move[3] += Math.atan2(Math.sin(now.angle - before.angle), Math.cos(now.angle - before.angle));
    } else if (event.shiftKey) {
      this.move[3] += ROLL * x;
      if (this.wrist) this.move[WRIST] -= ROLL * y;
    } else {
      const size = view.pixel(this.head());
      this.move[0] += size * x;
      this.move[1] -= size * y;
    }
  }

  // How far two fingers are apart [pixels], and the angle of the line between them.
  span() {
    const [a, b] = [...this.fingers.values()];
    return b ? {far: Math.hypot(b[0] - a[0], b[1] - a[1]), angle: Math.atan2(a[1] - b[1], b[0] - a[0])} : {far: 1, angle: 0};
  }

  wheel(event) {
    event.preventDefault();
    this.since ??= event.timeStamp;
    if (this.view.free) this.view.scale(Math.exp(1e-3 * event.deltaY));
    else if (this.wrist && event.shiftKey) this.move[WRIST + 1] += TURN * (event.deltaY || event.deltaX);
    else this.move[2] += DEPTH * event.deltaY;
  }

  key(event, down) {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (name !== "Shift" && ![KEYS, HOLD, SCOPE, TILT].some(keys => name in keys)) return;
    event.preventDefault();
    if (down) this.down.add(name);
    else this.down.delete(name);
  }

  keys() {
    const rate = still(), held = [], turned = this.wrist && this.down.has("Shift");
    for (const name of this.down) {
      if (name in KEYS) {
        const [axis, way] = KEYS[name];
        rate[turned && axis < 2 ? WRIST + 1 - axis : axis] += way;
      } else if (name in HOLD) held.push(HOLD[name]);
    }
    return {rate, held};
  }

  // Keys that move the laparoscope.
  view_keys() {
    const rate = still();
    for (const name of this.down) if (name in SCOPE) rate[SCOPE[name][0]] += CALM * SCOPE[name][1];
    return {rate, held: []};
  }

  // Turns the camera for as long as keys or buttons ask for it.
  lean() {
    const now = performance.now(), buttons = [...this.pressed].map(({dataset}) => Number(dataset.tilt ?? 0));
    const way = buttons.reduce((a, b) => a + b, 0) + [...this.down].reduce((sum, name) => sum + (TILT[name] ?? 0), 0);
    this.tilt = Math.min(Math.max(this.tilt + way * TILTS * Math.min(now - this.tilted, 100) / 1e3, -1), 1);
    this.tilted = now;
  }

  pads() {
    const rate = still(), held = [];
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad) continue;
      const stick = i => Math.abs(pad.axes[i] ?? 0) < DEAD ? 0 : pad.axes[i];
      [stick(0), -stick(1), stick(3), stick(2)].forEach((value, i) => rate[i] += value);
      const cross = i => Number(pad.buttons[i]?.pressed ?? 0);  // up, down, left, right
      if (this.wrist) [cross(12) - cross(13), cross(15) - cross(14)].forEach((way, i) => rate[WRIST + i] += way);
      ["grip", "report", "clutch"].forEach((name, i) => pad.buttons[i]?.pressed && held.push(name));
    }
    return {rate, held};
  }

  buttons() {
    const rate = still(), held = this.grip ? ["grip"] : [];
    for (const {dataset} of this.pressed) {
      if (dataset.hold) held.push(dataset.hold);
      else if (dataset.rate) {
        const [axis, way] = dataset.rate.split(",").map(Number);
        rate[axis] += way;
      }
    }
    return {rate, held};
  }

  // Returns what to tell.
  say() {
    const {left} = this, keys = this.keys(), pads = this.pads(), right = [this.buttons()];
    const move = this.move.map((x, i) => Math.min(Math.max(x, -MOST[i]), MOST[i]));
    this.move = still();
    if (left !== "keyboard") right.push(keys);
    if (left !== "pad") right.push(pads);
    this.lean();
    const views = [this.view_keys()];
    if (this.scope) views.push(...right);
    const none = still(), tilt = this.tilt;
    const out = [this.words("scope", views, this.scope ? move : none, tilt)];
    if (this.scope) out.push(this.words("right", [], none));
    else out.push(this.words("right", right, move, this.turns ? tilt : undefined));
    if (left === "keyboard") out.push(this.words("left", [keys], none));
    if (left === "pad") out.push(this.words("left", [pads], none));
    this.since = null;
    return out.filter(Boolean);
  }

  // Returns the message about a hand, null where nothing is new.
  words(which, sources, move, jaw) {
    const rate = still().map((_, i) => Math.min(Math.max(sources.reduce((sum, s) => sum + s.rate[i], 0), -1), 1));
    const buttons = [...new Set(sources.flatMap(s => s.held))], rest = JSON.stringify([rate, buttons, jaw]);
    if (rest === this.said[which] && move.every(x => x === 0)) return null;
    this.said[which] = rest;
    return {type: "hand", which, move, rate, buttons, jaw, at: (this.since ?? performance.now()) % CLOCK};
  }
}
