"use strict";
// The table of runs: filters and sorting over columns; at most 100 rows are in the document.

const ROWS = 100;
const runsTable = () => once("runs", async () => {
  const { words, values, names, replay } = await unpacked(await stored("runs")).json();
  const text = (name) => values[name].map((code) => words[name][code]);
  const cases = text("case");
  return {
    words, values, names, replay, count: values.run.length,
    searched: values.run.map((run, at) => `${cases[at]} ${run}`.toLowerCase()),
    at: new Map(values.run.map((run, at) => [run, at])),
    word: (name, at) => words[name][values[name][at]],
  };
});

// title and format of each column; columns without a format contain words
const COLUMNS = {
  run: ["run"], method: ["method"], model: ["model"], case: ["data"], test: ["test"], level: ["level", short], trial: ["trial", short],
  answer: ["verdict"], status: ["status"], rmse: ["RMSE", short], rotation: ["rotation error (°)", short],
  time: ["time (s)", short], nodes: ["nodes", short],
};
const order = { column: "run", descending: false, chosen: false };
const listing = { rows: [], page: 0 };

function selected(data) {
  const controlled = (kind) => $$(`#runs-filter [data-${kind}]`).filter((control) => control.value !== "");
  const { values, words } = data, notRun = words.answer.indexOf("not run");
  const tests = controlled("choice").map(({ dataset, value }) => {
    const column = values[dataset.choice], wanted = Number(value);
    return value === "started" ? (at) => column[at] !== notRun : (at) => column[at] === wanted;
  });
  // a missing error counts as infinite
  for (const { dataset, value } of controlled("least")) tests.push((at) => (values[dataset.least][at] ?? Infinity) >= Number(value));
  for (const { dataset, value } of controlled("most")) tests.push((at) => (values[dataset.most][at] ?? Infinity) <= Number(value));
  const asked = $("#runs-filter [data-words]").value.toLowerCase().split(/\s+/).filter(Boolean);
  if (asked.length) tests.push((at) => asked.every((word) => data.searched[at].includes(word)));
  const off = words.method.map((method) => hidden.has(method));
  if (hidden.size) tests.push((at) => !off[values.method[at]]);
  const rows = [];
  for (let at = 0; at < data.count; at += 1) if (tests.every((test) => test(at))) rows.push(at);
  return order.chosen ? rows.sort(comparison(data)) : rows;
}

function comparison({ words, values }) {
  const column = values[order.column], sign = order.descending ? -1 : 1;
  const places = words[order.column] && [...words[order.column].keys()].sort((a, b) => words[order.column][a].localeCompare(words[order.column][b]));
  const rank = places && places.reduce((ranks, code, place) => { ranks[code] = place; return ranks; }, []);
  const key = rank ? (at) => rank[column[at]] : (at) => column[at];
  return (a, b) => {
    const [one, other] = [key(a), key(b)];
    if (one === null || other === null) return (one === null) - (other === null) || a - b; // missing last
    return sign * (one < other ? -1 : one > other ? 1 : 0) || a - b;
  };
}

const shownColumns = (data) => Object.keys(COLUMNS).filter((name) => name !== "model" || data.words.model.length > 1);

async function listRuns(page = 0) {
  const data = await runsTable();
  const began = performance.now();
  listing.rows = selected(data);
  listing.page = Math.max(0, Math.min(page, Math.ceil(listing.rows.length / ROWS) - 1));
  const first = listing.page * ROWS, part = listing.rows.slice(first, first + ROWS);
  const body = $("#runs-table").tBodies[0];
  body.replaceChildren(...part.map((at) => rowOf(data, at)));
  const whole = (count) => count.toLocaleString("en").replaceAll(",", "\u202f");
  $("#runs-count").textContent = part.length
    ? `${whole(first + 1)}–${whole(first + part.length)} of ${whole(listing.rows.length)} runs` : "no run fits";
  $$("[data-page]").forEach((button) => { button.disabled = Number(button.dataset.page) < 0 ? !first : first + ROWS >= listing.rows.length; });
  $("#runs-table").dataset.took = String(performance.now() - began);
}

function rowOf(data, at) {
  const row = document.createElement("tr");
  const method = data.words.method[data.values.method[at]];
  row.dataset.method = method;
  for (const name of shownColumns(data)) {
    const [title, format] = COLUMNS[name];
    const cell = document.createElement(name === "run" ? "th" : "td");
    if (name !== "run") cell.dataset.title = title;
    if (format) cell.className = "n";
    if (name === "run") {
      cell.scope = "row";
      cell.append(linkTo(data.values.run[at]));
    } else if (name === "method") cell.append(dotOf(method), data.names[data.values.method[at]]);
    else if (name === "answer") cell.append(badgeOf(data.word("answer", at)));
    else cell.textContent = format ? format(data.values[name][at]) : name === "test" ? data.word(name, at).replaceAll("_", " ") : data.word(name, at);
    row.append(cell);
  }
  return row;
}

const linkTo = (run, text = run) => make("a", text, { href: `#run=${run}` });
const dot = (method) => once(`dot ${method}`, () => $(`[data-toggle-method="${CSS.escape(method)}"] .dot`));
const dotOf = (method) => dot(method).cloneNode(true);
const badgeOf = (answer) => make("span", answer, { className: `answer-${answer.replaceAll(" ", "-")}` });

async function headRuns() {
  const data = await runsTable();
  const heads = shownColumns(data).map((name) => {
    const head = make("th", "", { scope: "col", className: COLUMNS[name][1] ? "n" : "" });
    const button = make("button", COLUMNS[name][0], { type: "button" });
    button.addEventListener("click", () => sortRuns(name));
    head.dataset.column = name;
    head.append(button);
    return head;
  });
  $("#runs-table").tHead.rows[0].replaceChildren(...heads);
  $("#runs-order").replaceChildren(...shownColumns(data).map((name) => new Option(COLUMNS[name][0], name)));
  await listRuns();
}

function sortRuns(name) {
  order.descending = order.chosen && order.column === name && !order.descending;
  Object.assign(order, { column: name, chosen: true });
  $$("#runs-table thead th").forEach((head) => head.removeAttribute("aria-sort"));
  $(`#runs-table [data-column="${name}"]`).setAttribute("aria-sort", order.descending ? "descending" : "ascending");
  listRuns();
}

// ---- events ------------------------------------------------------------------------------------

// Calls `make` once the first screen is shown: what comes in later would move what a link leads to.
const soon = (make) => setTimeout(() => make().catch(tellMissing), 100);
soon(headRuns);

$("#runs-filter").addEventListener("input", () => listRuns());
$$("[data-page]").forEach((button) => button.addEventListener("click", () => listRuns(listing.page + Number(button.dataset.page))));
$("#runs-order").addEventListener("change", ({ target }) => sortRuns(target.value));
document.addEventListener("methods-changed", () => { if (listing.rows.length || $("#runs-table").tBodies[0].rows.length) listRuns(); });
