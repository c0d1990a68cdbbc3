// Tries the explorer as a person would, and writes what it saw into the page (tests/test_explorer.py).
const told = { errors: [] };
addEventListener("error", event => told.errors.push(event.message));
addEventListener("unhandledrejection", event => told.errors.push(String(event.reason)));
const before = console.error; console.error = (...said) => { told.errors.push(said.join(" ")); before(...said); };
const wait = async what => { for (let k = 0; k < 400; k++) { if (what()) return; await new Promise(r => setTimeout(r, 25)); } throw new Error(`in vain: ${what}`); };
const part = name => document.querySelector(`[data-part=${name}]`);
const picture = () => part("film").querySelector("canvas").toDataURL();
(async () => {
  try {
    await wait(() => window.explorer && window.Plotly && part("scatter").querySelector(".main-svg"));
    window.explorer.parallelNow();  // nothing scrolls into view without a screen
    await wait(() => part("parallel").querySelector(".parcoords"));
    const { explorer } = window, scatter = part("scatter");
    const trace = scatter.data.find(each => each.name.startsWith("critical")), at = trace.rows.findIndex(row => explorer.data.filmOf.has(explorer.data.index[row]));
    scatter.emit("plotly_hover", { points: [{ data: trace, pointNumber: at }], event: { clientX: 0, clientY: 0 } });
    told.tip = part("tip").textContent;
    part("table").querySelector("tbody tr:last-child button").click();
    told.other = part("run-title").textContent;
    const start = performance.now();
    scatter.emit("plotly_click", { points: [{ data: trace, pointNumber: at }] });
    told.seconds = (performance.now() - start) / 1000;
    told.run = explorer.data.index[trace.rows[at]];
    told.title = part("run-title").textContent;
    await wait(() => part("facts").querySelector("pre")?.textContent.includes(` ${told.run} `));
    told.command = part("facts").querySelector("pre").textContent;
    const slider = part("film").querySelector("input[type=range]");
    await wait(() => part("curves").querySelector(".main-svg"));
    const pictures = [picture()];
    slider.value = 1; slider.dispatchEvent(new Event("input")); pictures.push(picture());
    part("film").querySelector("canvas").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" })); pictures.push(picture());
    told.moves = new Set(pictures).size;
    told.all = explorer.table.rows.length;
    await Plotly.restyle(part("parallel"), { "dimensions[0].constraintrange": [[-9, 0.5]] });
    await wait(() => explorer.table.rows.length < told.all);
    told.brushed = explorer.table.rows.length;
    part("clear").click();
    told.cleared = explorer.table.rows.length;
    const filter = part("table").querySelectorAll(".conditions input")[2];
    filter.value = "<0.5"; filter.dispatchEvent(new Event("input"));
    told.filtered = explorer.table.rows.length;
    told.width = document.documentElement.scrollWidth;
    part("slice-at").value = 2; part("slice-at").dispatchEvent(new Event("input"));
    told.slice = part("slice-says").textContent;
    told.markup = document.querySelectorAll("#explore b").length;
    told.loaded = performance.getEntriesByType("resource").length;
    told.shares = [...document.querySelectorAll(".js-plotly-plot")].filter(plot => plot._context.showSendToCloud || plot._context.plotlyServerURL).length;
    await new Promise(r => setTimeout(r, 200));
  } catch (error) { told.errors.push(String(error)); }
  const answer = document.createElement("pre"); answer.id = "answer"; answer.textContent = btoa(encodeURIComponent(JSON.stringify(told))); document.body.append(answer);
})();
