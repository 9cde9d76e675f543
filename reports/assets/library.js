"use strict";
// The page of the library: filters, sorting, and the view of one problem. No request leaves the page.
// dcreg/plot/unpack.js stands before it.

const $ = (selector, root = document) => root.querySelector(selector);
const $$ = (selector, root = document) => [...root.querySelectorAll(selector)];

let known = null;
const problems = () => (known ??= unpacked($("#data").textContent).json());

$("#theme").addEventListener("click", () => {
  const isDark = getComputedStyle(document.documentElement).colorScheme === "dark"
    || (!document.documentElement.dataset.theme && matchMedia("(prefers-color-scheme: dark)").matches);
  document.documentElement.dataset.theme = isDark ? "light" : "dark";
  if (redraw) redraw();
});

// ---- the table ---------------------------------------------------------------------------------

const rows = $$("#problems tbody tr");
function filter() {
  const words = $("#f-text").value.toLowerCase().split(/\s+/).filter(Boolean);
  let count = 0;
  for (const row of rows) {
    const { model, status, family, points, overlap, text } = row.dataset;
    row.hidden = [["#f-model", model], ["#f-status", status], ["#f-family", family]]
      .some(([id, value]) => $(id).value && $(id).value !== value)
      || Number(points) < Number($("#f-points").value)
      || Number(overlap) > Number($("#f-overlap").value || 1) + 1e-9
      || words.some((word) => !text.includes(word));
    count += !row.hidden;
  }
  $("#count").textContent = `${count} of ${rows.length} problems`;
}
$("#filters").addEventListener("input", filter);
filter();

const valueOf = (cell) => {
  const raw = cell.dataset.sort ?? cell.textContent.trim();
  return raw === "" ? null : Number.isNaN(Number(raw)) ? raw : Number(raw);
};
$$("#problems thead th").forEach((head, column, heads) => {
  if ("fixed" in head.dataset) return;
  const button = document.createElement("button");
  button.type = "button";
  button.append(...head.childNodes);
  head.append(button);
  button.addEventListener("click", () => {
    const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    heads.forEach((other) => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    const keyed = rows.map((row) => [valueOf(row.cells[column]), row]);
    keyed.sort(([a], [b]) => {
      if (a === null || b === null) return (a === null) - (b === null); // missing last
      return sign * (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b)));
    });
    $("#problems tbody").append(...keyed.map(([, row]) => row));
  });
});

// ---- one problem -------------------------------------------------------------------------------

let redraw = null;
const make = (tag, text, attributes = {}) => Object.assign(document.createElement(tag), { textContent: text }, attributes);

async function show() {
  const id = decodeURIComponent(location.hash.slice(1));
  const found = id.includes("@") ? (await problems())[id] : undefined;
  $("#all").hidden = Boolean(found);
  $("#one").hidden = !found;
  redraw = null;
  if (!found) return;
  const section = make("section", "");
  section.append(make("a", "← All problems", { href: "#" }), make("h1", id), make("p", found.title));
  const grid = make("div", "", { className: "detail" });
  const left = make("div", ""), right = make("div", "");
  if (found.source) left.append(...picture(found));
  else left.append(make("p", "The points are third-party data. The problem file has the recipe that fetches them.", { className: "note" }));
  right.append(facts(found), ...history(found), ...citation(found));
  grid.append(left, right);
  section.append(grid);
  $("#one").replaceChildren(section);
  if (redraw) redraw();
  scrollTo(0, 0);
}
addEventListener("hashchange", show);

function facts(found) {
  const list = make("dl", "", { className: "facts" });
  const more = [["scale_range", found.scale_range.join(" to ")], ["unit of length", found.unit], ["origin", found.origin], ["licence", found.licence]];
  for (const [name, text] of [...found.facts, ...more]) {
    const item = make("div", "");
    item.append(make("dt", name), make("dd", text));
    list.append(item);
  }
  return list;
}

function citation(found) {
  return [make("h2", "Cite"), make("pre", found.cite)];
}

