// The page: picks an exercise, shows it and sends what the hands do.
import {kept, show} from "./card.js";
import {CLOCK, Hand} from "./hand.js";
import {Plot} from "./plots.js";
import {View} from "./view.js";

const $ = id => document.getElementById(id);
const STATES = ["waiting", "ready", "clutch", "lost", "paused"];
const MEAN = 0.3;  // over which steps are counted [s]
const AGAIN = 2000;  // between tries to reach the program [ms]
const WORDS = 100;  // between numbers in words, which are laid out anew [ms]
const ENOUGH = 40, PROMPT = 0.9;  // frames to judge by whether most of them are drawn
const KEPT = 5000;  // of the times from hand to picture
const TONES = {force: [880, 0.1], shaft: [660, 0.1], view: [330, 0.15], end: [523, 0.3]};  // [Hz], [s]

let view;
try {
  view = new View($("view"));
} catch (error) {
  $("welcome").textContent = `${error.message}: try another browser, or switch on its hardware acceleration`;
  throw error;
}
let two = [];  // exercises for two hands
let scene = null, frame = null, head = {}, rest = null, running = false, paused = false, sound = null;
let fresh = false, drawn = "", echoed = 0, before = null, trace = null, trouble = "", warned = "", late = null;
let turn = 0, told = 0, came = 0, shown = 0;
const plots = {force: new Plot("force"), way: new Plot("way"), rate: new Plot("rate")};
const ways = [], pictures = [];  // from hand to picture [ms]; when pictures were drawn
const hand = new Hand($("view"), $("pad"), view, () => head);
// For scripts that work through the page: numbers as `head` names them, targets after the geoms.
window.palpate = () => ({scene, head, targets: targets(), ways, pictures, late, ghost: trace?.time.length ?? 0});

// The program.

