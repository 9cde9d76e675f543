"use strict";
// The view of one run, made on demand; the address fragment #run=ID opens it.

const dialog = $("#run");
const current = { run: null, record: null, clouds: null, at: null, data: null };

const chunk = (number) => once(`runs ${number}`, async () => unpacked(await stored(`runs-${number}`)).json());

async function recordOf(run) {
  const data = await runsTable(), at = data.at.get(run);
  if (at === undefined) return null;
  const part = await chunk(data.values.chunk[at]), record = part.runs[run];
  return { data, at, run, record, clouds: part.clouds[record.instance] };
}

const runInAddress = () => /^#run=([\w.-]+)$/.exec(location.hash)?.[1];
const withoutRun = () => history.replaceState(null, "", location.pathname + location.search);

async function followAddress() {
  const run = runInAddress();
  if (!run) {
    if (dialog.open) dialog.close();
    return;
  }
  let found = null;
  try { found = await recordOf(run); } catch (error) { tellMissing(error); return; }
  if (run !== runInAddress()) return; // the address has changed since
  $("#run-body").hidden = !found;
  $("#run-missing").hidden = Boolean(found);
  if (!dialog.open) dialog.showModal();
  dialog.scrollTop = 0;
  if (!found) {
    $("#run-heading").textContent = `Run ${run}`;
    $("#run-verdict").textContent = "";
    $("#run-missing").textContent = `There is no run ${run} in this page; it lists ${(await runsTable()).count} runs.`;
    return;
  }
  Object.assign(current, found);
  tellRun(found);
  await drawRun();
}

function tellRun({ data, at, run, record }) {
  const { values } = data;
  const method = data.names[values.method[at]], answer = data.word("answer", at);
  $("#run-heading").replaceChildren(dotOf(data.words.method[values.method[at]]), `${method}: ${titleOf(data, at)}`);
  $("#run-verdict").replaceChildren(
    badgeOf(answer), answer === "wrong" && record.cause ? ` (${record.cause})` : "",
    ` · status ${data.word("status", at)}: ${record.reason} · run ${run}`,
  );
  const facts = [
    ["RMSE over the true pairs", values.rmse[at]], ["error above the floor", record.rmse_excess], ["floor: fit to the true pairs", record.rmse_floor],
    ["rotation error (°)", values.rotation[at]], ["translation error", record.translation_error], ["scale error", data.word("model", at) === "rigid3d" ? null : record.scale_error],
    ["objective E at this pose", record.objective], ["E at the reference pose", record.objective_true], ["best known objective E", record.objective_best],
    ["lower bound", record.lower_bound], ["upper bound", record.upper_bound], ["gap", record.gap], ["tolerance", record.gap_tol], ["scope of the bounds", record.scope],
    ["time (s)", values.time[at]], ["nodes", values.nodes[at]], ["assignments", record.n_assignments],
    ["n_inliers given", record.n_inliers], ["true pairs", record.n_inliers_true], ["points of source and target", `${record.n_source}, ${record.n_target}`], ["noise bound given", record.noise_bound],
  ];
  const known = facts.filter(([, value]) => value !== undefined && value !== null && value !== "");
  $("#run-facts").replaceChildren(...factRows(known.map(([name, value]) => [name, typeof value === "number" ? short(value) : value])));
  $("#run-replay").textContent = `${data.replay}${run}`;
  const stages = Object.keys(record.stages);
  $("#run-boxes-text").hidden = !stages.length;
  $("#run-history-part").hidden = !stages.length;
  $("#run-stage").replaceChildren(...stages.map((name) => new Option(name, name)));
  // the stage that bounds most boxes; stages of initial poses bound none
  const boxes = (name) => Math.max(0, ...record.stages[name].nodes);
  if (!stages.length) return;
  const main = stages.reduce((best, name) => (boxes(name) > boxes(best) ? name : best));
  const times = record.stages[main].time.filter((value) => value > 0);
  $("#run-stage").value = main;
  $("#run-log").checked = times.at(-1) > 10 * times[0];
}

