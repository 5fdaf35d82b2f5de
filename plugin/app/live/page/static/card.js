// The score card: done or not, what was good, what to do next; everything else behind a fold.
import {t} from "./texts.js";

export function make(tag, text = "", kind = "") {
  const element = document.createElement(tag);
  element.textContent = text;
  element.className = kind;
  return element;
}
const shown = text => text.replace(/\bcount$/, "").trim();

// What was good: metrics by name, or else how many limits were kept.
function praise({done, moved, good, rows}) {
  if (!moved) return [t("Nothing was measured: there was no movement")];
  const limits = rows.filter(row => row.limit), kept = limits.filter(row => !row.over);
  const found = done ? [t("You reached the end")] : [];
  if (good.length) found.push(t("Better than most skilled people: {0}", good.map(t).join(", ")));
  else if (limits.length) found.push(t("You kept within {0} of {1} limits", kept.length, limits.length));
  return found;
}

function orders({done, proficient, moved, better, helps}) {
  const metric = ({label, value, limit, least}) => t(`{0}: {1}, skilled people have at ${least ? "least" : "most"} {2}`, t(label), shown(value), shown(limit));
  const found = moved ? [...helps.map(help => t(help)), ...done ? better.map(metric) : []].slice(0, 3) : [];
  if (!done) found.unshift(t("Try it again, slowly; Show me shows how"));
  else if (!found.length) found.push(t(proficient ? "Everything is within its limits: do it again until it is a habit" : "Try it again, slowly; Show me shows how"));
  return found;
}

function details({rows, composite}, where) {
  const fold = make("details"), table = make("table");
  const line = (tag, cells, kind) => {
    const row = make("tr");
    row.append(...cells.map(cell => make(tag, cell, kind)));
    table.append(row);
  };
  line("th", ["metric", "yours", "limit"].map(name => t(name)));
  rows.forEach(r => line("td", [(r.over ? "✗ " : "") + t(r.label), shown(r.value), shown(r.limit)], r.over ? "bad" : ""));
  fold.append(make("summary", t("Details")));
  if (composite !== null) fold.append(make("p", t("Score {0}", composite).replace("-", "\u2212")));
  fold.append(table, where);
  return fold;
}

export function show(card, message, actions) {
  const {done, proficient, ending, said, path, fault} = message, buttons = make("div", "", "row"), where = kept(path, fault);
  for (const [text, act] of actions) {
    const button = make("button", text, text === t("Close") ? "" : "main");
    button.autofocus = !buttons.children.length;
    button.onclick = () => act(button);
    buttons.append(button);
  }
  const part = (title, lines) => [make("h3", t(title)), ...lines.map(text => make("p", text))];
  card.replaceChildren(
    make("h2", `${done ? "✓" : "✗"} ${t(done ? proficient ? "Done, and proficient" : "Done" : "Not done")}`, done ? "good" : "bad"), make("p", t(ending)),
    ...part("What was good", praise(message)), ...part("What to do next", orders(message)), ...said.map(text => make("p", text)),
    details(message, fault ? "" : where), ...fault ? [where] : [], buttons,
  );
  if (!card.open) card.showModal();
  card.scrollTop = 0;
}

// Where the recording is.
export function kept(path, fault) {
  const text = path ? t("Recording: {0}", path) : t("The recording is not in a file yet; it is kept while this page is open.");
  const element = make("p", fault ? `${fault}. ${text}` : text, fault ? "small bad" : "small");
  element.id = "kept";
  return element;
}
