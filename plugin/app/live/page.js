// The page: picks an exercise, shows it and sends what the hand does.
import {Hand} from "./hand.js";
import {View} from "./view.js";

const $ = id => document.getElementById(id);
const STATES = ["waiting", "ready", "clutch", "lost", "paused"];
const SPAN = 300;  // frames in a plot
const MEAN = 200;  // over which steps are counted [ms]
const NOTE = [440, 0.08];  // of a warning [Hz], [s]

const view = new View($("view"));
let scene = null, frame = null, head = {}, running = false, paused = false, sound = null;
const plots = {force: [], way: [], rate: []};
const hand = new Hand($("view"), view, () => head);
// For scripts that work through the page: numbers as `head` names them, targets after the geoms.
window.palpate = () => ({scene, head, targets: targets()});

const protocol = location.protocol === "https:" ? "wss:" : "ws:";
const socket = new WebSocket(`${protocol}//${location.host}/socket${location.search}`);
socket.binaryType = "arraybuffer";
const say = message => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));
socket.onmessage = event => {
  if (event.data instanceof ArrayBuffer) take(new Float32Array(event.data));
  else {
    const message = JSON.parse(event.data);
    HEAR[message.type]?.(message);
  }
};
socket.onclose = () => {
  $("fault").textContent = "The program has ended; what was recorded is kept";
  run(false);
  $("start").disabled = true;
};

const HEAR = {
  menu({tasks, nodes, speeds, device}) {
    fill($("task"), Object.entries(tasks).map(([name, what]) => [name, `${name}: ${what}`]));
    fill($("nodes"), [["", "the exercise's"], ...nodes.map(n => [n, n])]);
    fill($("speed"), speeds.map(s => [s, s === 1 ? "real time" : `${s} of real time`]).reverse());
    const wanted = new URLSearchParams(location.hash.slice(1)).get("task");
    if (wanted in tasks) $("task").value = wanted;
    $("start").disabled = false;
    document.body.dataset.device = device;
  },
  loading({task}) {
    $("instruction").textContent = `${task} is being made ready`;
  },
  scene(message) {
    scene = message;
    view.load(scene);
    for (const values of Object.values(plots)) values.length = 0;
    start = null;
    run(true);
  },
  status({instruction, warning, fault}) {
    $("instruction").textContent = instruction;
    if (warning && warning !== $("warning").textContent) beep();
    $("warning").textContent = warning;
    $("fault").textContent = fault;
  },
  card(message) {
    run(false);
    show(message);
  },
  error({text}) {
    $("fault").textContent = text;
    if (!running) $("start").disabled = false;
  },
};

function fill(select, rows) {
  select.replaceChildren(...rows.map(([value, text]) => new Option(text, value)));
}

function run(on) {
  running = on;
  paused = false;
  $("pause").textContent = "Pause";
  $("pause").disabled = $("stop").disabled = !on;
  $("start").disabled = on;
  if (!on) $("instruction").textContent = $("warning").textContent = "";
}

let start = null, before = null;
function take(numbers) {
  if (!scene) return;
  frame = numbers;
  head = Object.fromEntries(scene.head.map((name, i) => [name, numbers[i]]));
  const tip = [head.tip_x, head.tip_y, head.tip_z], now = performance.now();
  start ??= tip;
  const over = head.force > scene.force_limit;
  push("force", head.force);
  push("way", 1e3 * Math.hypot(...tip.map((x, i) => x - start[i])));
  if (before && head.steps < before.steps) before = null;
  if (before && now - before.now > MEAN) {
    push("rate", 1e3 * (head.steps - before.steps) / (now - before.now));
    before = null;
  }
  before ??= {steps: head.steps, now};
  const most = Math.max(scene.damage, 1.2 * scene.force_limit);
  $("force").classList.toggle("over", over);
  $("stage").classList.toggle("over", over);
  $("force").firstElementChild.style.width = `${Math.min(100 * head.force / most, 100)}%`;
  $("force").lastElementChild.style.left = `${100 * scene.force_limit / most}%`;
  $("force-text").textContent = `${head.force.toFixed(2)} N of ${scene.force_limit} N`;
  $("progress").value = Math.max(head.progress, 0);
  $("progress-text").textContent = `${Math.round(100 * head.progress)} %`;
  const state = STATES[head.state];
  $("time").textContent = `${head.time.toFixed(1)} of ${scene.time_limit.toFixed(0)} s`
    + (state === "ready" ? "" : `, ${state}`);
}

