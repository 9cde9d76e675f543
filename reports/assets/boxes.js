"use strict";
// Slices through the boxes of a search; common.js stands before it. Boxes are drawn in the order in which they were bounded, so that
// children cover their parents.

const canvas = $("#boxes");
let stages = [];

// from far below the upper bound (blue) to near it (yellow)
const shade = (share) => `hsl(${230 - 175 * share} 75% ${42 + 26 * share}%)`;

const stage = () => stages[Number($("#stage").value)];
const slice = () => stage().slices[Number($("#slice").value)];

function openStage() {
  const { slices, count } = stage();
  $("#slice").replaceChildren(...slices.map(({ axes }, at) => new Option(axes.join(" and "), at)));
  Object.assign($("#progress"), { max: count, value: count });
  draw();
}

function draw() {
  const { upper, ends, count } = stage(), chosen = slice(), now = Number($("#progress").value);
  const end = ends.findLast(([after]) => after <= now) ?? [0, 0, null];
  $("#told").textContent = `${now} of ${count} boxes bounded: normalised lower bound ${short(end[1])}, upper bound ${short(end[2])}`;
  const size = canvas.clientWidth * devicePixelRatio;
  canvas.width = canvas.height = size;
  const pen = canvas.getContext("2d");
  if (!chosen) { pen.fillText("This stage has no slice that can be drawn.", 20, 20); return; }
  const [left, right, low, high] = chosen.boxes;
  const spans = [[Math.min(...left.slice(0, 64)), Math.max(...right.slice(0, 64))], [Math.min(...low.slice(0, 64)), Math.max(...high.slice(0, 64))]];
  const zoom = 10 ** Number($("#zoom").value);
  for (const [axis, span] of spans.entries()) {
    const half = (span[1] - span[0]) / (2 * zoom), centre = zoom === 1 ? (span[0] + span[1]) / 2 : chosen.at[axis];
    spans[axis] = [centre - half, centre + half];
  }
  const edge = 34 * devicePixelRatio, room = size - 2 * edge;
  const x = (value) => edge + (room * (value - spans[0][0])) / (spans[0][1] - spans[0][0]);
  const y = (value) => size - edge - (room * (value - spans[1][0])) / (spans[1][1] - spans[1][0]);
  const pruned = color("--not_needed"), outside = color("--line"), line = color("--surface"), text = color("--text");
  pen.lineWidth = 0.5 * devicePixelRatio;
  pen.strokeStyle = line;
  pen.save();
  pen.beginPath();
  pen.rect(edge, edge, room, room);
  pen.clip();
  for (let at = 0; at < chosen.order.length && chosen.order[at] <= now; at += 1) {
    const bound = chosen.bounds[at];
    const isOut = chosen.excluded[at] && chosen.excluded[at] <= now;
    pen.fillStyle = isOut ? outside : chosen.open[at] ? shade(Math.min(1, Math.max(0, bound / upper || 0))) : pruned;
    const box = [x(left[at]), y(high[at]), x(right[at]) - x(left[at]), y(low[at]) - y(high[at])];
    pen.fillRect(...box);
    if (box[2] > 3 && box[3] > 3) pen.strokeRect(...box);
  }
  pen.restore();
  pen.strokeStyle = pen.fillStyle = text;
  pen.lineWidth = 2 * devicePixelRatio;
  const [cx, cy, arm] = [x(chosen.at[0]), y(chosen.at[1]), 7 * devicePixelRatio];
  pen.beginPath();
  pen.moveTo(cx - arm, cy); pen.lineTo(cx + arm, cy); pen.moveTo(cx, cy - arm); pen.lineTo(cx, cy + arm);
  pen.stroke();
  pen.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.fillText(`${chosen.axes[0]}: ${short(spans[0][0])} to ${short(spans[0][1])}`, size / 2, size - edge / 3);
  pen.save();
  pen.translate(edge / 2, size / 2);
  pen.rotate(-Math.PI / 2);
  pen.fillText(`${chosen.axes[1]}: ${short(spans[1][0])} to ${short(spans[1][1])}`, 0, 0);
  pen.restore();
  canvas.dataset.drawn = String(now);
}

// As many steps for a long search as for a short one; early boxes are large, so the pace rises.
let timer = null;
function play() {
  const progress = $("#progress");
  if (timer) { clearInterval(timer); timer = null; $("#play").textContent = "play"; return; }
  if (progress.value === progress.max) progress.value = 1;
  $("#play").textContent = "pause";
  timer = setInterval(() => {
    progress.value = Math.max(Number(progress.value) + 1, Math.ceil(Number(progress.value) * 1.06));
    draw();
    if (progress.value === progress.max) play();
  }, 80);
}

const drawn = (async () => {
  stages = await unpacked($("#data").textContent).json();
  $("#scale").style.background = `linear-gradient(to right, ${[0, 0.25, 0.5, 0.75, 1].map(shade).join(", ")})`;
  $("#stage").addEventListener("change", openStage);
  for (const id of ["slice", "progress", "zoom"]) $(`#${id}`).addEventListener("input", draw);
  $("#play").addEventListener("click", play);
  addEventListener("resize", draw);
  document.addEventListener("repaint", draw);
  // the stage with most boxes
  $("#stage").value = String(stages.reduce((best, { count }, at) => (count > stages[best].count ? at : best), 0));
  openStage();
})();