function picture(found) {
  const canvas = make("canvas", "", { tabIndex: 0 });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Source at the chosen pose, and target");
  const poses = { "best known pose": found.pose, "reference pose": found.truth };
  const choice = make("select", "");
  for (const name of Object.keys(poses)) if (poses[name]) choice.append(make("option", name));
  const bar = make("div", "", { className: "controls" });
  const label = make("label", "Source at the ");
  label.append(choice);
  bar.append(label);
  const is3d = found.source[0].length === 3;
  if (is3d) bar.append(make("span", "Drag, or use the arrow keys, to turn.", { className: "quiet" }));
  let yaw = 0.5, pitch = 0.45;
  redraw = () => draw(canvas, found, poses[choice.value], is3d, yaw, pitch);
  choice.addEventListener("input", redraw);
  const turn = (dx, dy) => { yaw += dx; pitch = Math.max(-1.57, Math.min(1.57, pitch + dy)); redraw(); };
  if (is3d) {
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) turn(event.movementX / 120, event.movementY / 120); });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (step) { event.preventDefault(); turn(...step); }
    });
  }
  const key = make("p", "", { className: "quiet" });
  key.innerHTML = '<span style="color:var(--source)">●</span> source &nbsp; <span style="color:var(--target)">●</span> target';
  return [bar, canvas, key];
}

const applied = (T, p) => T.slice(0, -1).map((row) => row.slice(0, -1).reduce((sum, value, i) => sum + value * p[i], row.at(-1)));

function draw(canvas, found, pose, is3d, yaw, pitch) {
  const side = canvas.clientWidth * devicePixelRatio;
  canvas.width = canvas.height = side;
  const project = ([x, y, z]) => {
    if (!is3d) return [x, y];
    const [c, s, k, l] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    return [c * x + s * y, k * z + l * (-s * x + c * y)];
  };
  const target = found.target.map(project), source = found.source.map((p) => project(applied(pose, p)));
  const every = [...target, ...source];
  const low = [0, 1].map((i) => Math.min(...every.map((p) => p[i]))), high = [0, 1].map((i) => Math.max(...every.map((p) => p[i])));
  const scale = (0.9 * side) / Math.max(high[0] - low[0], high[1] - low[1], 1e-12);
  const at = (p) => [side / 2 + (p[0] - (low[0] + high[0]) / 2) * scale, side / 2 - (p[1] - (low[1] + high[1]) / 2) * scale];
  const context = canvas.getContext("2d");
  const style = getComputedStyle(canvas);
  context.clearRect(0, 0, side, side);
  const radius = 3.2 * devicePixelRatio;
  for (const [points, role, filled] of [[target, "--target", true], [source, "--source", false]]) {
    canvas.style.color = `var(${role})`;
    context.fillStyle = context.strokeStyle = style.color;
    context.lineWidth = 1.6 * devicePixelRatio;
    for (const point of points) {
      context.beginPath();
      context.arc(...at(point), filled ? radius : 1.6 * radius, 0, 7);
      if (filled) context.fill(); else context.stroke();
    }
  }
}
addEventListener("resize", () => redraw && redraw());

function history(found) {
  const steps = found.history;
  if (!steps.length) return [];
  const [width, height, left, bottom] = [440, 170, 60, 24];
  const values = steps.flatMap((step) => [step.upper, step.lower]).filter((value) => value !== null);
  const top = Math.max(...values) * 1.05, low = Math.min(...values, top) * 0.95;
  const x = (i) => left + (i * (width - left - 12)) / steps.length, y = (v) => 12 + ((top - v) / (top - low || 1)) * (height - bottom - 12);
  const line = (name) => steps.map((step, i) => (step[name] === null ? "" : `M${x(i)} ${y(step[name])}H${x(i + 1)}`)).join("");
  const labels = steps.map((step, i) => (i && steps[i - 1].by === step.by ? "" : `<text x="${x(i)}" y="${height - 6}">${escaped(step.by)}</text>`)).join("");
  const holder = make("div", "");
  holder.innerHTML = `<svg class="steps" viewBox="0 0 ${width} ${height}" role="img" aria-label="Best objective and bound after each entry">
<text x="4" y="${y(top / 1.05) + 4}">${(top / 1.05).toPrecision(4)}</text><text x="4" y="${y(low / 0.95) + 4}">${(low / 0.95).toPrecision(4)}</text>
<path class="upper" d="${line("upper")}"/><path class="lower" d="${line("lower")}"/>${labels}</svg>`;
  const last = steps.at(-1);
  const text = `Best known objective (upper line) and proven lower bound (lower line) after each entry of the record. Labels: who added the entry. Last entry: ${last.date}.`;
  return [make("h2", "Bounds after each entry"), holder, make("p", text, { className: "quiet" })];
}

const escaped = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);

show();