async function drawRun() {
  const library = await plotly();
  await Promise.all([drawRunClouds(library), drawResiduals(library), drawHistory(library)]);
  dialog.dataset.drawn = current.run;
}

const runConfig = { displaylogo: false, displayModeBar: false };
async function drawIn(library, id, traces, layout) {
  const element = $(`#${id}`);
  const narrow = element.clientWidth < NARROW_PX;
  const whole = themed({ ...layout(narrow), width: element.clientWidth });
  if (!("scene" in whole)) labelLogAxes(whole, traces, narrow ? 4 : 7);
  await library.react(element, traces, whole, runConfig);
}

// ---- overlay -----------------------------------------------------------------------------------

const isShown = (part) => $(`#run-parts [data-part="${part}"]`).checked;

function drawRunClouds(library) {
  const { clouds, record } = current;
  $("#run-overlay").hidden = !clouds;
  $("#run-parts").hidden = !clouds;
  $("#run-clouds").textContent = clouds ? cloudsText(clouds, record) : "The tables of this experiment contain no clouds of this instance.";
  $$('#run-parts [data-part="found"], #run-parts [data-part="pairs"]').forEach((box) => { box.disabled = !record.pose; });
  if (!clouds) return null;
  const flat = clouds.source[0].length === 2;
  const cloud = (name, points, variable, symbol, size) => ({
    type: flat ? "scatter" : "scatter3d", mode: "markers", name, hoverinfo: "name", meta: { role: name },
    x: points.map((p) => p[0]), y: points.map((p) => p[1]), ...(flat ? {} : { z: points.map((p) => p[2]) }),
    marker: { symbol: flat ? symbol[0] : symbol[1], size: flat ? size : size / 2, color: color(variable) },
  });
  const traces = [cloud("target", clouds.target, "--target", ["cross-thin-open", "cross"], 7)];
  if (isShown("reference") && record.reference) traces.push(cloud("source, reference pose", move(clouds.source, record.reference), "--quiet", ["diamond-open", "diamond-open"], 9));
  if (isShown("before")) traces.push(cloud("source as given", clouds.source, "--good", ["square-open", "square-open"], 6));
  if (isShown("found") && record.pose) traces.push(cloud("source, pose found", move(clouds.source, record.pose), "--source", ["circle-open", "circle-open"], 7));
  if (isShown("pairs") && record.pose) traces.push(...pairLines(flat, clouds, record));
  return drawIn(library, "run-overlay", traces, (narrow) => overlayLayout(flat, narrow));
}

function cloudsText(clouds, record) {
  const thinned = record.n_source > clouds.source.length || record.n_target > clouds.target.length;
  const pairs = clouds.kind === "true" ? "true pairs" : "mutual nearest neighbours at the reference pose, closer than the noise bound";
  return `Coordinates are rounded for display${thinned ? `; ${clouds.source.length} of ${record.n_source} source points and ${clouds.target.length} of ${record.n_target} target points are shown` : ""}. `
    + (record.pose ? `Lines join ${clouds.pairs.length} pairs (${pairs}) at the pose found; amber ones are longer than the noise bound given to all methods. ` : "The run has no pose. ")
    + (clouds.source[0].length === 3 ? "Drag to turn the clouds." : "");
}

function pairLines(flat, clouds, record) {
  const residuals = residualsOf(clouds, record.pose), moved = move(clouds.source, record.pose);
  return [["pairs within the noise bound", "--quiet", (r) => r <= record.noise_bound], ["pairs beyond the noise bound", "--warn", (r) => r > record.noise_bound]].map(([name, variable, fits]) => {
    const ends = clouds.pairs.flatMap(([i, j], at) => (fits(residuals[at]) ? [moved[i], clouds.target[j], []] : []));
    const axis = (which) => ends.map((p) => p[which] ?? null);
    return {
      type: flat ? "scatter" : "scatter3d", mode: "lines", name, hoverinfo: "skip", meta: { role: name }, x: axis(0), y: axis(1), ...(flat ? {} : { z: axis(2) }),
      line: { color: color(variable), width: flat ? 1.2 : 2 },
    };
  }).filter((trace) => trace.x.length);
}

