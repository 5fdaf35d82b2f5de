// The page: picks an exercise, shows it and sends what the hands do.
import {kept, show} from "./card.js";
import {CLOCK, Hand} from "./hand.js";
import * as home from "./home.js";
import {Plot} from "./plots.js";
import {speaker} from "./sounds.js";
import {language, speak, t, title} from "./texts.js";
import {PRACTICE, Tutorial} from "./tutorial.js";
import {parts, View} from "./scene/view.js";

const $ = id => document.getElementById(id);
const STATES = ["waiting", "ready", "clutch", "lost", "paused"];
const MEAN = 0.3;  // over which steps are counted [s]
const AGAIN = 2000;  // between tries to reach the program [ms]
const WORDS = 100;  // between numbers in words, which are laid out anew [ms]
const ENOUGH = 40, PROMPT = 0.9;  // frames to judge by whether most of them are drawn
const PATIENCE = 3000;  // with an exercise that loads, until it is said what takes so long [ms]
const SILENT = 5000;  // without a picture, until that is said [ms]
const LONGEST = 100;  // that a picture lies behind what came [ms]
const KEPT = 5000;  // of the times from hand to picture
const TELL = 8;  // between looks at the hand [ms]

const asked = new URLSearchParams(location.hash.slice(1));
speak();
let view;
try {
  view = new View($("view"), asked.get("look") === "wet");
} catch (error) {
  without(error);
  throw error;
}
let offer = null;  // of the program: exercises, devices, ...
let tutorial = null;
let said = null;  // about what runs
let scene = null, frame = null, head = {}, rest = null, running = false, paused = false;
let fresh = false, drawn = "", echoed = 0, before = null, trace = null, trouble = "", warned = "", late = null;
let last = null, arrived = 0, span = 0, mixed = null, pictured = 0;  // frames between which pictures lie [ms]
let waited = false;  // for a movement
let loading = null;  // what loads, and since when [ms]
let slow = "";  // where it runs slower than is asked for
let silent = "";  // what was said about a program that says nothing
let turn = 0, plotted = 0, told = 0, came = 0, shown = 0;
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
    if (!trouble) tell(t("No connection to the program. Recordings are kept. Connecting again"));
    setTimeout(connect, AGAIN);
  };
}
const say = message => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
const tell = text => document.querySelectorAll(".fault").forEach(each => each.textContent = text);

tell(t("Connecting to the program"));
connect();

