"use strict";
// What the report does: unpack data, draw figures when they come into view, toggles, overlays,
// downloads. No request leaves the page. common.js stands before it.

const NARROW_PX = 640;

// ---- data next to the page -----------------------------------------------------------------------

const remembered = new Map();
function once(key, make) {
  if (!remembered.has(key)) remembered.set(key, make());
  return remembered.get(key);
}

// A page that is opened from a disk can load only scripts. Each of them calls `store`.
const delivered = new Map();
function store(name, text) { delivered.set(name, text); }

const stored = (name) => once(`data ${name}`, async () => {
  const inside = $(`[data-stored="${CSS.escape(name)}"]`);
  if (inside) return inside.textContent;
  const script = document.createElement("script");
  script.src = `data/${name}.js`;
  await new Promise((resolve, reject) => {
    script.onload = resolve;
    script.onerror = () => reject(new Error(`data/${name}.js cannot be loaded`));
    document.head.append(script);
  });
  const text = delivered.get(name);
  delivered.delete(name);
  script.remove();
  return text;
});

function tellMissing(error) {
  $("#missing").hidden = false;
  $("#missing").textContent = `${error.message}: keep the folder data/ next to this page.`;
}

const payload = (id) => once(`figure ${id}`, async () => unpacked(await stored(`figure-${id}`)).json());
const plotly = () => once("plotly", async () => loadPlotly(await stored("plotly")));

// ---- colours -----------------------------------------------------------------------------------

const variableOf = new Map(
  $$("[data-toggle-method]").map((chip) => [
    chip.dataset.toggleMethod,
    chip.dataset.variable,
  ]),
);
const nameOf = (method) => $(`[data-toggle-method="${CSS.escape(method)}"]`).textContent;
const methodColor = (method, alpha) => color(variableOf.get(method), alpha);

function themed(layout) {
  const text = color("--text"), quiet = color("--quiet"), grid = color("--grid");
  const axis = {
    gridcolor: grid, zerolinecolor: grid, linecolor: color("--line"), showline: true,
    tickfont: { color: quiet }, exponentformat: "none",
  };
  const themedLayout = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false,
    hovermode: "closest", font: { color: text, size: 12, family: getComputedStyle(document.body).fontFamily },
    modebar: { bgcolor: "rgba(0,0,0,0)", color: quiet, activecolor: color("--accent") },
    hoverlabel: { bgcolor: color("--surface"), bordercolor: color("--line"), font: { color: text }, align: "left" },
    ...layout,
  };
  for (const name of Object.keys(layout)) {
    if (/^[xy]axis/.test(name)) themedLayout[name] = { ...axis, ...layout[name] };
  }
  return themedLayout;
}

function styled(trace) {
  const { method, role } = trace.meta;
  const hue = method ? methodColor(method) : color(/source|target/.test(role) ? `--${role}` : "--quiet");
  const copy = { ...trace, type: "scatter", line: { ...trace.line, color: hue } };
  if (trace.mode.includes("markers")) copy.marker = { ...trace.marker, color: hue };
  if (role === "band") copy.fillcolor = methodColor(method, 0.14);
  return copy;
}

// ---- figures -----------------------------------------------------------------------------------

const controls = (id) => $$(`[data-for="${CSS.escape(id)}"]`);

function shown(trace, roles) {
  const { method, role } = trace.meta;
  return !(method && hidden.has(method)) && roles.get(role) !== false;
}

const builders = {
  plain(data, id) {
    const select = controls(id).find((element) => "view" in element.dataset);
    return data.views[select ? select.value : Object.keys(data.views)[0]];
  },
  bounds: boundsView,
};

// One draw at a time per figure: a later one waits, and sees the latest choices.
const queue = new Map();
function draw(element) {
  const next = (queue.get(element) ?? Promise.resolve()).then(() => drawNow(element)).catch(tellMissing);
  queue.set(element, next);
  return next;
}

