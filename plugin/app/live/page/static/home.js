// The home page: a card for each exercise, by domain, the easiest first.
import {make} from "./card.js";
import {domain, level, t, title} from "./texts.js";

const KEY = "palpate.done";

export function picture(task) {
  const image = new Image();
  image.src = `cards/${task.replace("/", "_")}.webp`;
  image.alt = "";
  return image;
}

// What was done in this browser, for those without a record: exercise -> "done" or "proficient".
function known() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? {};
  } catch {
    return {};
  }
}
export function note(task, {outcome, proficient}) {
  if (outcome !== "success") return;
  const all = known();
  if (all[task] !== "proficient") all[task] = proficient ? "proficient" : "done";
  try {
    localStorage.setItem(KEY, JSON.stringify(all));
  } catch { /* a browser that keeps nothing */ }
}

// Returns how far somebody is: exercise -> "proficient", "done", "open" or "locked", and the next one.
export function standing({tasks, locked, progress}) {
  const mine = progress ? Object.fromEntries(Object.entries(progress).map(([task, {met, good}]) => [task, met ? "proficient" : good ? "done" : ""])) : known();
  const names = Object.keys(tasks), state = task => task in locked ? "locked" : mine[task] || "open";
  const states = Object.fromEntries(names.map(task => [task, state(task)]));
  return {states, next: names.find(task => states[task] === "open") ?? names.find(task => states[task] === "done")};
}

// Returns the exercises of each domain, by its name.
export function groups({tasks}) {
  const found = new Map();
  for (const task of Object.keys(tasks)) {
    const name = domain(task);
    found.set(name, [...found.get(name) ?? [], task]);
  }
  return [...found];
}

export function show(place, menu, start) {
  const {states, next} = standing(menu);
  place.replaceChildren(...groups(menu).map(([name, tasks]) => {
    const row = make("div", "", "cards"), section = make("section", "", "domain");
    row.append(...tasks.map(task => {
      const card = make("button", "", `card ${states[task]}${task === next ? " next" : ""}`), shown = picture(task);
      const after = menu.locked[task], mark = {proficient: "★ ", done: "✓ ", locked: "🔒 ", open: ""}[states[task]];
      const tried = menu.progress?.[task]?.tried ? t("{0} of {1} attempts proficient", menu.progress[task].good, menu.progress[task].tried) : "";
      const status = after ? t("after {0}", title(after)) : task === next ? `${mark}${t("next")}` : mark + t(states[task]);
      shown.loading = "lazy";
      card.dataset.task = task;
      card.disabled = Boolean(after);
      card.append(shown, make("strong", level(task)), make("span", status, "status"), make("span", t(menu.tasks[task]), "what"), make("span", tried, "tried"));
      card.onclick = () => start(task);
      return card;
    }));
    section.append(make("h2", name), row);
    return section;
  }));
}
