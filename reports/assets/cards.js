"use strict";
// Cards of runs, drawn on demand: the wrong runs of a method, and the overlays of each test.

const CARDS = 12;

// The list of cards named NAME; `choose` returns the places of its runs in the table, and what comes on
// top of each card. At most `CARDS` more are in the document after each click.
function cardList(name, choose, order = "") {
  let count = CARDS;
  const show = async () => {
    const data = await runsTable(), rows = await choose(data);
    const part = rows.slice(0, count);
    $(`#${name}-cards`).replaceChildren(...part.map((row) => cardOf(data, row)));
    $(`#${name}-count`).textContent = `${part.length} of ${rows.length}${order}`;
    $(`#${name}-more`).hidden = part.length === rows.length;
  };
  $(`#${name}-more`).addEventListener("click", () => { count += CARDS; show(); });
  soon(show);
  return () => { count = CARDS; return show(); };
}

function cardOf(data, { at, head = [] }) {
  const run = data.values.run[at], card = document.createElement("article");
  card.className = "card";
  if (head.length) {
    const title = document.createElement("h3");
    title.append(...head);
    card.append(title);
  }
  const link = make("a", "", { className: "view", href: `#run=${run}` });
  for (const when of ["before", "after"]) {
    const canvas = document.createElement("canvas"), holder = document.createElement("span");
    Object.assign(canvas.dataset, { run, when });
    holder.append(canvas, when);
    link.append(holder);
    seen.observe(canvas);
  }
  const text = document.createElement("p");
  text.append(`${titleOf(data, at)}; ${data.word("answer", at)}, RMSE ${short(data.values.rmse[at])}, ${data.word("status", at)}`);
  card.append(link, text);
  return card;
}

// Own pairs of clouds have only one level and one trial, which are not shown.
function titleOf(data, at) {
  const { values } = data, test = data.word("test", at).replaceAll("_", " ");
  const parts = [data.word("case", at)];
  if (test !== "pair") parts.push(`${test} ${short(values.level[at])}`, `trial ${values.trial[at]}`);
  return parts.join(", ");
}

// ---- wrong runs --------------------------------------------------------------------------------

function wrongRuns(data) {
  const method = data.words.method.indexOf($("#wrong-method").value);
  const wrong = new Set(["wrong", "no pose"].map((answer) => data.words.answer.indexOf(answer)));
  const rows = [];
  for (let at = 0; at < data.count; at += 1) if (data.values.method[at] === method && wrong.has(data.values.answer[at])) rows.push(at);
  rows.sort((a, b) => (data.values.rmse[b] ?? Infinity) - (data.values.rmse[a] ?? Infinity) || a - b);
  return rows.map((at) => ({ at }));
}
if ($("#wrong-method")) $("#wrong-method").addEventListener("change", cardList("wrong", wrongRuns, ", the largest error first"));

// ---- overlays ----------------------------------------------------------------------------------

const overlays = () => once("overlays", async () => unpacked(await stored("gallery")).json());

async function overlaidRuns(data) {
  const { run_id: runs, rank: ranks } = await overlays();
  const [group, rank] = ["group", "rank"].map((name) => $(`#gallery-filter [data-choice=${name}]`).value);
  const rows = runs.map((run, i) => ({ at: data.at.get(run), rank: ranks[i] })).filter((row) => row.at !== undefined
    && !hidden.has(data.word("method", row.at)) && (!rank || row.rank === rank)
    && (!group || group === `${data.word("model", row.at)}|${data.word("test", row.at)}`));
  return rows.map((row) => ({ at: row.at, head: headOf(data, row) }));
}

function headOf(data, { at, rank }) {
  const badge = make("span", rank, { className: `rank ${rank}` });
  return [dotOf(data.word("method", at)), data.names[data.values.method[at]], badge];
}

if ($("#gallery-filter")) {
  const show = cardList("gallery", overlaidRuns);
  $("#gallery-filter").addEventListener("input", show);
  document.addEventListener("methods-changed", () => { if ($("#gallery-count").textContent) show(); });
}
