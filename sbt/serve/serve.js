// The live view: states come from the server every few seconds, runs when one asks for them.
const KEY = location.pathname.split("/")[2];
const at = id => document.getElementById(id);
const element = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
};
const whole = n => n === null || n === undefined ? "–" : n.toLocaleString("en");
const duration = s => s === null || s === undefined ? "–" : s < 90 ? `${Math.round(s)} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;
const pace = rate => rate ? (rate < 10 ? rate.toPrecision(2) : Math.round(rate).toLocaleString("en")) : "–";
const runsOf = ({ done, budget }) => budget > done ? `${whole(done)} of ${whole(budget)}` : whole(done);
const failedOf = runs => ["failed", "timeout", "crashed", "invalid"].reduce((n, status) => n + (runs[status] || 0), 0);
const asked = async (path, options = {}) => {
  const response = await fetch(path, { ...options, headers: { "x-sbt": "1" } });
  const found = await response.json();
  if (!response.ok) throw new Error(found.error);
  return found;
};

// Asks again and again, less often while nobody looks; says when the server is gone.
const watch = async (path, show) => {
  for (;;) {
    try { await show(await asked(path)); } catch (error) {
      const place = at("says") || at("numbers");
      place.textContent = error instanceof TypeError ? "The server does not answer: it was ended, or restarted with another address." : error.message;
    }
    await new Promise(then => setTimeout(then, document.hidden ? 15000 : 2000));
  }
};

const showList = campaigns => {
  at("says").textContent = campaigns.length ? campaigns.length > 1 ? `${campaigns.length} campaigns, running ones first.` : "1 campaign." : "There are no campaigns in these folders yet; they appear here by themselves.";
  at("campaigns").replaceChildren(...campaigns.map(campaign => element("tr", {},
    element("td", {}, element("a", { href: `/c/${campaign.key}` }, campaign.name), ...(campaign.campaign ? [element("div", { class: "note" }, `${campaign.campaign} of ${campaign.scenario}`)] : [])),
    element("td", { "data-state": campaign.state }, campaign.state, ...(campaign.error ? [element("div", { class: "note" }, campaign.error)] : [])),
    element("td", { class: "n" }, runsOf(campaign)),
    element("td", { class: "n" }, whole(campaign.critical)),
    element("td", { class: "n" }, whole(failedOf(campaign.runs))),
    element("td", { class: "n" }, campaign.state === "running" ? pace(campaign.rate) : "–"),
    element("td", {}, campaign.state === "running" ? duration(campaign.remaining) : "–"),
    element("td", {}, new Date(1000 * campaign.changed).toLocaleString()))));
};

const blank = at("explore") && at("explore").cloneNode(true);
let shown = -1, loading = false;
// The library is fetched with the page, and executed once runs are painted.
const draws = () => {
  const given = document.querySelector("link[rel=preload]");
  if (!given) return;
  document.head.append(element("script", { src: given.href }));
  document.head.lastChild.addEventListener("load", () => { if (window.explorer) window.explorer.draw(); });
  given.remove();
};
const showStatus = async status => {
  const running = status.state === "running", failed = failedOf(status.runs);
  at("name").textContent = document.title = status.name;
  at("progress").max = Math.max(status.budget || status.done, 1);
  at("progress").value = Math.min(status.done, at("progress").max);
  const parts = [`${status.state}: ${runsOf(status)} runs`];
  if (status.critical) parts.push(`${whole(status.critical)} critical`);
  if (failed) parts.push(`${whole(failed)} failed`);
  if (running) parts.push(`${pace(status.rate)} a second`, `${duration(status.remaining)} to go`);
  at("numbers").textContent = status.error || parts.join(", ");
  at("doing").textContent = [status.campaign ? `${status.campaign} of ${status.scenario}` : "", status.stage ? `stage ${status.stage}, batch ${status.iterations}` : ""].filter(Boolean).join("; ");
  at("stop").hidden = !running;
  at("resume").hidden = running || status.state === "elsewhere" || status.state === "damaged" || (status.state === "finished" && status.done >= status.budget);
  at("report").hidden = !status.report;
  at("report").href = `/c/${KEY}/report`;
  const more = status.done - shown;
  at("newer").hidden = shown <= 0 || more <= 0;
  at("newer").textContent = `Show ${whole(more)} more runs`;
  if (shown < 0 && status.done && !status.error) load(status.done).catch(error => { at("said").textContent = error.message; });
};
const LARGE = 4000;  // of more runs some are shown first, evenly spaced
const show = async data => {
  const before = window.explorer && window.explorer.view, run = before && before.run !== null ? window.explorer.data.index[before.run] : null;
  const films = window.explorer ? window.explorer.data.filmOf : new Map(), lanes = window.explorer ? window.explorer.data.lanes : [];
  at("sentences").replaceChildren(...data.sentences.map(sentence => element("p", {}, sentence)));
  at("explore").replaceWith(blank.cloneNode(true));
  const fresh = opened(data);
  if (films.size) { fresh.filmOf = films; fresh.lanes = lanes; }  // those that were made on demand
  await explore(fresh, before && { x: before.x, y: before.y, run });
  requestAnimationFrame(() => setTimeout(draws));
  at("explore").querySelector("[data-part=films]").previousElementSibling.hidden = !data.films.length;
};
const load = async done => {
  if (loading) return;
  loading = true;
  at("newer").disabled = true;
  try {
    if (done > LARGE && shown < 0) {
      await show(await asked(`/api/${KEY}/explorer?first=1`));
      at("said").textContent = `These are ${whole(window.explorer.data.index.length)} of ${whole(done)} runs, evenly spaced; the others are being read.`;
      shown = 0;
      for (let k = 0; k < 50 && !window.explorer.listening; k++) await new Promise(then => setTimeout(then, 100));  // drawn first
    }
    await show(await asked(`/api/${KEY}/explorer`));
    at("said").textContent = "";
    shown = done;
  } finally {
    loading = false;
    at("newer").disabled = false;
  }
};

// A run without a film gets a button that has it executed again.
if (typeof Explorer !== "undefined") {
  const filmOfPage = Explorer.prototype.film;
  Explorer.prototype.film = function (row) {
    filmOfPage.call(this, row);
    const run = this.data.index[row];
    if (this.data.filmOf.has(run) || this.data.verdict[row] === 2 || !this.data.traced) return;
    const button = make("button", { type: "button", onclick: async () => {
      button.disabled = true;
      button.textContent = "Executing the run again …";
      const { film, lanes, note } = await asked(`/api/${KEY}/film/${run}`).catch(error => ({ film: null, note: error.message }));
      if (!film) { button.replaceWith(make("p", { class: "note" }, note)); return; }
      film.lanes = film.lanes.map(lane => lane + this.data.lanes.length);
      this.data.lanes.push(...lanes);
      this.laid = null;
      this.data.filmOf.set(run, film);
      if (this.view.run === row) { this.film(row); this.curves(); }
    } }, "Show the film of this run");
    this.part("film").replaceChildren(button);
  };
  // A process takes some seconds to begin or to end: until then the button stays as it was pressed.
  const act = verb => async () => {
    at(verb).disabled = true;
    setTimeout(() => { at(verb).disabled = false; }, 15000);
    at("said").textContent = (await asked(`/api/${KEY}/${verb}`, { method: "POST" }).catch(error => ({ said: error.message }))).said;
  };
  at("stop").addEventListener("click", act("stop"));
  at("resume").addEventListener("click", act("resume"));
  at("newer").addEventListener("click", async () => { const status = await asked(`/api/${KEY}/status`); await load(status.done); at("newer").hidden = true; });
}
