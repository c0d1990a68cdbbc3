// The explorer: one chosen run, one set of filters; scatter, parallel coordinates, slices, table and film follow them.
const within = (ranges, value) => ranges.some(([low, high]) => value >= low && value <= high);
// Does work in pieces, between which a click is answered; ends early where `wanted` says no longer.
const inPieces = async (pieces, wanted = () => true) => {
  for (const piece of pieces) {
    await new Promise(then => setTimeout(then));
    if (!wanted()) return;
    await piece();
  }
};

class Explorer {
  constructor(place, data, kept) {
    this.place = place;
    this.data = data;
    this.part = name => place.querySelector(`[data-part=${name}]`);
    const [first, second] = data.ranked.map(input => data.columns.indexOf(input));
    this.view = { x: first, y: second ?? Math.max(data.columns.indexOf(data.told), 0), run: null, brushes: new Map(), picked: null, rows: [...data.index.keys()] };
    if (kept) Object.assign(this.view, { x: kept.x, y: kept.y });
    this.view.brushed = brushes => { this.view.brushes = brushes; this.filter(); };
    this.table = new RunTable(data, row => this.choose(row, true), () => this.filter());
    this.part("table").append(this.table.node);
    this.table.show(this.view.rows);
    this.axes();
    this.filmList();
    this.part("clear").addEventListener("click", () => this.clear());
    this.choose(kept && data.rowOf.has(kept.run) ? data.rowOf.get(kept.run) : this.best(), false);
  }
  best() {
    const film = this.data.films[0];
    if (film) return this.data.rowOf.get(film.run);
    return this.table.sorted[0] ?? null;
  }
  axes() {
    for (const axis of ["x", "y"]) {
      const select = this.part(axis);
      select.append(...this.data.columns.map((column, k) => make("option", { value: k }, shortened(titled(column), 50))));
      select.value = this.view[axis];
      select.addEventListener("change", () => { this.view[axis] = Number(select.value); this.view.picked = null; this.draw(); });
    }
  }
  filmList() {
    const { films, film_note: note, films_left_out: rest } = this.data;
    this.part("films").previousElementSibling.hidden = !films.length && !note;
    this.part("films").append(...films.map(film => make("button", { type: "button", class: "chip", onclick: () => this.choose(this.data.rowOf.get(film.run), true) },
      `${film.role}: run ${film.run}`)));
    this.part("film-note").textContent = [note, rest ? `${rest} more would not fit in.` : ""].join(" ").trim();
  }
  // Draws all figures; called once the library is there, and again when the colours change.
  async draw() {
    if (!window.Plotly) return;
    const { data, view } = this, scatter = this.part("scatter");
    await drawScatter(scatter, data, view);
    if (!this.listening) this.listen(scatter);
    this.listening = true;
    await inPieces([
      () => drawInfluence(this.part("influence"), data, k => { this.part("x").value = k; view.x = k; this.draw(); }),
      () => {
        if (!webgl) this.part("parallel").textContent = "Parallel coordinates need WebGL, which this browser does not offer.";
        else if (!this.parallel) this.parallelLater();
      },
      () => this.slice(), () => this.curves(),
    ]);
  }
  // Parallel coordinates are drawn when they come into view: they take longest.
  parallelLater() {
    const place = this.part("parallel");
    this.parallel = true;
    if (this.watch) this.watch.disconnect();
    this.watch = null;
    const none = !drawable(this.data).length;
    if (none || place.dataset.none) place.textContent = none ? "No run gave a number to draw." : "";
    place.dataset.none = none ? "none" : "";
    if (none) return;
    this.watch = new IntersectionObserver(seen => { if (seen.some(each => each.isIntersecting)) this.parallelNow(); }, { rootMargin: "300px" });
    this.watch.observe(place);
  }
  parallelNow() {
    const place = this.part("parallel");
    if (!this.watch) return;
    this.watch.disconnect();
    this.watch = null;
    drawParallel(place, this.data, this.view);
    this.part("parallel-note").textContent = place.dataset.lines;
  }
  listen(scatter) {
    const tip = this.part("tip");
    scatter.on("plotly_hover", event => this.tip(tip, this.rowAt(event.points[0]), event.event));
    scatter.on("plotly_unhover", () => { tip.hidden = true; });
    scatter.on("plotly_click", event => this.choose(this.rowAt(event.points[0]), true));
    const pick = picked => { if (picked || this.view.picked) { this.view.picked = picked; this.filter(false); } };  // every click on a point deselects
    scatter.on("plotly_selected", event => pick(event && event.points.length ? new Set(event.points.map(point => this.rowAt(point))) : null));
    scatter.on("plotly_deselect", () => pick(null));
  }
  rowAt(point) { return point.data.rows[point.pointNumber]; }
  tip(tip, row, event) {
    const { data } = this, columns = [...data.metrics.slice(0, 6), ...data.ranked.slice(0, 12)];
    tip.replaceChildren(make("b", {}, `run ${data.index[row]}, ${VERDICTS[data.verdict[row]]}`),
      ...columns.map(column => make("div", {}, `${shortened(column.name, 28)}: ${withUnit(valueText(column, row), column.unit)}`)));
    tip.hidden = false;
    const left = event.clientX + 14;  // in the window: where the page lies is not asked, which would lay it out
    tip.style.left = `${left + 260 > window.innerWidth ? Math.max(0, left - 290) : left}px`;
    tip.style.top = `${event.clientY + 10}px`;
  }
  filter(redraw = true) {
    const { data, view, table } = this;
    const brushes = [...view.brushes].map(([name, ranges]) => [[data.told, ...data.columns].find(column => column.name === name), ranges]);
    const passing = [...data.index.keys()].filter(row => table.passes(row) && brushes.every(([column, ranges]) => within(ranges, column.values[row])));
    view.rows = passing;
    table.show(view.picked ? passing.filter(row => view.picked.has(row)) : passing);
    this.part("clear").hidden = passing.length === data.index.length && !view.picked;
    if (redraw && window.Plotly) drawScatter(this.part("scatter"), data, view);
  }
  clear() {
    this.view.brushes = new Map();
    this.view.picked = null;
    this.parallel = false;
    this.table.clear();
    this.filter();
    this.draw();
  }
  // The film is seen first; whatever takes longer follows when it is painted.
  choose(row, reveal) {
    if (row === null || row === undefined) return;
    this.view.run = row;
    this.title(row);
    this.film(row);
    const reduced = matchMedia("(prefers-reduced-motion: reduce)").matches;
    requestAnimationFrame(() => setTimeout(() => inPieces([
      () => { this.table.mark(row); this.facts(row); },
      () => { if (reveal) this.part("run").scrollIntoView({ block: "nearest", behavior: reduced ? "auto" : "smooth" }); },
      () => { if (this.listening) Plotly.relayout(this.part("scatter"), { shapes: ring(this.data, this.view) }); },
      () => { if (window.Plotly) this.slice(); },
      () => { if (window.Plotly) this.curves(); },
    ], () => this.view.run === row), 100));
  }
  title(row) {
    this.part("run-title").textContent = `Run ${this.data.index[row]}: ${VERDICTS[this.data.verdict[row]]}`;
    this.part("run-title").dataset.verdict = this.data.verdict[row];
  }
  facts(row) {
    const { data } = this, run = data.index[row];
    const line = column => make("tr", {}, make("th", { scope: "row", title: column.description || column.name }, column.name), make("td", {}, withUnit(valueText(column, row), column.unit)));
    const group = (name, columns) => columns.length ? [make("tr", {}, make("th", { colspan: "2", class: "group" }, name)), ...columns.map(line)] : [];
    const reason = data.reason[row] ? [make("p", { class: "note" }, `Failed: ${data.reason[row]}`)] : [];
    const modes = data.modes.map((mode, k) => mode.runs.includes(run) ? `failure mode ${k + 1}` : "").filter(Boolean);
    const about = [`stage ${data.stages[data.stage[row]]}`, `iteration ${data.iteration[row]}`, `seed ${data.seed[row]}`, ...modes].join(", ");
    this.part("facts").replaceChildren(...reason,
      make("table", { class: "facts-of-run" }, make("tbody", {}, ...group("Metrics", data.metrics), ...group("Inputs", data.inputs))),
      make("p", { class: "note" }, about), ...this.command(row));
  }
  command(row) {
    const { data } = this, { film, replay } = data.commands, command = data.verdict[row] === 2 || !data.traced ? replay : film;
    return command ? [make("pre", { tabindex: "0", "aria-label": "command that opens this run" }, command.replaceAll(/(?<=[ (])RUN(?=$|\)$| --gif RUN\.gif$|\.gif$)/g, String(data.index[row])))] : [];
  }
  film(row) {
    const { data } = this, place = this.part("film"), run = data.index[row], raw = data.filmOf.get(run);
    if (this.player) this.player.pause();
    this.shown = this.moved = null;
    if (!raw) {
      this.part("curves").replaceChildren();
      place.replaceChildren(make("p", { class: "note" }, data.verdict[row] === 2 ? "A failed run has no film."
        : data.films.length ? "This run's film is not in this file; the command makes it." : data.film_note
        || (data.traced ? "There are no films in this file." : "The scenario gives its metrics directly: there is no trace to show.")));
      return;
    }
    this.shown = developed(raw);
    this.laid = this.laid || data.lanes.map(outlined);
    const label = `run ${run} from above: ${raw.role}; ${raw.contacts.length ? `contact with ${raw.contacts[0].with}` : "no contact"}`;
    const rest = raw.left_out ? ` ${raw.left_out} road users far away are left out.` : "", role = `${raw.role}; ${raw.ended ? `ended: ${raw.ended}` : ""}`;
    this.player = this.player || new Player(1, t => { if (this.moved) this.moved(t); });
    this.player.load([this.shown], this.laid, [label]);
    if (this.screen && this.screen.isConnected) {
      this.screen.firstChild.textContent = role;
      this.screen.lastChild.textContent = legend([raw]) + rest;
    } else {
      this.screen = make("div", {}, make("p", { class: "role" }, role), this.player.scenes[0].canvas, this.player.bar, make("p", { class: "note" }, legend([raw]) + rest));
      place.replaceChildren(this.screen);
    }
    this.player.begin();
  }
  async curves() {
    if (!this.shown) return;
    const film = this.shown, place = make("div");
    this.part("curves").replaceChildren(place);
    const moved = await drawCurves(Plotly, place, film, look);
    if (film !== this.shown) return;
    this.moved = moved;
    moved(this.player.now);
  }
  // The chosen run, or the nearest one whose slices are in the file.
  nearestSlice() {
    const { data, view } = this, rows = data.slices.runs.map(run => data.rowOf.get(run)).filter(row => row !== undefined);
    const away = row => data.inputs.reduce((sum, { values, low, high }) => {
      const span = high - low;
      return sum + (span > 0 ? ((values[row] - values[view.run]) / span) ** 2 : 0);
    }, 0);
    return rows.reduce((best, row) => away(row) < away(best) ? row : best, rows[0]);
  }
  slice() {
    const { data, view } = this, place = this.part("slices");
    if (!data.slices || !data.slices.runs.length || view.run === null) return;
    place.hidden = false;
    const select = this.part("slice-input"), slider = this.part("slice-at"), says = this.part("slice-says");
    if (!select.length) {
      select.append(...data.ranked.map(input => make("option", { value: data.inputs.indexOf(input) }, shortened(titled(input), 50))));
      select.addEventListener("change", () => this.slice());
    }
    const row = this.nearestSlice(), run = data.index[row];
    this.part("slice-title").textContent = row === view.run ? "The metamodel through this run" : `The metamodel through run ${run}, the nearest of ${data.slices.runs.length} runs with slices in this file`;
    const k = Number(select.value), input = data.inputs[k], grid = data.slices.grid[k], { error_p: p, error_mean: mean } = data.slices;
    const off = p < 0.001 ? "by less than 0.001" : p < 0.05 ? `by up to ${digits(p, 1)}`
      : input.log ? `at its edges, which may lie up to ${digits(100 * ((grid[grid.length - 1] / grid[0]) ** (1 / Math.max(grid.length - 1, 1)) - 1), 1)} % beside`
      : `at its edges, which may lie up to ${withUnit(digits((grid[grid.length - 1] - grid[0]) / Math.max(grid.length - 1, 1), 1), input.unit)} beside`;
    this.part("slice-note").textContent = input.whole ? "" : `Both are interpolated: the metric is off by up to ${withUnit(digits(mean, 2), data.told.unit)}, P(critical) ${off}.`;
    const move = drawSlice(this.part("slice"), data, row, k);
    const place_of = input.log ? Math.log10 : value => value, value_at = input.log ? at => 10 ** at : at => at;
    Object.assign(slider, { min: place_of(grid[0]), max: place_of(grid[grid.length - 1]), step: input.whole ? 1 : "any" });
    const tell = value => {
      const [mean, low, high, p] = move(value);
      const written = input.choices.length ? input.choices[Math.round(value)] : withUnit(digits(value, Math.max(input.digits - 1, 4)), input.unit);
      says.textContent = `${input.name} = ${written}, else as run ${run}: ${data.told.name} ${digits(mean, 3)} `
        + `(90 % between ${digits(low, 3)} and ${withUnit(digits(high, 3), data.told.unit)}), P(critical) ${percent(p)}`;
    };
    slider.value = place_of(input.values[row]);
    slider.oninput = () => tell(value_at(Number(slider.value)));
    tell(value_at(Number(slider.value)));
  }
}

// Shows the explorer; `kept`: axes and run of one that it takes the place of.
const explore = async (data, kept = null) => {
  const place = document.getElementById("explore");
  place.hidden = !data.index.length;
  if (place.hidden) return;
  const explorer = new Explorer(place, data, kept);
  window.explorer = explorer;
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", () => { painted.clear(); explorer.parallel = false; explorer.draw(); if (explorer.shown) explorer.player.show(explorer.player.now); });
  let width = 0;
  new ResizeObserver(() => {
    if (place.clientWidth !== width && explorer.shown) explorer.player.show(explorer.player.now);
    width = place.clientWidth;
  }).observe(place);
  const library = document.getElementById("library");  // the live view brings its own
  if (window.Plotly) requestAnimationFrame(() => setTimeout(() => explorer.draw()));  // the run and the table are painted first
  else if (library && library.textContent.trim()) setTimeout(() => withLibrary(() => explorer.draw()), 30);
};
const begin = async () => {
  if (!document.getElementById("explorer-data") || !window.DecompressionStream) return;
  await explore(opened(JSON.parse(await unpacked("explorer-data"))));
};
afterPaint(begin);