async function drawNow(element) {
  if (!element.clientWidth) { seen.observe(element); return; } // folded: drawn when it is visible
  const id = element.dataset.figure;
  const [library, data] = await Promise.all([plotly(), payload(id)]);
  const view = builders[element.dataset.builder](data, id);
  const roles = new Map(controls(id).filter((c) => c.dataset.role).map((c) => [c.dataset.role, c.checked]));
  const traces = view.data.filter((trace) => shown(trace, roles)).map(styled);
  const layout = themed(view.layouts[element.clientWidth < NARROW_PX ? "narrow" : "wide"]);
  for (const control of controls(id).filter((c) => c.dataset.scale)) {
    for (const name of data.scales[control.dataset.scale] ?? []) {
      layout[name] = { ...layout[name], type: control.checked ? "log" : "linear" };
      if (control.checked) delete layout[name].range;
    }
  }
  labelLogAxes(layout, traces, element.clientWidth < NARROW_PX ? 4 : 7);
  // Not plotly's own "responsive": it forgets the height. A new width redraws, see below.
  layout.width = element.clientWidth;
  $(".wait", element)?.remove();
  await library.react(element, traces, layout, {
    displaylogo: false, displayModeBar: "hover",
    modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"],
    toImageButtonOptions: { format: "svg", filename: id },
  });
  if (!element.dataset.drawn) element.on("plotly_click", openRun);
  element.dataset.drawn = String(Number(element.dataset.drawn ?? 0) + 1);
}

// A click on a point or trace of a run opens the view of this run.
function openRun({ points: [point] }) {
  const run = point.customdata ?? point.data.meta.run;
  if (run) location.hash = `run=${run}`;
}

// Plain numbers at 1, 2, 5 or at powers of ten, depending on how much the axis spans.
function labelLogAxes(layout, traces, most) {
  const spans = new Map();
  for (const trace of traces) {
    for (const letter of ["x", "y"]) {
      const axis = layout[(trace[`${letter}axis`] ?? letter).replace(letter, `${letter}axis`)];
      if (axis.type !== "log") continue;
      const group = axis.matches ?? trace[`${letter}axis`];
      const [low, high] = spans.get(group) ?? [Infinity, 0];
      const positive = trace[letter].filter((value) => value > 0);
      spans.set(group, [Math.min(low, ...positive), Math.max(high, ...positive)]);
    }
  }
  for (const [name, axis] of Object.entries(layout)) {
    const span = /^[xy]axis/.test(name) && spans.get(axis.matches ?? name.replace("axis", ""));
    if (axis.type === "log" && span && span[1] > 0) Object.assign(axis, logTicks(...span, most));
  }
}

function logTicks(low, high, most) {
  const decades = Math.log10(high / low);
  const digits = decades < 0.8 ? [1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9] : decades < 1.5 ? [1, 2, 5] : decades < 3 ? [1, 3] : [1];
  const stride = Math.ceil(decades / most) || 1;
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)) - 1; power <= Math.log10(high) + 1; power += 1) {
    if (power % stride === 0) ticks.push(...digits.map((digit) => Number(`${digit}e${power}`)));
  }
  const text = (value) => (value < 1e-4 || value >= 1e5 ? value.toExponential().replace("e+", "e") : String(value));
  return { tickmode: "array", tickangle: 0, tickvals: ticks, ticktext: ticks.map(text) };
}

const seen = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    seen.unobserve(target);
    if (target.tagName === "CANVAS") drawThumbnail(target);
    else draw(target);
  }
}, { rootMargin: "300px" });

const figures = $$("[data-figure]");
figures.forEach((figure) => seen.observe(figure));
const redraw = () => figures.filter((figure) => figure.dataset.drawn).forEach(draw);

let width = innerWidth;
addEventListener("resize", () => {
  if (innerWidth === width) return;
  width = innerWidth;
  redraw();
});

// ---- bound histories ---------------------------------------------------------------------------

const pick = (name) => $(`[data-for="bounds"][data-pick="${name}"]`);
const caseName = (item) => `${item.test} · ${item.shape} (${item.model})`;

function fill(select, values) {
  const kept = select.value;
  const unique = [...new Set(values.map(String))];
  select.replaceChildren(...unique.map((value) => new Option(value, value)));
  if (unique.includes(kept)) select.value = kept;
}

function chosenInstance(data) {
  if (!pick("case").options.length) {
    fill(pick("case"), data.instances.map(caseName));
    choose(data, data.instances[data.start]);
  }
  const inCase = data.instances.filter((item) => caseName(item) === pick("case").value);
  fill(pick("level"), inCase.map((item) => item.level));
  const inLevel = inCase.filter((item) => String(item.level) === pick("level").value);
  fill(pick("trial"), inLevel.map((item) => item.trial));
  const instance = inLevel.find((item) => String(item.trial) === pick("trial").value);
  fillStages(instance);
  return instance;
}

