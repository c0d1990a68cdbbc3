// The table of runs: sorted by a click on a head, filtered by a line of conditions under it, a page of rows at a time.
const PAGE = 50;
const CONDITION = "such as <2, >0.5, 1..3 or a part of a word";

// A condition on a number or a text; null where it is empty, undefined where it cannot be read.
const condition = text => {
  const given = text.trim().replace(/\u2212/g, "-");
  if (!given) return null;
  const range = given.match(/^(-?[\d.eE+-]+)\s*\.\.\s*(-?[\d.eE+-]+)$/), one = given.match(/^(<=?|>=?|=)\s*(-?[\d.eE+-]+)$/);
  if (range) return value => value >= Number(range[1]) && value <= Number(range[2]);
  if (one) {
    const limit = Number(one[2]);
    return { "<": v => v < limit, "<=": v => v <= limit, ">": v => v > limit, ">=": v => v >= limit, "=": v => v === limit }[one[1]];
  }
  return /^[<>=]/.test(given) ? undefined : (_, text) => text.toLowerCase().includes(given.toLowerCase());
};

class RunTable {
  constructor(data, chosen, changed) {
    this.data = data;
    this.chosen = chosen;
    this.changed = changed;
    const plain = (name, values, text) => ({ name, unit: "", values, text });
    this.columns = [
      plain("run", data.index, row => String(data.index[row])),
      plain("verdict", data.verdict, row => VERDICTS[data.verdict[row]]),
      ...[...data.metrics, ...data.ranked].map(column => ({ ...column, text: row => valueText(column, row) })),
      plain("stage", data.stage, row => data.stages[data.stage[row]]),
    ];
    this.filters = new Map();
    this.order = { column: null, down: false };
    this.first = 0;
    this.head = make("tr", {}, ...this.columns.map((column, k) => this.heading(column, k)));
    this.inputs = make("tr", { class: "conditions" }, ...this.columns.map((column, k) => make("td", {}, this.filter(column, k))));
    this.body = make("tbody");
    this.says = make("p", { class: "note", role: "status" });
    this.table = make("table", { class: "runs" }, make("caption", { class: "unseen" }, "All runs"), make("thead", {}, this.head, this.inputs), this.body);
    this.before = make("button", { type: "button", onclick: () => this.turn(-PAGE) }, "Previous");
    this.after = make("button", { type: "button", onclick: () => this.turn(PAGE) }, "Next");
    this.node = make("div", {}, this.says, make("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "table of runs" }, this.table),
      make("div", { class: "film-bar" }, this.before, this.after));
  }
  heading(column, k) {
    const button = make("button", { type: "button", onclick: () => this.sort(k), title: [column.name, column.description].filter(Boolean).join(": ") }, shortened(titled(column), 28));
    return make("th", { scope: "col" }, button);
  }
  filter(column, k) {
    return make("input", { type: "text", size: "5", "aria-label": `condition on ${column.name}, ${CONDITION}`, title: CONDITION,
      oninput: event => {
        const found = condition(event.target.value);
        event.target.setAttribute("aria-invalid", String(found === undefined));
        if (found) this.filters.set(k, found); else this.filters.delete(k);
        this.changed();
      } });
  }
  clear() {
    this.filters.clear();
    for (const input of this.inputs.querySelectorAll("input")) { input.value = ""; input.removeAttribute("aria-invalid"); }
  }
  passes(row) {
    for (const [k, holds] of this.filters) if (!holds(this.columns[k].values[row], this.columns[k].text(row))) return false;
    return true;
  }
  sort(k) {
    this.order = { column: k, down: this.order.column === k && !this.order.down };
    [...this.head.cells].forEach((cell, j) => {
      if (j === k) cell.setAttribute("aria-sort", this.order.down ? "descending" : "ascending"); else cell.removeAttribute("aria-sort");
    });
    this.show(this.rows);
  }
  show(rows) {
    const { column, down } = this.order;
    const values = column === null ? this.data.rank : this.columns[column].values;
    const sign = down ? -1 : 1, key = row => Number.isNaN(values[row]) ? Infinity : values[row];
    this.rows = rows;
    this.sorted = [...rows].sort((a, b) => {  // what has no value comes last, in either direction
      const [x, y] = [key(a), key(b)];
      return x === y ? a - b : x === Infinity || y === Infinity ? x - y || a - b : sign * (x - y);
    });
    this.first = 0;
    this.page();
  }
  turn(by) { this.first = Math.max(0, this.first + by); this.page(); }
  page() {
    const { data, sorted, first } = this, shown = sorted.slice(first, first + PAGE);
    this.body.replaceChildren(...shown.map(row => make("tr", { class: row === this.current ? "chosen" : undefined },
      ...this.columns.map((column, k) => k === 0 ? make("td", {}, this.opener(row)) : make("td", {}, column.text(row))))));
    const total = data.total > data.index.length ? ` (of ${data.total} in the store)` : "";
    const count = verdict => sorted.filter(row => data.verdict[row] === verdict).length, failed = count(2);
    const ordered = this.order.column === null && failed < sorted.length ? ", most critical first" : "";
    this.says.textContent = `${sorted.length} of ${data.index.length} runs${total}, ${count(1)} critical${failed ? `, ${failed} failed` : ""}.`
      + (sorted.length ? ` Rows ${first + 1} to ${first + shown.length}${ordered}.` : "");
    this.before.disabled = first === 0;
    this.after.disabled = first + PAGE >= sorted.length;
  }
  opener(row) {
    const run = this.data.index[row], film = this.data.filmOf.has(run);
    return make("button", { type: "button", class: "open", "aria-label": `open run ${run}${film ? ", with a film" : ""}`, onclick: () => this.chosen(row) },
      String(run), film ? " \u25b6" : "");
  }
  mark(row) {
    this.current = row;
    const at = this.sorted.slice(this.first, this.first + PAGE).indexOf(row);
    [...this.body.rows].forEach((line, k) => { line.classList.toggle("chosen", k === at); });
  }
}