let socket = null;
function connect() {
  const protocol = location.protocol === "https:" ? "wss:" : "ws:";
  socket = new WebSocket(`${protocol}//${location.host}/socket${location.search}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = event => {
    if (event.data instanceof ArrayBuffer) take(new Float32Array(event.data));
    else {
      const message = JSON.parse(event.data);
      HEAR[message.type]?.(message);
    }
  };
  socket.onclose = () => {
    run(false);
    $("start").disabled = true;
    if (!trouble) tell("No connection to the program. Recordings are kept. Connecting again");
    setTimeout(connect, AGAIN);
  };
}
connect();
const say = message => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
const tell = text => $("fault").textContent = text;

const HEAR = {
  menu(menu) {
    trouble = "";
    tell("");
    const groups = Object.groupBy?.(Object.keys(menu.tasks), name => name.split("/")[0]) ?? {"": Object.keys(menu.tasks)};
    keep("task", () => $("task").replaceChildren(...Object.entries(groups).map(([domain, names]) => {
      const group = document.createElement("optgroup");
      group.label = domain;
      group.append(...names.map(name => {
        const after = menu.locked[name];
        const option = new Option(`${name}: ${menu.tasks[name]}${after ? ` (after ${after})` : ""}`, name);
        option.disabled = Boolean(after);
        return option;
      }));
      return group;
    })));
    fill("nodes", [["", "default"], ...menu.nodes.map(n => [n, `${n} nodes`])]);
    fill("speed", menu.speeds.map(s => [s, s === 1 ? "real time" : `${s} \u00d7 real time`]).reverse());
    fill("scale", [1, 0.5, 0.25, 2].map(s => [s, `${s} : 1`]));
    fill("device", menu.devices.map(name => [name, name === "page" ? "mouse, touch, keys, gamepad" : name]));
    fill("left", menu.lefts.map(name => [name, {"": "none", keyboard: "keyboard, on this page", pad: "gamepad, on this page"}[name] ?? name]));
    for (const name of ["organ", "mesh", "scheme", "instrument"]) {
      fill(name, menu[`${name === "mesh" ? "meshe" : name}s`].map(value => [value, value.replace("_", " ") + (menu.blunt.includes(value) ? " (does not cut here)" : "")]));
    }
    fill("step", menu.steps.map(value => [value, `${value} ms`]));
    if (!scene) [$("step").value, $("mesh").value] = [1, "1000 nodes"];
    if (menu.devices.includes(menu.device)) $("device").value = menu.device;
    const wanted = new URLSearchParams(location.hash.slice(1)).get("task");
    if (wanted in menu.tasks && !(wanted in menu.locked)) $("task").value = wanted;
    if ($("task").selectedOptions[0]?.disabled) $("task").value = Object.keys(menu.tasks).find(name => !(name in menu.locked));
    if (menu.trainee) [$("person").value, $("person").disabled] = [menu.trainee, true];
    two = menu.two;
    hands();
    $("start").disabled = false;
    document.body.dataset.device = menu.device;
  },
  loading({text, note}) {
    tell("");
    $("instruction").textContent = `Loading ${text}${note}`;
  },
  scene(message) {
    scene = message;
    frame = rest = trace = before = null;
    came = shown = 0;
    pressed("ghost", false);
    view.load(scene);
    for (const plot of Object.values(plots)) plot.clear();
    $("instruction").textContent = "";
    document.body.classList.toggle("assessment", scene.assessment);
    $("pad-grip").hidden = !scene.jaws;
    $("pad-report").hidden = !scene.report;
    run(true);
  },
  status({instruction, warning, kind, fault, scheme}) {
    $("instruction").textContent = scene?.assessment ? "Assessment: no help" : instruction;
    if (kind && kind !== warned) beep(kind);
    warned = kind;
    $("warning").textContent = warning;
    $("stage").dataset.warning = kind;
    if (fault !== trouble) tell(trouble = fault);
    if (scheme) $("scheme").value = scheme;
  },
  ghost(message) {
    trace = message;
    tell("");
    const path = [];
    for (const pose of trace.pose) {
      const last = path.at(-1) ?? [1, 1, 1];
      if (Math.hypot(pose[0] - last[0], pose[1] - last[1], pose[2] - last[2]) > 0.002) path.push(pose.slice(0, 3));
    }
    trace.path = path;
    trace.since = performance.now();
  },
  card(message) {
    run(false);
    beep("end");
    const save = message.fault ? [["Save again", () => say({type: "keep"})]] : [];
    const again = ["Try again", () => ($("card").close(), start())];
    show($("card"), message, [...save, again, ["Close", () => $("card").close()]]);
  },
  kept({path, fault}) {
    $("kept")?.replaceWith(kept(path, fault));
  },
  idle(message) {
    late = message.late;
    run(false);
  },
  error({text}) {
    tell(text);
    if (!running && socket.readyState === WebSocket.OPEN) $("start").disabled = false;
    if (text.startsWith("all places")) trouble = text;
    if (!trace) pressed("ghost", false);
  },
};

// Fills a choice and keeps what was chosen.
function fill(name, rows) {
  keep(name, () => $(name).replaceChildren(...rows.map(([value, text]) => new Option(text, value))));
}
function keep(name, change) {
  const {value} = $(name);
  change();
  if ([...$(name).options].some(option => option.value === value)) $(name).value = value;
}

// What runs.

const practice = () => document.body.dataset.mode === "practice";
function mode(name) {
  document.body.dataset.mode = name;
  for (const each of ["exercise", "practice"]) $(`tab-${each}`).setAttribute("aria-selected", each === name);
  $("welcome").textContent = name === "practice" ? "Choose an organ and press Start. Every choice may be changed while it runs."
    : "Choose an exercise and press Start.";
  hands();
}

// An exercise for two hands asks for the other one's device: the keys, where nothing is chosen.
function hands() {
  const both = !practice() && two.includes($("task").value);
  $("other").hidden = !practice() && !both;
  if (both && !$("left").value) $("left").value = "keyboard";
}

function run(on) {
  running = on;
  paused = false;
  $("pause").textContent = "Pause";
  $("pause").disabled = $("stop").disabled = !on;
  $("start").disabled = on;
  $("ghost").disabled = !on || !scene || scene.practice || scene.assessment;
  $("welcome").hidden = on || Boolean(frame);
  hand.release();
  if (on) $("welcome").textContent = "";
  else {
    $("instruction").textContent = $("warning").textContent = "";
    $("stage").dataset.warning = "";
    pressed("ghost", false);
  }
}

function start() {
  $("start").disabled = true;
  $("more").open = false;
  tell("");
  $("welcome").textContent = "";
  const common = {speed: Number($("speed").value), scale: Number($("scale").value)};
  if (practice()) {
    hand.left = $("left").value;
    say({
      type: "practice", organ: $("organ").value, mesh: $("mesh").value, scheme: $("scheme").value, left: hand.left,
      instrument: $("instrument").value, step: Number($("step").value), ...common,
    });
  } else {
    hand.left = two.includes($("task").value) ? $("left").value : "";
    say({
      type: "start", task: $("task").value, left: hand.left, seed: Number($("seed").value), person: $("person").value,
      nodes: $("nodes").value ? Number($("nodes").value) : null, assessment: $("assessment").checked, ...common,
    });
  }
  $("view").focus();
}

function take(numbers) {
  if (!scene) return;
  const from = scene.head.length, nodes = numbers.subarray(from, from + 3 * scene.nodes);
  head = Object.fromEntries(scene.head.map((name, i) => [name, numbers[i]]));
  frame = numbers;
  fresh = true;
  came++;
  rest ??= nodes.slice();
  const {force_limit: limit} = scene;
  plots.force.push(head.force);
  plots.way.push(1e3 * displacement(nodes));
  before ??= head;
  const span = head.clock - before.clock;
  if (span > MEAN) {
    const steps = head.steps - before.steps;
    plots.rate.push(steps / span);
    report(steps / span, 1 - (head.missed - before.missed) / Math.max(steps, 1), (head.time - before.time) / span);
    before = head;
  }
  const most = Math.max(scene.damage, 1.2 * limit);
  $("force").classList.toggle("near", head.force > 0.75 * limit);
  $("force").classList.toggle("over", head.force > limit);
  if (head.force > limit && !scene.assessment && !$("stage").dataset.warning) $("stage").dataset.warning = "force";
  else if (!$("warning").textContent && head.force <= limit) $("stage").dataset.warning = "";
  $("force").firstElementChild.style.width = `${Math.min(100 * head.force / most, 100)}%`;
  $("force").lastElementChild.style.left = `${100 * limit / most}%`;
  if (performance.now() - told < WORDS) return;
  told = performance.now();
  $("force-text").textContent = `${head.force.toFixed(2)} N, limit ${limit} N`;
  $("progress").value = Math.max(head.progress, 0);
  $("progress-text").textContent = `${Math.round(100 * Math.max(head.progress, 0))} %`;
  const state = STATES[head.state], limited = scene.time_limit ? ` of ${scene.time_limit.toFixed(0)}` : "";
  $("time").textContent = `${head.time.toFixed(1)}${limited} s${state === "ready" ? "" : `, ${state}`}`;
}

// How far the node that is nearest to the tip is from where it was at first [m].
function displacement(nodes) {
  const {tip_x: x, tip_y: y, tip_z: z} = head;
  let best = Infinity, at = 0;
  for (let i = 0; i < nodes.length; i += 3) {
    const [u, v, w] = [nodes[i] - x, nodes[i + 1] - y, nodes[i + 2] - z], far = u * u + v * v + w * w;
    if (far < best) [best, at] = [far, i];
  }
  return Math.hypot(nodes[at] - rest[at], nodes[at + 1] - rest[at + 1], nodes[at + 2] - rest[at + 2]);
}

function report(steps, punctual, share) {
  if (came > ENOUGH) {
    if (shown < PROMPT * came) view.hurry();
    came = shown = 0;
  }
  const now = performance.now(), late = ways.slice(-30).sort((a, b) => a - b);
  const words = [`${Math.round(steps)} steps a second`, `${(100 * punctual).toFixed(1)} % on time`];
  const wanted = Number($("speed").value);
  if (share < 0.95 * wanted) words.push(`${share.toPrecision(2)} of real time`);
  words.push(`${pictures.filter(t => now - t < 1000).length} pictures a second`);
  if (late.length) words.push(`hand to picture ${Math.round(late[late.length >> 1])} ms`);
  $("loop").textContent = words.join(", ");
}

function targets() {
  if (!scene || !frame) return [];
  const from = scene.head.length + 3 * scene.nodes + 12 * scene.geoms.length;
  return Array.from({length: scene.targets}, (_, i) => [...frame.subarray(from + 8 * i, from + 8 * i + 8)]);
}

function draw() {
  requestAnimationFrame(draw);
  if (running) hand.say().forEach(say);
  if (!frame) return;
  const expert = trace && $("ghost").getAttribute("aria-pressed") === "true" ? trace : null, state = view.state();
  if (!fresh && !expert && state === drawn) return;
  drawn = state;
  view.draw(frame, head, expert);
  if (!fresh) return;
  fresh = false;
  const now = performance.now();
  pictures.push(now);
  shown++;
  if (pictures.length > KEPT) pictures.shift();
  if (head.echo !== echoed) {
    echoed = head.echo;
    ways.push((now - echoed + CLOCK) % CLOCK);
    if (ways.length > KEPT) ways.shift();
  }
  // One a picture: ten times a second is enough for curves.
  [() => plots.force.draw(scene.force_limit), () => plots.way.draw(undefined, 2, 0.5), () => plots.rate.draw(undefined, 0)][turn++ % 3]();
}
requestAnimationFrame(draw);

function beep(kind) {
  if (!$("sound").checked) return;
  sound ??= new AudioContext();
  const tone = sound.createOscillator(), gain = sound.createGain(), [pitch, length] = TONES[kind] ?? TONES.force;
  document.body.dataset.tone = kind;  // for those who do not hear it, and for tests
  tone.frequency.value = pitch;
  gain.gain.value = 0.2;
  tone.connect(gain).connect(sound.destination);
  tone.start();
  tone.stop(sound.currentTime + length);
}

// The buttons.

const pressed = (id, on) => $(id).setAttribute("aria-pressed", on);
const toggle = (id, act) => $(id).onclick = () => {
  const on = $(id).getAttribute("aria-pressed") !== "true";
  pressed(id, on);
  act(on);
  $("view").focus();
};
toggle("wire", on => view.wire = on);
toggle("free", on => {
  view.free = on;
  if (!on) view.home();
});
toggle("ghost", on => {
  if (!on) return;
  say({type: "ghost", known: Boolean(trace)});
  if (trace) trace.since = performance.now();
  else tell("Computing the expert's path. The clock is stopped");
});
for (const name of ["exercise", "practice"]) $(`tab-${name}`).onclick = () => mode(name);
$("start").onclick = start;
$("task").onchange = hands;
$("stop").onclick = () => say({type: "stop"});
$("pause").onclick = () => {
  paused = !paused;
  say({type: "pause", on: paused});
  $("pause").textContent = paused ? "Resume" : "Pause";
  $("view").focus();
};
$("speed").onchange = () => running && say({type: "speed", value: Number($("speed").value)});
$("device").onchange = () => say({type: "device", value: $("device").value});
$("scheme").onchange = () => running && scene.practice && say({type: "scheme", value: $("scheme").value});
// Another organ, mesh, ... is another scene.
for (const name of ["organ", "mesh", "instrument", "step", "left"]) {
  $(name).onchange = () => running && scene.practice && start();
}
$("view").addEventListener("keydown", event => {
  if (!running) return;
  if (event.key === "p") $("pause").click();
  if (event.key === "h" && !$("ghost").disabled) $("ghost").click();
});
document.addEventListener("pointerdown", event => $("more").contains(event.target) || ($("more").open = false));
if (matchMedia("(pointer: coarse)").matches) document.body.classList.add("touch");