const residualsOf = (clouds, pose) => {
  const moved = move(clouds.source, pose);
  return clouds.pairs.map(([i, j]) => Math.hypot(...moved[i].map((value, axis) => value - clouds.target[j][axis])));
};

function overlayLayout(flat, narrow) {
  const layout = {
    height: narrow ? 420 : Math.min(620, innerHeight * 0.7), margin: { l: 40, r: 8, t: 8, b: 28 }, showlegend: true,
    legend: { orientation: "h", x: 0, xanchor: "left", y: -0.08, yanchor: "top", itemsizing: "constant" }, uirevision: current.run,
  };
  if (flat) return { ...layout, xaxis: {}, yaxis: { scaleanchor: "x" } };
  const axis = { title: { text: "" }, gridcolor: color("--grid"), color: color("--quiet"), showbackground: false };
  return { ...layout, scene: { aspectmode: "data", camera: { eye: { x: 1.5, y: 1.5, z: 1.1 } }, xaxis: axis, yaxis: axis, zaxis: axis } };
}

function drawResiduals(library) {
  const { clouds, record } = current;
  const has = clouds && clouds.pairs.length > 0 && (record.pose || record.reference);
  $("#run-residuals-part").hidden = !has;
  if (!has) return null;
  const curve = (name, pose, variable, dash) => {
    const values = residualsOf(clouds, pose).sort((a, b) => a - b);
    return {
      type: "scatter", mode: "lines", name, x: values.map((_, at) => at + 1), y: values, meta: { role: name },
      line: { color: color(variable), dash, width: 2 }, hovertemplate: `${name}<br>%{x} pairs up to %{y:.3g}<extra></extra>`,
    };
  };
  const traces = [];
  if (record.reference) traces.push(curve("reference pose", record.reference, "--quiet", "dash"));
  if (record.pose) traces.push(curve("pose found", record.pose, "--source", "solid"));
  if (record.noise_bound) traces.push({ type: "scatter", mode: "lines", name: "noise bound", x: [1, clouds.pairs.length], y: [record.noise_bound, record.noise_bound], meta: { role: "noise bound" }, line: { color: color("--warn"), dash: "dot", width: 1 }, hoverinfo: "name" });
  return drawIn(library, "run-residuals", traces, () => ({
    height: 260, margin: { l: 56, r: 8, t: 8, b: 44 }, showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
    xaxis: { title: { text: "pairs, sorted by residual" } }, yaxis: { title: { text: "residual" }, rangemode: "tozero" },
  }));
}

// ---- history -----------------------------------------------------------------------------------

const AXES = { time: "time (s)", nodes: "nodes", assignments: "assignments" };