// The first stage shown is the one with most boxes; stages of initial poses bound none.
function fillStages({ runs }) {
  const boxes = new Map();
  for (const run of runs) {
    for (const [stage, { nodes }] of Object.entries(run.stages)) boxes.set(stage, Math.max(boxes.get(stage) ?? 0, ...nodes));
  }
  const isNew = !pick("stage").options.length;
  fill(pick("stage"), [...boxes.keys()]);
  if (isNew) pick("stage").value = [...boxes].reduce((best, one) => (one[1] > best[1] ? one : best))[0];
}

function choose(data, instance) {
  pick("case").value = caseName(instance);
  chosenInstance(data);
  pick("level").value = String(instance.level);
  chosenInstance(data);
  pick("trial").value = String(instance.trial);
}

function boundsView(data) {
  const instance = chosenInstance(data);
  const stage = pick("stage").value, work = pick("work").value;
  const traces = instance.runs.flatMap((run) => runTraces(run, run.stages[stage], work));
  tellRuns(instance, stage);
  const range = clipped(instance.runs.filter((run) => !hidden.has(run.method)).map((run) => run.stages[stage]));
  const layouts = {};
  for (const [name, layout] of Object.entries(data.layouts)) {
    const copy = structuredClone(layout);
    for (const [axis, title] of [["xaxis3", "time (s)"], ["xaxis4", work]]) copy[axis].title.text = title;
    for (const axis of ["yaxis", "yaxis2"]) copy[axis] = { ...copy[axis], ...range };
    // plotly would give axes that match each other a default range once any other axis has one
    for (const axis of ["yaxis3", "yaxis4"]) copy[axis].autorange = true;
    if (name === "narrow") { copy.xaxis.title.text = "time (s)"; copy.xaxis2.title.text = work; }
    layouts[name] = copy;
  }
  return { data: traces, layouts };
}

// The axis does not follow lower bounds far below 0 and upper bounds far above the last ones.
function clipped(runs) {
  const stages = runs.filter(Boolean);
  const last = Math.max(...stages.map(({ upper }) => upper.at(-1) ?? 0));
  const ends = stages.flatMap(({ lower, upper }) => [...lower, ...upper]).filter((value) => value !== null);
  const isFar = Math.min(...ends) < -0.5 * last || Math.max(...ends) > 10 * last;
  return isFar && last > 0 ? { range: [-0.5 * last, 2 * last] } : {};
}

function runTraces(run, stage, work) {
  if (!stage) return [];
  const gap = stage.upper.map((upper, i) => (upper === null || stage.lower[i] === null ? null : Math.max(0, upper - stage.lower[i])));
  return [[stage.time, "", "3"], [stage[work], "2", "4"]].flatMap(([x, top, bottom]) => {
    // with markers, as a search may end at its first event
    const line = (y, axis, what, symbol = run.symbol, width = 2) => ({
      x, y, xaxis: `x${axis}`, yaxis: `y${axis}`, mode: "lines+markers", name: nameOf(run.method),
      line: { shape: "hv", dash: run.dash, width }, marker: { size: 7, symbol, maxdisplayed: 12 }, meta: { method: run.method, role: what, run: run.run },
      hovertemplate: `<b>${nameOf(run.method)}</b> ${what}<br>%{y:.5g} at %{x:.4g}<br>${run.run}<extra></extra>`,
    });
    const flat = (value, axis, what, method) => ({
      ...line([value, value], axis, what), mode: "lines", x: [x[0], x.at(-1)], line: { dash: "dot", width: 1 }, meta: { method, role: what },
    });
    return [
      line(stage.lower, top, "lower bound"),
      line(stage.upper, top, "upper bound", `${run.symbol}-open`, 1.2),
      line(gap, bottom, "gap"),
      ...(run.gap_tol ? [flat(run.gap_tol, bottom, "tolerance", run.method)] : []),
      ...(run.truth !== null ? [flat(run.truth, top, "objective at the reference pose", undefined)] : []),
    ];
  });
}

function tellRuns(instance, stage) {
  const head = document.createElement("tr");
  head.append(...["method", "status of the run", "scope of the bounds", "lower bound", "upper bound", "gap", "tolerance", "nodes", "run"].map((title) => make("th", title)));
  const rows = instance.runs.filter((run) => run.stages[stage]).map((run) => {
    const { lower, upper, nodes } = run.stages[stage];
    const [low, high] = [lower.at(-1), upper.at(-1)];
    const row = document.createElement("tr");
    row.dataset.method = run.method;
    row.hidden = hidden.has(run.method);
    const name = make("th", nameOf(run.method));
    name.prepend(dotOf(run.method));
    row.append(name, make("td", run.status), make("td", run.scope || "–"),
      ...[low, high, high - low, run.gap_tol, nodes.at(-1)].map((value) => make("td", short(value))), make("td"));
    row.lastChild.append(linkTo(run.run));
    return row;
  });
  const table = make("table", "", { className: "stack" });
  table.append(document.createElement("thead"), document.createElement("tbody"));
  table.tHead.append(head);
  table.tBodies[0].append(...rows);
  titleCells(table);
  $("#bounds-runs").replaceChildren(table);
}

