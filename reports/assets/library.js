"use strict";
// The page of the library: its table, and the view of one problem. No request leaves the page.
// common.js stands before it.

enliven(document);

let known = null;
const problems = () => (known ??= unpacked($("#data").textContent).json());

// ---- one problem -------------------------------------------------------------------------------

let redraw = null;

async function show() {
  const id = decodeURIComponent(location.hash.slice(1));
  const found = id.includes("@") ? (await problems())[id] : undefined;
  $("#all").hidden = Boolean(found);
  $("#one").hidden = !found;
  redraw = null;
  if (!found) return;
  const section = make("section");
  section.append(make("a", "← All problems", { href: "#" }), make("h1", id), make("p", found.title));
  const grid = make("div", "", { className: "detail" });
  const left = make("div"), right = make("div");
  if (found.source) left.append(...picture(found));
  else left.append(...still(found));
  right.append(facts(found), ...boundsChart(found), make("h2", "Cite"), make("pre", found.cite));
  grid.append(left, right);
  section.append(grid);
  $("#one").replaceChildren(section);
  redraw?.();
  scrollTo(0, 0);
}
addEventListener("hashchange", show);

function facts(found) {
  const more = [["scale_range", found.scale_range.join(" to ")], ["unit of length", found.unit], ["origin", found.origin], ["licence", found.licence]];
  const list = make("dl", "", { className: "facts" });
  list.append(...factRows([...found.facts, ...more]));
  return list;
}

// The points of a recipe are third-party data: the page has a drawing of them at most.
function still(found) {
  const recipe = "The points are third-party data. The problem file has the recipe that fetches them.";
  if (!found.picture) return [make("p", `${recipe} They were not available when this page was built, so it has no picture.`, { className: "note" })];
  const holder = make("div");
  holder.innerHTML = found.picture;
  return [make("p", "Source at the best known pose.", { className: "quiet" }), holder, key(), make("p", recipe, { className: "note" })];
}

function key() {
  const line = make("p", "", { className: "quiet key" });
  line.innerHTML = '<span class="key-source"></span> source <span class="key-target">+</span> target';
  return line;
}

function picture(found) {
  const canvas = make("canvas", "", { tabIndex: 0 });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", "Source at the chosen pose, and target");
  const poses = { "best known pose": found.pose, "reference pose": found.truth };
  const choice = make("select");
  for (const name of Object.keys(poses)) if (poses[name]) choice.append(make("option", name));
  const bar = make("div", "", { className: "controls" });
  const label = make("label", "Source at the ");
  label.append(choice);
  bar.append(label);
  const is3d = found.source[0].length === 3;
  if (is3d) bar.append(make("span", "Drag, or use the arrow keys, to turn.", { className: "quiet" }));
  let [yaw, pitch] = OBLIQUE;
  redraw = () => drawClouds(canvas, ...[move(found.source, poses[choice.value]), found.target].map((points) => flatten(points, [yaw, pitch])), 3.2);
  choice.addEventListener("input", redraw);
  const turn = (dx, dy) => { yaw += dx; pitch = Math.max(-1.57, Math.min(1.57, pitch + dy)); redraw(); };
  if (is3d) {
    canvas.addEventListener("pointermove", (event) => { if (event.buttons) turn(event.movementX / 120, event.movementY / 120); });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (step) { event.preventDefault(); turn(...step); }
    });
  }
  return [bar, canvas, key()];
}

addEventListener("resize", () => redraw?.());
document.addEventListener("repaint", () => redraw?.());

function boundsChart(found) {
  const steps = found.history;
  if (!steps.length) return [];
  const [width, height, left, bottom] = [440, 170, 60, 24];
  const values = steps.flatMap((step) => [step.upper, step.lower]).filter((value) => value !== null);
  const top = Math.max(...values) * 1.05, low = Math.min(...values, top) * 0.95;
  const x = (i) => left + (i * (width - left - 12)) / steps.length, y = (v) => 12 + ((top - v) / (top - low || 1)) * (height - bottom - 12);
  const line = (name) => steps.map((step, i) => (step[name] === null ? "" : `M${x(i)} ${y(step[name])}H${x(i + 1)}`)).join("");
  const labels = steps.map((step, i) => (i && steps[i - 1].by === step.by ? "" : `<text x="${x(i)}" y="${height - 6}">${escaped(step.by)}</text>`)).join("");
  const holder = make("div");
  holder.innerHTML = `<svg class="steps" viewBox="0 0 ${width} ${height}" role="img" aria-label="Best objective and bound after each entry">
<text x="4" y="${y(top / 1.05) + 4}">${(top / 1.05).toPrecision(4)}</text><text x="4" y="${y(low / 0.95) + 4}">${(low / 0.95).toPrecision(4)}</text>
<path class="upper" d="${line("upper")}"/><path class="lower" d="${line("lower")}"/>${labels}</svg>`;
  const last = steps.at(-1);
  const text = `Best known objective (upper line) and proven lower bound (lower line) after each entry of the record. Labels: who added the entry. Last entry: ${last.date}.`;
  return [make("h2", "Bounds after each entry"), holder, make("p", text, { className: "quiet" })];
}

const escaped = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);

show();
