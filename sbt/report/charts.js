// Figures by Plotly; it reads some markup in texts, which therefore are escaped.
const PLAIN = { displaylogo: false, responsive: true, displayModeBar: false, showSendToCloud: false, plotlyServerURL: "" };  // nothing leaves the page
const narrow = () => window.innerWidth < 700;
const TOOLS = { ...PLAIN, displayModeBar: !narrow(), modeBarButtonsToRemove: ["toImage", "autoScale2d", "zoomIn2d", "zoomOut2d"] };
const safe = text => shortened(String(text)).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");
const webgl = (() => { try { return Boolean(document.createElement("canvas").getContext("webgl")); } catch { return false; } })();
const SHAPES = ["circle", "triangle-up", "x"];
const shades = () => [colour("--safe"), colour("--critical"), colour("--soft")];

const look = layout => {
  const axis = () => ({ gridcolor: colour("--line"), zeroline: false, linecolor: colour("--soft"), automargin: true });
  return { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colour("--ink"), size: 12, family: "system-ui, sans-serif" },
    margin: { l: 56, r: 14, t: 10, b: 48 }, modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("--soft"), activecolor: colour("--accent") },
    hoverlabel: { bgcolor: colour("--card"), font: { color: colour("--ink") } },
    xaxis: axis(), yaxis: axis(), ...layout };
};
const axisOf = column => {
  const axis = { title: { text: safe(titled(column)) } };
  if (column.choices.length)
    return { ...axis, tickvals: column.choices.map((_, k) => k), ticktext: column.choices.map(safe), range: [-0.5, column.choices.length - 0.5] };
  if (column.log) return { ...axis, type: "log", exponentformat: "power" };
  return column.whole && column.high - column.low < 12 ? { ...axis, tick0: Math.ceil(column.low), dtick: 1 } : axis;
};
// Ranges of a column on its axis in parallel, or back: that of an input over decades has logarithms.
const brushed = (column, ranges, change) => column.log && ranges ? ranges.map(range => range.map(change)) : ranges;
// Values of a column; whole numbers and choices are spread around their value, so that runs do not hide each other.
const spread = (column, rows, index, step) => rows.map(row =>
  column.whole ? column.values[row] + 0.5 * ((index[row] * step) % 1 - 0.5) : column.values[row]);

// The ring around the chosen run; as a shape it moves without a redraw of all runs.
const ring = (data, { run, x, y }) => {
  if (run === null) return [];
  const at = [spread(data.columns[x], [run], data.index, 0.618)[0], spread(data.columns[y], [run], data.index, 0.414)[0]];
  if (!at.every(Number.isFinite)) return [];
  return [{ type: "circle", xsizemode: "pixel", ysizemode: "pixel", xanchor: at[0], yanchor: at[1], x0: -9, x1: 9, y0: -9, y1: 9,
    line: { color: colour("--ink"), width: 2.5 } }];
};
const drawScatter = (place, data, view) => {
  const [x, y] = [data.columns[view.x], data.columns[view.y]];
  const kind = webgl ? "scattergl" : "scatter", dense = data.index.length > 3000;
  const traces = VERDICTS.map((name, verdict) => {
    const rows = view.rows.filter(row => data.verdict[row] === verdict);
    return { type: kind, mode: "markers", name: `${name}: ${rows.length}`, rows, hoverinfo: "none",
      x: spread(x, rows, data.index, 0.618), y: spread(y, rows, data.index, 0.414),
      marker: { color: shades()[verdict], symbol: SHAPES[verdict], size: (dense ? 4 : 7) + (verdict === 1 ? 2 : 0),
        opacity: verdict === 0 && dense ? 0.5 : 0.85, line: { width: dense ? 0 : 0.5, color: colour("--card") } } };
  }).filter(trace => trace.rows.length);
  const frame = look({});
  return Plotly.react(place, traces, look({ height: 460, dragmode: narrow() ? false : "select", hovermode: "closest", uirevision: `${view.x} ${view.y}`, shapes: ring(data, view), showlegend: true,
    legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, margin: { l: 60, r: 14, t: 34, b: 52 },
    xaxis: { ...frame.xaxis, ...axisOf(x) }, yaxis: { ...frame.yaxis, ...axisOf(y) } }), TOOLS);
};