function targets() {
  if (!scene || !frame) return [];
  const from = scene.head.length + 3 * scene.nodes + 12 * scene.geoms.length;
  return Array.from({length: scene.targets}, (_, i) => [...frame.subarray(from + 8 * i, from + 8 * i + 8)]);
}

function push(name, value) {
  plots[name].push(value);
  if (plots[name].length > SPAN) plots[name].shift();
}

function plot(name, limit) {
  const canvas = $(`plot-${name}`), pen = canvas.getContext("2d"), values = plots[name];
  const {width, height} = canvas, most = Math.max(...values, 1.2 * (limit ?? 0), 1e-3);
  pen.clearRect(0, 0, width, height);
  const y = value => height - 4 - (height - 16) * value / most;
  if (limit) {
    pen.strokeStyle = "#e5484d";
    pen.beginPath();
    pen.moveTo(0, y(limit));
    pen.lineTo(width, y(limit));
    pen.stroke();
  }
  pen.strokeStyle = "#4cd39b";
  pen.beginPath();
  values.forEach((value, i) => pen.lineTo(width * i / SPAN, y(value)));
  pen.stroke();
  pen.fillStyle = "#9fb0b8";
  pen.fillText(`${values.at(-1)?.toPrecision(3) ?? ""}  (top ${most.toPrecision(3)})`, 4, 10);
}

function draw() {
  if (running) {
    const words = hand.say();
    if (words) say(words);
  }
  if (frame) {
    view.draw(frame, head);
    plot("force", scene.force_limit);
    plot("way");
    plot("rate");
  }
  requestAnimationFrame(draw);
}
requestAnimationFrame(draw);

function show({advice, composite, proficient, rows, path, fault}) {
  const card = $("card"), make = (tag, text, kind) => {
    const element = document.createElement(tag);
    element.textContent = text;
    if (kind) element.className = kind;
    return element;
  };
  const table = document.createElement("table");
  const line = (tag, cells, kind) => {
    const row = document.createElement("tr");
    row.append(...cells.map(cell => make(tag, cell, kind)));
    table.append(row);
  };
  line("th", ["metric", "value", "limit", "unit"]);
  rows.forEach(r => line("td", [r.label, r.value, r.limit, r.unit], r.over ? "bad" : ""));
  const close = make("button", "Close");
  close.onclick = () => card.close();
  card.replaceChildren(
    make("h2", composite === null ? "No score" : `Score ${composite}`, proficient ? "good" : ""),
    ...advice.map(text => make("p", text)), table, make("p", `Recording: ${path}`),
    ...(fault ? [make("p", fault, "bad")] : []), close,
  );
  card.showModal();
}

function beep() {
  if (!$("sound").checked) return;
  sound ??= new AudioContext();
  const tone = sound.createOscillator(), [pitch, length] = NOTE;
  tone.frequency.value = pitch;
  tone.connect(sound.destination);
  tone.start();
  tone.stop(sound.currentTime + length);
}

$("start").onclick = () => {
  $("start").disabled = true;
  $("fault").textContent = "";
  say({
    type: "start", task: $("task").value, seed: Number($("seed").value), person: $("person").value,
    nodes: $("nodes").value ? Number($("nodes").value) : null, speed: Number($("speed").value),
    assessment: $("assessment").checked,
  });
  $("view").focus();
};
$("stop").onclick = () => say({type: "stop"});
$("pause").onclick = () => {
  paused = !paused;
  say({type: "pause", on: paused});
  $("pause").textContent = paused ? "Go on" : "Pause";
  $("view").focus();
};
$("speed").onchange = () => running && say({type: "speed", value: Number($("speed").value)});
$("wire").onchange = () => view.wire = $("wire").checked;
$("free").onchange = () => view.free = $("free").checked;
$("view").addEventListener("keydown", event => event.key === "p" && running && $("pause").click());
