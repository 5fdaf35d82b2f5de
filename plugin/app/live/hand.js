// What the hand does: mouse, touch, keys and gamepad, as displacements [m] and speeds.

const KEYS = {
  ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowDown: [1, -1], ArrowUp: [1, 1], a: [0, -1], d: [0, 1],
  s: [1, -1], w: [1, 1], q: [2, -1], e: [2, 1], z: [3, -1], x: [3, 1],
};
const HOLD = {g: "grip", " ": "grip", r: "report", c: "clutch"};
const DEPTH = 2e-5;  // of the wheel [m]
const PINCH = 3e-4;  // of two fingers [m]
const ROLL = 0.01;  // [rad]
const MOST = 0.04;  // in a message [m]
const DEAD = 0.1;

export class Hand {
  constructor(canvas, view, head) {
    this.view = view;
    this.head = head;
    this.move = [0, 0, 0, 0];
    this.down = new Set();
    this.grip = false;
    this.fingers = new Map();
    this.said = "";
    canvas.addEventListener("pointerdown", event => this.press(canvas, event));
    canvas.addEventListener("pointermove", event => this.drag(event));
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
  }

  press(canvas, event) {
    canvas.focus();
    canvas.setPointerCapture(event.pointerId);
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    this.grip = event.button === 2;
  }

  drag(event) {
    const last = this.fingers.get(event.pointerId);
    if (!last) return;
    const [x, y] = [event.clientX - last[0], event.clientY - last[1]], view = this.view;
    this.fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (view.free) {
      const part = event.shiftKey ? view.shift : view.turn;
      part[0] -= 0.005 * x;
      part[1] += 0.005 * y;
    } else if (this.fingers.size > 1) {
      this.move[2] += PINCH * y / this.fingers.size;
    } else if (event.shiftKey) {
      this.move[3] += ROLL * x;
    } else {
      const size = view.pixel(this.head());
      this.move[0] += size * x;
      this.move[1] -= size * y;
    }
  }

  wheel(event) {
    event.preventDefault();
    if (this.view.free) this.view.zoom = Math.min(Math.max(this.view.zoom * Math.exp(1e-3 * event.deltaY), 0.2), 5);
    else this.move[2] += DEPTH * event.deltaY;
  }

  key(event, down) {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!(name in KEYS || name in HOLD)) return;
    event.preventDefault();
    if (down) this.down.add(name);
    else this.down.delete(name);
  }

  // Returns what to tell, null where nothing is new.
  say() {
    const rate = [0, 0, 0, 0], held = new Set(this.grip ? ["grip"] : []);
    for (const name of this.down) {
      if (name in KEYS) rate[KEYS[name][0]] += KEYS[name][1];
      else held.add(HOLD[name]);
    }
    for (const pad of navigator.getGamepads?.() ?? []) {
      if (!pad) continue;
      const stick = i => Math.abs(pad.axes[i] ?? 0) < DEAD ? 0 : pad.axes[i];
      [stick(0), -stick(1), stick(3), stick(2)].forEach((value, i) => rate[i] += value);
      ["grip", "report", "clutch"].forEach((name, i) => pad.buttons[i]?.pressed && held.add(name));
    }
    const move = this.move.map((x, i) => Math.min(Math.max(x, i < 3 ? -MOST : -3), i < 3 ? MOST : 3));
    this.move = [0, 0, 0, 0];
    const words = {type: "hand", move, rate: rate.map(x => Math.min(Math.max(x, -1), 1)), buttons: [...held]};
    const rest = JSON.stringify([words.rate, words.buttons]);
    if (rest === this.said && move.every(x => x === 0)) return null;
    this.said = rest;
    return words;
  }
}