// Parallel coordinates of runs that gave metrics; the metric first, then the inputs by influence. Of very many runs some,
// evenly: first of the critical ones, which lie on top.
const LINES = 3000, CROSSINGS = 24000;  // a browser without a graphics processor draws about 5,000 crossings of lines and axes a second
const thinned = (rows, most) => rows.length <= most ? rows : Array.from({ length: most }, (_, k) => rows[Math.floor(k * rows.length / most)]);
const drawable = data => [...data.index.keys()].filter(row => data.verdict[row] !== 2 && Number.isFinite(data.told.values[row]));
const drawParallel = (place, data, view) => {
  const all = drawable(data);
  const most = Math.min(LINES, Math.floor(CROSSINGS / (data.inputs.length + 1)));
  const critical = thinned(all.filter(row => data.verdict[row] === 1), Math.floor(most / 2));
  const rows = [...thinned(all.filter(row => data.verdict[row] === 0), most - critical.length), ...critical];
  place.dataset.lines = rows.length < all.length ? `Shown are ${rows.length} of ${all.length} runs; ranges filter all.` : "";
  const columns = [data.told, ...data.ranked];
  const dimensions = columns.map(column => {
    const values = rows.map(row => column.log ? Math.log10(column.values[row]) : column.values[row]);
    let low = Infinity, high = -Infinity;
    for (const value of values) { low = Math.min(low, value); high = Math.max(high, value); }
    if (!(high > low)) { low -= 0.5; high += 0.5; }
    const decades = column.log ? Array.from({ length: Math.floor(high) - Math.ceil(low) + 1 }, (_, k) => Math.ceil(low) + k) : [];
    const named = column.log && decades.length > 1 ? { tickvals: decades, ticktext: decades.map(k => `1e${k}`) }
      : column.log ? { tickvals: [low, high], ticktext: [low, high].map(at => digits(10 ** at, 2)) } : column.choices.length ? { tickvals: column.choices.map((_, k) => k), ticktext: column.choices.map(c => shortened(c, 12)) } : {};
    return { label: safe(shortened(titled(column), 18)), values, range: [low, high], constraintrange: brushed(column, view.brushes.get(column.name), Math.log10), ...named };
  });
  const [safeColour, criticalColour] = shades();
  place.style.minWidth = `${96 * columns.length}px`;
  const trace = { type: "parcoords", dimensions, labelangle: columns.length > 9 ? -14 : 0, labelfont: { size: 11, color: colour("--ink") },
    tickfont: { size: 10, color: colour("--ink") }, rangefont: { size: 10, color: colour("--soft") }, unselected: { line: { color: colour("--line"), opacity: 0.25 } },
    line: { color: rows.map(row => data.verdict[row]), cmin: 0, cmax: 1, colorscale: [[0, safeColour], [1, criticalColour]], showscale: false } };
  const drawn = Plotly.newPlot(place, [trace], look({ height: 380, margin: { l: 60, r: 40, t: 64, b: 26 } }), PLAIN);
  place.on("plotly_restyle", () => {
    const brushes = new Map();
    place.data[0].dimensions.forEach((dimension, k) => {
      const range = dimension.constraintrange;
      if (range) brushes.set(columns[k].name, brushed(columns[k], Array.isArray(range[0]) ? range : [range], at => 10 ** at));
    });
    view.brushed(brushes);
  });
  return drawn;
};

const drawInfluence = (place, data, chosen) => {
  const known = data.inputs.some(input => input.influence), none = !known && !data.weights.some(weight => weight > 0);
  place.parentNode.nextElementSibling.hidden = none;
  if (none) { place.textContent = "The runs tell of none yet."; return undefined; }
  const ranked = [...data.ranked].reverse();
  const value = input => known ? input.influence[0] : data.weights[data.inputs.indexOf(input)];
  const errors = known ? { error_x: { type: "data", symmetric: false, color: colour("--ink"), thickness: 1.2, width: 3,
    array: ranked.map(i => Math.max(0, i.influence[2] - i.influence[0])), arrayminus: ranked.map(i => Math.max(0, i.influence[0] - i.influence[1])) } } : {};
  const frame = look({});
  const trace = { type: "bar", orientation: "h", x: ranked.map(value), y: ranked.map((_, k) => k), marker: { color: colour("--model") }, ...errors,
    hovertemplate: "%{x:.3f}<extra></extra>" };
  const title = known ? "total Sobol index" : "relative influence";
  const drawn = Plotly.react(place, [trace], look({ height: 90 + 24 * ranked.length, bargap: 0.35, ...(ranked.length > 8 ? { margin: { l: 56, r: 14, t: 48, b: 10 } } : {}),
    xaxis: { ...frame.xaxis, title: { text: title }, rangemode: "tozero", side: ranked.length > 8 ? "top" : "bottom" },  // of a long list the top is in view
    yaxis: { ...frame.yaxis, tickvals: ranked.map((_, k) => k), ticktext: ranked.map(input => safe(shortened(input.name, 22))) } }), PLAIN);
  if (!place.known) place.on("plotly_click", event => chosen(data.inputs.indexOf(ranked[event.points[0].pointNumber])));
  place.known = true;
  return drawn;
};

