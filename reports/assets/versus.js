// ---- two methods -------------------------------------------------------------------------------

const versus = (name) => $(`[data-for="versus"][data-pick="${name}"]`);
const MOST_DIFFERING = 200; // rows of the list

function optionsOf(select, methods, chosen) {
  select.replaceChildren(...methods.map((method) => new Option(nameOf(method), method)));
  select.value = chosen;
}

function chosenComparison(data) {
  const index = Number(versus("model")?.value ?? 0), both = data.comparisons[index];
  if (versus("a").dataset.model !== String(index)) {
    versus("a").dataset.model = String(index);
    ["a", "b"].forEach((side, i) => optionsOf(versus(side), both.methods, data.start[index][i]));
  }
  return both;
}

builders.versus = (data) => {
  const both = chosenComparison(data);
  const places = ["a", "b"].map((side) => both.methods.indexOf(versus(side).value));
  const pair = { both, places, labels: places.map((i) => both.methods[i]), runs: places.map((i) => both.runs[i]) };
  countTable(pair);
  answer(pair);
  listDiffering(pair);
  const traces = ["rmse", "time"].flatMap((name, panel) => scatter(pair, name, panel ? "2" : ""));
  return { data: traces, layouts: structuredClone(data.layouts) };
};

function scatter({ both, labels, runs: [a, b] }, name, axis) {
  const kinds = [
    ["neither right", undefined, "circle-open", (i) => !a.right[i] && !b.right[i]],
    ["both right", undefined, "circle", (i) => a.right[i] && b.right[i]],
    ["only A right", labels[0], null, (i) => a.right[i] && !b.right[i]],
    ["only B right", labels[1], null, (i) => !a.right[i] && b.right[i]],
  ];
  const drawn = a.run.map((_, i) => i).filter((i) => a[name][i] > 0 && b[name][i] > 0);
  const values = drawn.flatMap((i) => [a[name][i], b[name][i]]);
  const ends = values.length ? [Math.min(...values), Math.max(...values)] : [];
  const axes = { xaxis: `x${axis}`, yaxis: `y${axis}` };
  const { test, shape, level, trial } = both.instances;
  return [
    { ...axes, x: ends, y: ends, mode: "lines", line: { width: 1 }, hoverinfo: "skip", meta: { role: "diagonal" } },
    ...kinds.map(([role, method, symbol, belongs]) => {
      const points = drawn.filter(belongs);
      return {
        ...axes, x: points.map((i) => a[name][i]), y: points.map((i) => b[name][i]), mode: "markers",
        marker: { size: 7, opacity: 0.8, symbol: symbol ?? symbolOf(method) }, meta: { role, method },
        customdata: points.map((i) => a.run[i]), // a click opens the run of A
        text: points.map((i) => `${test[i]}, ${shape[i]}, level ${level[i]}, trial ${trial[i]}`),
        hovertemplate: `%{text}<br>A %{x:.3g}, B %{y:.3g}<br>${role}<extra></extra>`,
      };
    }),
  ];
}

const symbolOf = (method) => $(`[data-toggle-method="${CSS.escape(method)}"]`).dataset.symbol;
const percentOf = (p) => (p === null ? "–" : p < 1e-4 ? "< 0.0001" : String(Number(p.toPrecision(2))));
const cellOf = (tag, content, className = "") => make(tag, content, { className });

function countTable({ both, places: [a, b] }) {
  const titles = { right: "right pose", rmse: "lower RMSE", time: "less time, both right" };
  const rows = Object.entries(titles).map(([name, title]) => {
    const [won, equal, lost, p] = both.counts[name][a][b];
    const row = document.createElement("tr");
    row.append(cellOf("th", title), ...[won, equal, lost, percentOf(p)].map((value) => cellOf("td", value, "n")));
    row.cells[0].scope = "row";
    return row;
  });
  const table = $("#versus-counts");
  table.tBodies[0].replaceChildren(...rows);
  titleCells(table);
}

function answer({ both, labels, places: [a, b], runs }) {
  const [won, equal, lost, p] = both.counts.right[a][b];
  const [one, other] = labels.map(nameOf);
  const total = won + equal + lost;
  const bothRight = runs[0].right.filter((right, i) => right && runs[1].right[i]).length;
  let text = `${one} and ${other} attempted no instance in common.`;
  if (a === b) text = "Choose two different methods.";
  else if (total && !(won + lost)) text = bothRight === total ? `${one} and ${other} are right on all ${total} instances.`
    : `${one} and ${other} are right on ${bothRight} of ${total} instances, and wrong on all others.`;
  else if (total) {
    const [first, second, more, fewer] = won >= lost ? [one, other, won, lost] : [other, one, lost, won];
    const much = p < 0.05 ? "a significant difference" : "no significant difference";
    const tested = p === null ? "" : `: ${much} (p ${p < 1e-4 ? "" : "= "}${percentOf(p)})`;
    text = `On ${total} instances, only ${first} is right on ${more} and only ${second} on ${fewer}${tested}.`;
  }
  $("#versus-answer").textContent = text;
}

function listDiffering({ both, runs: [a, b] }) {
  const differ = a.run.map((_, i) => i).filter((i) => a.run[i] && b.run[i] && a.right[i] !== b.right[i]);
  const rows = differ.slice(0, MOST_DIFFERING).map((i) => {
    const row = document.createElement("tr"), { test, shape, level, trial } = both.instances;
    const links = document.createElement("td");
    [["A", a], ["B", b]].forEach(([side, runs]) => {
      links.append(linkTo(runs.run[i], `${side}: ${runs.run[i]}`), " ");
    });
    row.append(cellOf("th", test[i].replaceAll("_", " ")), cellOf("td", shape[i]), cellOf("td", level[i], "n"), cellOf("td", trial[i], "n"),
      cellOf("td", a.right[i] ? "A" : "B"), cellOf("td", short(a.rmse[i]), "n"), cellOf("td", short(b.rmse[i]), "n"), links);
    row.cells[0].scope = "row";
    return row;
  });
  const more = differ.length > rows.length ? `, the first ${rows.length} of them listed` : "";
  $("#versus-differ summary").textContent = `${differ.length} instances on which the verdicts differ${more}`;
  const table = $("#versus-differ table");
  table.tBodies[0].replaceChildren(...rows);
  titleCells(table);
}

$("#versus-swap")?.addEventListener("click", () => {
  [versus("a").value, versus("b").value] = [versus("b").value, versus("a").value];
  draw($("#fig-versus"));
});