const HEAR = {
  menu(menu) {
    trouble = "";
    tell("");
    const first = !offer;
    offer = menu;
    keep("task", () => $("task").replaceChildren(...home.groups(menu).map(([domain, names]) => {
      const group = document.createElement("optgroup");
      group.label = domain;
      group.append(...names.map(name => {
        const after = menu.locked[name];
        const option = new Option(`${name}: ${t(menu.tasks[name])}${after ? ` (${t("after {0}", title(after))})` : ""}`, name);
        option.disabled = Boolean(after);
        return option;
      }));
      return group;
    })));
    fill("nodes", [["", t("default")], ...menu.nodes.map(n => [n, t(`${n} nodes`)])]);
    fill("speed", menu.speeds.map(s => [s, s === 1 ? t("real time") : t("{0} \u00d7 real time", s)]).reverse());
    fill("scale", [1, 0.5, 0.25, 2].map(s => [s, `${s} : 1`]));
    fill("device", menu.devices.map(name => [name, name === "page" ? t("mouse, touch, keys, gamepad") : name]));
    fill("holder", menu.devices.map(name => [name, name === "page" ? t("keys and buttons of this page") : name]));
    fill("left", menu.lefts.map(name => [name, t({"": "none", keyboard: "keyboard, on this page", pad: "gamepad, on this page"}[name] ?? name)]));
    for (const name of ["organ", "mesh", "scheme", "instrument"]) {
      fill(name, menu[`${name === "mesh" ? "meshe" : name}s`].map(value => [value, t(value.replace("_", " "))]));
    }
    fill("step", menu.steps.map(value => [value, `${value} ms`]));
    if (!scene) [$("step").value, $("mesh").value] = [1, "1000 nodes"];
    if (menu.devices.includes(menu.device)) $("device").value = menu.device;
    const wanted = asked.get("task"), {next} = home.standing(menu);
    if (wanted in menu.tasks && !(wanted in menu.locked)) $("task").value = wanted;
    else if (first || $("task").selectedOptions[0]?.disabled) $("task").value = next;
    if (first) mode(wanted in menu.tasks ? "exercise" : "home");
    if (first && wanted && !(wanted in menu.tasks)) tell(t("The address asks for {0}: there is no such exercise", wanted));
    home.show($("cards"), menu, choose);
    if (menu.trainee) [$("person").value, $("person").disabled] = [menu.trainee, true];
    fill("on", menu.processors.map(name => [name, name]));
    $("processors").hidden = menu.processors.length < 2;
    hands();
    $("start").disabled = false;
    document.body.dataset.device = menu.device;
  },
  loading({text, note}) {
    tell("");
    $("welcome").replaceChildren(...text in offer.tasks ? [home.picture(text)] : []);
    loading = {text: t(note ? "Loading {0}, which takes a minute or more" : "Loading {0}", offer.tasks[text] ? title(text) : text), since: performance.now()};
    $("instruction").textContent = loading.text;
  },
  scene(message) {
    scene = message;
    loading = null;
    frame = last = rest = trace = before = null;
    came = shown = told = 0;
    slow = "";
    pressed("ghost", false);
    view.load(scene);
    for (const plot of Object.values(plots)) plot.clear();
    $("instruction").textContent = "";
    document.body.classList.toggle("assessment", scene.assessment);
    $("pad-grip").hidden = !scene.jaws;
    $("pad-report").hidden = !scene.report;
    $("scope").hidden = $("follow").hidden = !scene.scope;
    tilts();
    [hand.turns, hand.wrist] = [scene.turns, scene.wrist];
    hand.begin();
    press("draw", false);
    if (!scene.scope) press("scope", false);
    else if (on("follow")) say({type: "follow", on: true});
    run(true);
  },
  topology(message) {
    view.sew(message);
    rest = null;
  },
  status(message) {
    const {instruction, warning, kind, fault, scheme} = said = message;
    if (!tutorial) $("instruction").textContent = scene?.assessment ? t("Assessment: no help") : t(instruction);
    if (kind && kind !== warned) beep(kind);
    warned = kind;
    $("warning").textContent = t(warning);
    $("stage").dataset.warning = kind;
    if (fault !== trouble) tell(trouble = fault);
    if (scheme) $("scheme").value = scheme;
  },
  ghost(message) {
    trace = message;
    tell(t("The clock is stopped; it goes on when you move"));
    waited = true;
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
    home.note($("task").value, message);
    const {next} = home.standing(offer), save = message.fault ? [[t("Save again"), () => say({type: "keep"})]] : [];
    const again = [t("Try again"), () => ($("card").close(), start())];
    const on = message.done && next && next !== $("task").value ? [[t("Next: {0}", title(next)), () => ($("card").close(), choose(next))]] : [];
    show($("card"), message, [...save, ...on, again, [t("Close"), () => $("card").close()]]);
    home.show($("cards"), offer, choose);
  },
  kept({path, fault}) {
    $("kept")?.replaceWith(kept(path, fault));
  },
  idle(message) {
    late = message.late;
    run(false);
  },
  error({text}) {
    tell(t(text));
    if (!running && socket.readyState === WebSocket.OPEN) $("start").disabled = false;
    if (text.startsWith("All places")) trouble = text;
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

const MODES = ["home", "tutorial", "exercise", "practice"];
const practice = () => ["practice", "tutorial"].includes(document.body.dataset.mode);
function mode(name) {
  if (running && name !== document.body.dataset.mode) say({type: "stop"});
  document.body.dataset.mode = name;
  for (const each of MODES) $(`tab-${each}`).setAttribute("aria-selected", each === name);
  $("welcome").textContent = t(name === "practice" ? "Choose an organ and press Start. Every choice may be changed while it runs."
    : "Choose an exercise and press Start.");
  hands();
}
function choose(task) {
  mode("exercise");
  $("task").value = task;
  hands();
  start();
}
function teach() {
  mode("tutorial");
  start();
}

// What is left to a browser that cannot draw: the exercise as a film.
function without(error) {
  document.body.dataset.mode = "exercise";  // nothing below the import of the view has run
  const film = document.createElement("code"), task = asked.get("task") ?? "touch/easy";
  film.textContent = `palpate exercise ${task} --film film.mp4`;
  $("look").hidden = $("pad").hidden = true;
  $("welcome").replaceChildren(t("This browser draws no WebGL 2"), home.picture(task),
    t("Switch on its hardware acceleration, or try another browser. The exercise as a film, from the command line:"), film);
  console.warn(error);
}

// An exercise for two hands asks for the other one's device: the keys, where nothing is chosen.
function hands() {
  const both = !practice() && offer?.two.includes($("task").value);
  $("other").hidden = !practice() && !both;
  if (both && !$("left").value) $("left").value = "keyboard";
}

function run(on) {
  running = on;
  loading = null;
  document.body.classList.toggle("running", on);
  paused = false;
  $("pause").textContent = t("Pause");
  $("pause").disabled = $("stop").disabled = !on;
  $("start").disabled = on;
  $("ghost").disabled = !on || !scene || scene.practice || scene.assessment;
  $("welcome").hidden = on || Boolean(frame);
  if (!on) tutorial = null;
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
  const common = {speed: Number($("speed").value), scale: Number($("scale").value), scope: $("holder").value || "page"};
  tutorial = document.body.dataset.mode === "tutorial" ? new Tutorial() : null;
  if (tutorial) {
    hand.left = "";
    say({...PRACTICE, ...common});
  } else if (practice()) {
    hand.left = $("left").value;
    say({
      type: "practice", organ: $("organ").value, mesh: $("mesh").value, scheme: $("scheme").value, left: hand.left,
      instrument: $("instrument").value, step: Number($("step").value), on: $("on").value, ...common,
    });
  } else {
    hand.left = offer.two.includes($("task").value) ? $("left").value : "";
    say({
      type: "start", task: $("task").value, left: hand.left, seed: Number($("seed").value), person: $("person").value,
      nodes: $("nodes").value ? Number($("nodes").value) : null, assessment: $("assessment").checked, ...common,
    });
  }
  $("view").focus();
}

function take(numbers) {
  if (!scene) return;
  const [nodes] = parts(scene, numbers);
  head = Object.fromEntries(scene.head.map((name, i) => [name, numbers[i]]));
  const now = performance.now();
  [last, frame, span, arrived] = [frame, numbers, Math.min(now - arrived, LONGEST), now];
  fresh = true;
  came++;
  if (silent) tell(silent = "");
  rest ??= nodes.slice();
  const {force_limit: limit} = scene;
  plots.force.push(head.force);
  plots.way.push(1e3 * displacement(nodes));
  before ??= head;
  const passed = head.clock - before.clock;
  if (passed > MEAN) {
    const steps = head.steps - before.steps;
    plots.rate.push(steps / passed);
    report(steps / passed, 1 - (head.missed - before.missed) / Math.max(steps, 1), (head.time - before.time) / passed);
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
  const lesson = tutorial?.look(head, scene.camera), done = Math.max(lesson ? lesson[1] : head.progress, 0);
  if (lesson) $("instruction").textContent = lesson[0];
  else if (view.line.points.length) {
    const [share, far] = view.line.measure(head);
    $("instruction").textContent = t("The line: {0} % followed, {1} mm off on average", Math.round(100 * share), (1e3 * far).toFixed(1));
  }
  $("force").setAttribute("aria-valuemax", most.toFixed(2));
  $("force").setAttribute("aria-valuenow", head.force.toFixed(2));
  $("force-text").textContent = t("{0} N, limit {1} N", head.force.toFixed(2), limit);
  $("progress").value = done;
  $("progress-text").textContent = `${Math.round(100 * done)} %`;
  const state = STATES[head.state], seconds = head.time.toFixed(1);
  const time = scene.time_limit ? t("{0} of {1} s", seconds, scene.time_limit.toFixed(0)) : `${seconds} s`;
  $("time").textContent = [time, state === "ready" ? slow : t(state)].filter(Boolean).join(", ");
  if (state === "waiting" && !scene.practice) tell(t(head.time < 0.1 ? "The clock starts with your first movement" : "The clock is stopped; it goes on when you move"));
  else if (waited) tell("");
  waited = state === "waiting" && !scene.practice;
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
  const words = [t("{0} steps a second", Math.round(steps)), t("{0} % on time", (100 * punctual).toFixed(1))];
  slow = share < 0.95 * Number($("speed").value) ? t("{0} of real time", share.toPrecision(2)) : "";
  if (slow) words.push(slow);
  words.push(t("{0} pictures a second", pictures.filter(at => now - at < 1000).length));
  if (late.length) words.push(t("hand to picture {0} ms", Math.round(late[late.length >> 1])));
  $("loop").textContent = words.join(", ");
}

function targets() {
  if (!scene || !frame) return [];
  const sites = parts(scene, frame).at(-1), each = sites.length / scene.sites.length;
  return Array.from({length: scene.targets}, (_, i) => [...sites.subarray(each * i, each * i + 8)]);
}

const hear = () => running && hand.say().forEach(say);
setInterval(hear, TELL);  // pictures may be further apart

// A program that says nothing is named, where it should move, and one that loads for long.
setInterval(() => {
  const waits = loading ? performance.now() - loading.since : 0;
  if (waits > PATIENCE) $("instruction").textContent = t("{0}: {1} s. The first time, kernels are compiled, for up to a minute", loading.text, Math.round(waits / 1e3));
  if (!running || paused || STATES[head.state] !== "ready") return;
  const passed = performance.now() - arrived;
  if (passed > SILENT) tell(silent = t("No picture from the program for {0} s", Math.round(passed / 1e3)));
}, 1000);
$("view").addEventListener("webglcontextlost", () => tell(t("The graphics card has dropped the picture")));
$("view").addEventListener("webglcontextrestored", () => tell(""));

function draw() {
  requestAnimationFrame(draw);
  hear();  // drawing may take long
  if (!frame) return;
  const expert = trace && on("ghost") ? trace : null, state = view.state(), now = performance.now();
  // A picture lies between frames where it comes as often as they do.
  const often = last?.length === frame.length && now - pictured < 1.5 * span;
  const share = often ? Math.min((now - arrived) / Math.max(span, 1), 1) : 1;
  if (!fresh && !expert && state === drawn) return;
  drawn = share < 1 ? "" : state;  // until the picture is where the frame is
  view.draw(share < 1 ? mix(share) : frame, head, expert);
  pictured = now;
  if (!fresh) return;
  fresh = false;
  pictures.push(now);
  shown++;
  if (pictures.length > KEPT) pictures.shift();
  if (head.echo !== echoed) {
    echoed = head.echo;
    ways.push((performance.now() - echoed + CLOCK) % CLOCK + (1 - share) * span);
    if (ways.length > KEPT) ways.shift();
  }
  if (now - plotted < WORDS / 3) return;  // one at a time, each ten times a second
  plotted = now;
  [() => plots.force.draw(scene.force_limit), () => plots.way.draw(undefined, 2, 0.5), () => plots.rate.draw(undefined, 0)][turn++ % 3]();
}
requestAnimationFrame(draw);

// Returns numbers between the last two frames.
function mix(share) {
  if (mixed?.length !== frame.length) mixed = new Float32Array(frame.length);
  for (let i = 0; i < frame.length; i++) mixed[i] = last[i] + share * (frame[i] - last[i]);
  return mixed;
}

const beep = speaker(() => $("sound").checked);

// The buttons.

// Buttons that turn a camera or a wrist are there while one is moved.
function tilts() {
  for (const button of document.querySelectorAll("[data-tilt]")) button.hidden = !hand.scope && !scene?.turns;
  for (const button of document.querySelectorAll("[data-wrist]")) button.hidden = hand.scope || !scene?.wrist;
}
const pressed = (id, on) => $(id).setAttribute("aria-pressed", on);
const on = id => $(id).getAttribute("aria-pressed") === "true";
function press(id, down) {
  if (on(id) !== down) $(id).click();
}
const toggle = (id, act) => $(id).onclick = () => {
  const on = $(id).getAttribute("aria-pressed") !== "true";
  pressed(id, on);
  act(on);
  $("view").focus();
};
toggle("scope", down => {
  hand.scope = down;
  tilts();
});
toggle("follow", down => {
  hand.begin();
  if (running) say({type: "follow", on: down});
});
toggle("draw", down => {
  view.pen = down;
  if (down) view.line?.clear();
});
toggle("wire", on => view.wire = on);
toggle("free", on => {
  view.free = on;
  if (!on) view.home();
});
toggle("ghost", on => {
  if (!on) return;
  say({type: "ghost", known: Boolean(trace)});
  if (trace) trace.since = performance.now();
  tell(t(trace ? "The clock is stopped; it goes on when you move" : "Computing the expert's path. The clock is stopped"));
  waited = true;
});
for (const name of MODES) $(`tab-${name}`).onclick = () => name === "tutorial" ? teach() : mode(name);
$("begin").onclick = teach;
$("language").value = language();
$("language").onchange = () => {
  speak($("language").value);
  HEAR.menu(offer);
  if (running && said) HEAR.status(said);
  $("pause").textContent = t(paused ? "Resume" : "Pause");
};
$("start").onclick = start;
$("task").onchange = hands;
$("stop").onclick = () => say({type: "stop"});
$("pause").onclick = () => {
  paused = !paused;
  say({type: "pause", on: paused});
  $("pause").textContent = t(paused ? "Resume" : "Pause");
  $("view").focus();
};
$("speed").onchange = () => running && say({type: "speed", value: Number($("speed").value)});
$("device").onchange = () => say({type: "device", value: $("device").value});
$("scheme").onchange = () => running && scene.practice && say({type: "scheme", value: $("scheme").value});
// Another organ, mesh, ... is another scene.
for (const name of ["organ", "mesh", "instrument", "step", "left", "on"]) {
  $(name).onchange = () => running && scene.practice && start();
}
$("view").addEventListener("keydown", event => {
  if (!running) return;
  if (event.key === "p") $("pause").click();
  if (event.key === "h" && !$("ghost").disabled) $("ghost").click();
  if (event.key === "f" && !$("follow").hidden) $("follow").click();
  if (event.key === "y" && !$("scope").hidden) $("scope").click();
});
document.addEventListener("pointerdown", event => $("more").contains(event.target) || ($("more").open = false));
$("more").addEventListener("keydown", event => {
  if (event.key !== "Escape") return;
  $("more").open = false;
  $("more").firstElementChild.focus();
});
if (matchMedia("(pointer: coarse)").matches) document.body.classList.add("touch");
