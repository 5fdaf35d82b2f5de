// The score card.
function make(tag, text, kind) {
  const element = document.createElement(tag);
  element.textContent = text;
  if (kind) element.className = kind;
  return element;
}

export function show(card, {advice, composite, proficient, rows, path, fault}, actions) {
  const table = document.createElement("table");
  const line = (tag, cells, kind) => {
    const row = document.createElement("tr");
    row.append(...cells.map(cell => make(tag, cell, kind)));
    table.append(row);
  };
  line("th", ["metric", "yours", "limit", "unit"]);
  rows.forEach(r => line("td", [r.label, r.value, r.limit, r.unit === "-" ? "" : r.unit], r.over ? "bad" : ""));
  const buttons = make("div", "", "row"), [ending, ...rest] = advice;
  for (const [text, act] of actions) {
    const button = make("button", text, text === "Close" ? "" : "main");
    button.onclick = () => act(button);
    buttons.append(button);
  }
  const score = composite === null ? "No score" : `Score ${composite}`.replace("-", "\u2212");
  card.replaceChildren(
    make("h2", proficient ? `${score}, proficient` : score, proficient ? "good" : ""), make("p", ending),
    ...rest.map(text => make("p", text)), table, kept(path, fault), buttons,
  );
  if (!card.open) card.showModal();
  card.scrollTop = 0;
}

// Where the recording is.
export function kept(path, fault) {
  const text = path ? `Recording: ${path}` : "The recording is not in a file yet; it is kept while this page is open.";
  const element = make("p", fault ? `${fault}. ${text}` : text, fault ? "small bad" : "small");
  element.id = "kept";
  return element;
}