async function step(by) {
  const data = await payload("bounds");
  const count = data.instances.length, here = data.instances.indexOf(chosenInstance(data));
  choose(data, data.instances[(here + by + count) % count]);
  draw($("#fig-bounds"));
}
$$("[data-step]").forEach((button) => button.addEventListener("click", () => step(Number(button.dataset.step))));

// ---- overlays ----------------------------------------------------------------------------------

async function drawThumbnail(canvas) {
  const found = await recordOf(canvas.dataset.run).catch(tellMissing);
  if (!found?.clouds) {
    canvas.closest(".view")?.replaceChildren("not drawn: the tables contain no clouds of this instance");
    return;
  }
  if (!canvas.clientWidth) { seen.observe(canvas); return; }
  const { clouds, record } = found;
  const source = canvas.dataset.when === "before" ? clouds.source : record.pose ? move(clouds.source, record.pose) : [];
  drawClouds(canvas, flatten(source), flatten(clouds.target), 1.7);
  canvas.dataset.drawn = "1";
}

// ---- switches ----------------------------------------------------------------------------------

document.addEventListener("change", ({ target }) => {
  const figure = target.dataset.for && document.getElementById(`fig-${target.dataset.for}`);
  if (figure?.dataset.drawn) draw(figure);
});

const chips = $$("[data-toggle-method]");
function showMethods() {
  for (const chip of chips) chip.setAttribute("aria-pressed", String(!hidden.has(chip.dataset.toggleMethod)));
  $("#shown-methods").textContent = `${variableOf.size - hidden.size} of ${variableOf.size}`;
  $("#hidden-note").hidden = !hidden.size;
  for (const item of $$("main [data-method]")) item.hidden = hidden.has(item.dataset.method);
  $$("[data-filters]").forEach(filter);
  document.dispatchEvent(new Event("methods-changed"));
  redraw();
}
chips.forEach((chip) => chip.addEventListener("click", () => {
  const method = chip.dataset.toggleMethod;
  if (!hidden.delete(method)) hidden.add(method);
  showMethods();
}));
$$("[data-all-methods]").forEach((button) => button.addEventListener("click", () => {
  hidden.clear();
  if (button.dataset.allMethods === "hide") for (const method of variableOf.keys()) hidden.add(method);
  showMethods();
}));

document.addEventListener("repaint", () => {
  redraw();
  $$("canvas[data-drawn]").forEach(drawThumbnail);
});

// ---- tables and closed parts -------------------------------------------------------------------

enliven($("main"));

// A closed part gets its content when it is opened for the first time.
const partsOf = (section) => once(`parts ${section}`, async () => unpacked(await stored(`parts-${section}`)).json());
async function fillPart(details) {
  const { section, part } = details.dataset;
  details.insertAdjacentHTML("beforeend", (await partsOf(section))[Number(part)]);
  enliven(details);
  details.dataset.filled = "1";
}
$$("details[data-part]").forEach((details) => {
  details.addEventListener("toggle", () => fillPart(details).catch(tellMissing), { once: true });
});

// ---- downloads ---------------------------------------------------------------------------------

const MIME = { csv: "text/csv", json: "application/json", svg: "image/svg+xml", pdf: "application/pdf" };

const contentOf = async (name) => unpacked(await stored(`file-${name}`)).arrayBuffer();
$$("[data-save]").forEach((button) => button.addEventListener("click", async () => {
  const name = button.dataset.save;
  const blob = new Blob([await contentOf(name)], { type: MIME[name.split(".").pop()] });
  const link = make("a", "", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}));

// ---- where we are ------------------------------------------------------------------------------

new ResizeObserver(([{ target }]) => {
  if (!$(".methods").open) root.style.setProperty("--top", `${target.offsetHeight}px`);
}).observe($(".top"));

const links = new Map($$("nav a").map((link) => [link.hash.slice(1), link]));
const here = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) links.get(target.id).classList.toggle("here", isIntersecting);
}, { rootMargin: "-30% 0px -60% 0px" });
$$("main > section").forEach((section) => here.observe(section));