function drawHistory(library) {
  const { record } = current, stage = record.stages[$("#run-stage").value];
  if (!stage) return null;
  const axis = $("#run-axis").value, isLog = $("#run-log").checked;
  const x = isLog ? stage[axis].map((value) => (value > 0 ? value : null)) : stage[axis];
  const ends = [x.find((value) => value !== null), x.at(-1)];
  const line = (y, panel, name, variable, dash = "solid") => ({
    type: "scatter", mode: "lines+markers", name, x, y, yaxis: panel, xaxis: "x", meta: { role: name },
    line: { shape: "hv", color: color(variable), dash, width: 2 }, marker: { size: 5, color: color(variable), maxdisplayed: 15 },
    hovertemplate: `${name}: %{y:.5g}<br>${AXES[axis]} %{x:.4g}<extra></extra>`,
  });
  const flat = (value, panel, name) => ({ ...line([value, value], panel, name, "--quiet", "dot"), mode: "lines", x: ends });
  const gap = stage.upper.map((upper, at) => (upper === null || stage.lower[at] === null ? null : Math.max(0, upper - stage.lower[at])));
  const errorOf = (objective) => Math.sqrt(Math.max(0, objective) / record.n_inliers);
  const error = stage.upper.map((upper) => (upper === null ? null : errorOf(upper)));
  const truth = record.is_of_pose ? record.objective_true ?? 0 : 0;
  const traces = [
    line(stage.upper, "y", "upper bound", "--source", "dash"), line(stage.lower, "y", "lower bound", "--accent"),
    line(gap, "y2", "gap", "--good"), line(error, "y3", "error of the incumbent", "--source"),
  ];
  if (record.gap_tol) traces.push(flat(record.gap_tol, "y2", "tolerance"));
  if (record.is_of_pose && record.objective_true !== undefined) {
    traces.push(flat(record.objective_true, "y", "E at the reference pose"), flat(errorOf(truth), "y3", "error of the reference pose"));
  }
  $("#run-history-text").textContent = `Error of the incumbent: √(upper bound / n_inliers), the RMS residual per pair${record.is_of_pose ? "" : " of the quantity that this stage bounds"}. Dotted lines: values at the reference pose, and the tolerance. The bounds refer to: ${record.scope || "the objective of the stage"}. The history is thinned for display. If values are far from the last ones, a panel shows only the range near these; double-click it to see all.`;
  return drawIn(library, "run-history", traces, (narrow) => ({
    height: narrow ? 620 : 560, margin: { l: 62, r: 8, t: 30, b: 44 }, showlegend: true, legend: { orientation: "h", y: 1.02, yanchor: "bottom" },
    xaxis: { title: { text: AXES[axis] }, type: isLog ? "log" : "linear", anchor: "y3" },
    yaxis: { domain: [0.7, 1], title: { text: "bounds" }, rangemode: "tozero", ...near(clipped([stage]).range, truth, stage.lower.at(-1)) },
    yaxis2: { domain: [0.36, 0.64], title: { text: "gap" }, type: gap.some((value) => value > 0) ? "log" : "linear" },
    yaxis3: { domain: [0, 0.3], title: { text: "error" }, rangemode: "tozero", ...near(farFrom(error), errorOf(truth)) },
  }));
}

// A range near the last upper bound also shows other values, such as the last lower bound.
function near(range, ...others) {
  const ends = others.map((value) => 1.2 * value);
  return range ? { range: [Math.min(range[0], ...ends), Math.max(range[1], ...ends)] } : {};
}

function farFrom(values) {
  const known = values.filter((value) => value !== null), last = known.at(-1);
  return last > 0 && Math.max(...known) > 4 * last ? [0, 2 * last] : null;
}

// ---- events ------------------------------------------------------------------------------------

addEventListener("hashchange", followAddress);
dialog.addEventListener("close", () => { if (runInAddress()) withoutRun(); delete dialog.dataset.drawn; });
$("#run-close").addEventListener("click", () => dialog.close());
$("#run-parts").addEventListener("change", async () => drawRunClouds(await plotly()));
for (const id of ["run-axis", "run-stage", "run-log"]) $(`#${id}`).addEventListener("change", async () => drawHistory(await plotly()));
$$("[data-run-step]").forEach((button) => button.addEventListener("click", async () => {
  if (!listing.rows.length) await listRuns();
  const place = listing.rows.indexOf(current.at), count = listing.rows.length;
  if (count) location.hash = `run=${current.data.values.run[listing.rows[(place + Number(button.dataset.runStep) + count) % count]]}`;
}));
$("#run .copy").addEventListener("click", async ({ target }) => {
  await navigator.clipboard.writeText($("#run-replay").textContent);
  target.textContent = "copied";
  setTimeout(() => { target.textContent = "copy"; }, 1500);
});
document.addEventListener("repaint", () => { if (dialog.open && current.run) drawRun(); });
followAddress();