// The slice along one input through a run: mean and band of the metric above, P(critical) below.
const drawSlice = (place, data, row, k) => {
  const { slices } = data, at = slices.runs.indexOf(data.index[row]), input = data.inputs[k];
  const [mean, low, high, score] = slices.of[at][k], grid = slices.grid[k], here = input.values[row];
  const discrete = input.whole, fine = discrete ? grid : finer(grid, input.log), mode = discrete ? "markers" : "lines";
  const frame = look({}), model = colour("--model");
  const traces = [
    { x: grid, y: low, mode, line: { width: 0 }, marker: { color: model, size: 4 }, hoverinfo: "skip" },
    { x: grid, y: high, mode, fill: discrete ? undefined : "tonexty", fillcolor: "rgba(91,155,213,.25)", line: { width: 0 }, marker: { color: model, size: 4 }, hoverinfo: "skip" },
    { x: grid, y: mean, mode, line: { color: model, width: 2 }, marker: { color: model, size: 8 }, hoverinfo: "none" },
    { x: [here], y: [data.told.values[row]], mode: "markers", marker: { symbol: SHAPES[data.verdict[row]], size: 10, color: shades()[data.verdict[row]] }, hoverinfo: "none" },
    { x: fine, y: fine.map(x => normal(interpolated(grid, score, x, discrete))), mode, yaxis: "y2", line: { color: colour("--critical"), width: 2 }, marker: { color: colour("--critical"), size: 8 }, hoverinfo: "none" },
  ].map(trace => ({ type: "scatter", ...trace }));
  const shapes = (data.told.critical || []).filter(end => end !== null).map(end => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: end, y1: end,
    line: { color: colour("--critical"), width: 1, dash: "dash" } }));
  const cursor = shapes.length;
  shapes.push({ type: "line", x0: here, x1: here, yref: "paper", y0: 0, y1: 1, line: { color: colour("--ink"), width: 1.2 } });
  const ends = [...low, ...high, data.told.values[row]].filter(Number.isFinite), span = Math.max(...ends) - Math.min(...ends) || 1;
  const layout = look({ height: 330, showlegend: false, shapes, hovermode: "x", margin: { l: 62, r: 14, t: 8, b: 46 },
    xaxis: { ...frame.xaxis, ...axisOf(input), anchor: "y2" },
    yaxis: { ...frame.yaxis, domain: [0.4, 1], range: [Math.min(...ends) - 0.06 * span, Math.max(...ends) + 0.06 * span], title: { text: safe(titled(data.told)) } },
    yaxis2: { ...frame.yaxis, domain: [0, 0.32], range: [-0.04, 1.04], title: { text: "P(critical)" }, nticks: 4 } });
  Plotly.react(place, traces, layout, PLAIN);
  return value => {
    Plotly.relayout(place, { [`shapes[${cursor}].x0`]: value, [`shapes[${cursor}].x1`]: value });
    const [m, l, h, z] = [mean, low, high, score].map(values => interpolated(grid, values, value, discrete));
    return [m, l, h, normal(z)];
  };
};
const finer = (grid, log) => {
  const first = grid[0], last = grid[grid.length - 1];
  return Array.from({ length: 241 }, (_, k) => log ? first * (last / first) ** (k / 240) : first + k / 240 * (last - first));
};
// The distribution function of the normal: Abramowitz and Stegun 26.2.17, off by less than 1e-7.
const normal = z => {
  const t = 1 / (1 + 0.2316419 * Math.abs(z));
  const tail = Math.exp(-z * z / 2) / Math.sqrt(2 * Math.PI)
    * t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))));
  return z < 0 ? tail : 1 - tail;
};
const interpolated = (grid, values, x, discrete) => {
  if (grid.length === 1) return values[0];
  let k = 0;
  while (k < grid.length - 2 && grid[k + 1] < x) k++;
  const share = Math.max(0, Math.min(1, (x - grid[k]) / (grid[k + 1] - grid[k])));
  return discrete ? values[share > 0.5 ? k + 1 : k] : values[k] + share * (values[k + 1] - values[k]);
};
