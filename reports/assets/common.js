"use strict";
// What all pages with scripts share: elements, colours and the theme, tables, drawings of clouds.
// dcreg/plot/unpack.js stands before it.

const $ = (selector, root = document) => root.querySelector(selector);
const $$ = (selector, root = document) => [...root.querySelectorAll(selector)];
const make = (tag, text = "", attributes = {}) => Object.assign(document.createElement(tag), { textContent: text }, attributes);
const short = (value) => (value === null || value === undefined || Number.isNaN(value) ? "–" : String(Number(value.toPrecision(4))));

// The rows of a list of facts, from pairs of name and text.
const factRows = (facts) => facts.map(([name, text]) => {
  const row = make("div");
  row.append(make("dt", name), make("dd", text));
  return row;
});

// ---- colours and theme -------------------------------------------------------------------------

// Custom properties hold light-dark(...); only a used value tells which side applies.
const probe = document.body.appendChild(document.createElement("i"));
probe.hidden = true;
function color(variable, alpha = 1) {
  probe.style.color = `var(${variable})`;
  const [r, g, b] = getComputedStyle(probe).color.match(/[\d.]+/g);
  return `rgba(${r}, ${g}, ${b}, ${alpha})`;
}

// What is drawn in colours of the theme listens to "repaint".
const dark = matchMedia("(prefers-color-scheme: dark)");
const root = document.documentElement;
const repaint = () => document.dispatchEvent(new Event("repaint"));
$("#theme").addEventListener("click", () => {
  const now = root.dataset.theme ?? (dark.matches ? "dark" : "light");
  root.dataset.theme = now === "dark" ? "light" : "dark";
  repaint();
});
dark.addEventListener("change", repaint);

// ---- tables and cards --------------------------------------------------------------------------

const hidden = new Set(); // methods switched off

// The query is one line of text, exact choices, and limits; a hidden method hides its rows.
function filter(bar) {
  const list = document.getElementById(bar.dataset.filters);
  const items = list.tBodies ? [...list.tBodies[0].rows] : [...list.children];
  const words = ($("[data-filter-text]", bar)?.value ?? "").toLowerCase().split(/\s+/).filter(Boolean);
  const given = (kind) => $$(`[data-${kind}]`, bar).filter((control) => control.value);
  const [exact, least, most] = ["filter", "least", "most"].map(given);
  let count = 0;
  for (const item of items) {
    const text = (item.dataset.text ?? item.textContent).toLowerCase();
    item.hidden = hidden.has(item.dataset.method)
      || exact.some(({ dataset, value }) => item.dataset[dataset.filter] !== value)
      || least.some(({ dataset, value }) => Number(item.dataset[dataset.least]) < Number(value))
      || most.some(({ dataset, value }) => Number(item.dataset[dataset.most]) > Number(value))
      || words.some((word) => !text.includes(word));
    count += !item.hidden;
  }
  $("[data-count]", bar).textContent = `${count} of ${items.length}`;
}
const sortValue = (cell) => {
  const raw = cell.dataset.sort ?? cell.textContent.trim();
  const asNumber = Number(raw);
  return raw === "" ? null : Number.isNaN(asNumber) ? raw.toLowerCase() : asNumber;
};

function sort(table, column, descending) {
  const rows = [...table.tBodies[0].rows].map((row) => [sortValue(row.cells[column]), row]);
  rows.sort(([a], [b]) => {
    if (a === null || b === null) return (a === null) - (b === null); // missing last, either way
    const order = typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b));
    return descending ? -order : order;
  });
  table.tBodies[0].append(...rows.map(([, row]) => row));
}

function makeSortable(table) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    if ("fixed" in head.dataset) return;
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const descending = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", descending ? "descending" : "ascending");
      sort(table, column, descending);
    });
  });
}

// On a narrow screen a row is a card: each cell says what it is.
function titleCells(table) {
  const titles = [...table.tHead.rows[0].cells].map((head) => ("alone" in head.dataset ? "" : head.textContent));
  for (const row of [...table.tBodies[0].rows, ...(table.tFoot?.rows ?? [])]) {
    [...row.cells].forEach((cell, i) => { if (titles[i] && cell.tagName === "TD" && cell.textContent.trim()) cell.dataset.title = titles[i]; });
  }
}

// Makes the tables of the page, or of a part of it, work.
function enliven(part) {
  $$("[data-filters]", part).forEach((bar) => {
    bar.addEventListener("input", () => filter(bar));
    filter(bar);
  });
  $$("table.sortable", part).forEach(makeSortable);
  $$("table.stack", part).forEach(titleCells);
  for (const item of $$("[data-method]", part)) item.hidden = hidden.has(item.dataset.method);
}

// ---- clouds ------------------------------------------------------------------------------------

const move = (points, T) => points.map((p) =>
  p.map((_, i) => p.reduce((sum, value, j) => sum + T[i][j] * value, T[i][p.length])));

// A 3D cloud is seen along an oblique direction.
const OBLIQUE = [-Math.PI / 6, 0.6435];
function flatten(points, [yaw, pitch] = OBLIQUE) {
  if (points[0]?.length !== 3) return points;
  const [c, s, k, l] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return points.map(([x, y, z]) => [c * x + s * y, k * z + l * (c * y - s * x)]);
}

// Draws two flat clouds: crosses for the target, circles for the source.
function drawClouds(canvas, source, target, radius) {
  const size = canvas.clientWidth * devicePixelRatio, r = radius * devicePixelRatio;
  canvas.width = canvas.height = size;
  const pen = canvas.getContext("2d");
  const all = [...source, ...target];
  const spans = [0, 1].map((axis) => {
    const values = all.map((p) => p[axis]);
    return [Math.min(...values), Math.max(...values)];
  });
  const extent = Math.max(...spans.map(([low, high]) => high - low)) || 1;
  const place = (p) => p.map((value, axis) => {
    const centred = (value - (spans[axis][0] + spans[axis][1]) / 2) / extent;
    return size * (0.5 + 0.9 * (axis ? -centred : centred));
  });
  pen.lineWidth = Math.max(1, radius / 2) * devicePixelRatio;
  pen.strokeStyle = color("--target");
  pen.beginPath();
  for (const [x, y] of target.map(place)) {
    pen.moveTo(x - r, y); pen.lineTo(x + r, y); pen.moveTo(x, y - r); pen.lineTo(x, y + r);
  }
  pen.stroke();
  pen.strokeStyle = color("--source");
  for (const [x, y] of source.map(place)) { pen.beginPath(); pen.arc(x, y, r, 0, 7); pen.stroke(); }
}
