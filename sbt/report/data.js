// The data of the page and small helpers; every text that came from a campaign is written as text, never as markup.
const bytesOf = text => {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);
  return bytes;
};
const floats = text => new Float32Array(bytesOf(text).buffer);
const wholes = text => new Int32Array(bytesOf(text).buffer);
const unpacked = async id => {
  const packed = document.getElementById(id).textContent.trim();
  const stream = new Blob([bytesOf(packed)]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
};
// Calls once something is painted, or after 2 s: a window that nobody sees paints nothing.
const afterPaint = then => {
  let begun = false;
  const once = () => { if (!begun) { begun = true; then(); } };
  if (window.PerformanceObserver) new PerformanceObserver(once).observe({ type: "paint", buffered: true });
  setTimeout(once, 2000);
};
// The library is large: it is unpacked after the page is painted.
const withLibrary = async then => {
  const script = document.createElement("script");
  script.textContent = await unpacked("library");
  document.head.append(script);
  await then();
};
const summed = series => { let last = 0; return series.map(d => d === null ? NaN : (last += d)); };

// An element with attributes (on...: a listener) and children; strings become text.
const make = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (value !== undefined && value !== false) node.setAttribute(key, value);
  }
  node.append(...children);
  return node;
};
const painted = new Map();
const colour = name => {
  if (!painted.has(name)) painted.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return painted.get(name);
};
const shortened = (text, most = 36) => text.length > most ? text.slice(0, most - 1) + "\u2026" : text;
const digits = (value, n = 4) => {
  if (value === null || value === undefined || Number.isNaN(value)) return "\u2013";
  if (!Number.isFinite(value)) return value > 0 ? "\u221e" : "\u2212\u221e";
  const size = Math.abs(value);
  const text = size !== 0 && (size < 1e-4 || size >= 1e7) ? Number(value.toPrecision(n)).toExponential() : String(Number(value.toPrecision(n)));
  return text.replace("-", "\u2212");
};
const withUnit = (text, unit) => unit ? `${text} ${unit.replace("^2", "\u00b2").replace("^3", "\u00b3")}` : text;
const titled = column => withUnit(column.name, column.unit ? `(${column.unit})` : "");
const percent = p => p < 1e-6 ? "below 0.0001 %" : p > 1 - 1e-6 ? "above 99.9999 %" : `${digits(100 * p, 3)} %`;
const VERDICTS = ["not critical", "critical", "failed"];

// Data as the page uses them: columns (inputs, then metrics) with values a row, verdicts, films by run.
const opened = raw => {
  const inputs = raw.inputs.map((column, k) => ({ ...column, input: true, values: column.origin ? Float64Array.from(floats(raw.x[k]), v => v + column.origin) : floats(raw.x[k]) }));
  const metrics = raw.metrics.map((column, k) => ({ ...column, choices: [], values: floats(raw.y[k]) }));
  const index = wholes(raw.index);
  const rowOf = new Map();
  index.forEach((run, row) => rowOf.set(run, row));
  const columns = [...inputs, ...metrics];
  const told = metrics.find(m => m.name === raw.told) || { name: "margin", unit: "", choices: [], values: floats(raw.margin) };
  return { ...raw, inputs, metrics, columns, told, index, rowOf, margin: floats(raw.margin), rank: wholes(raw.rank), iteration: wholes(raw.iteration),
    filmOf: new Map(raw.films.map(film => [film.run, film])), ranked: raw.order.map(k => inputs[k]) };
};
const valueText = (column, row) => {
  const value = column.values[row];
  return column.choices.length ? column.choices[Math.round(value)] ?? "\u2013" : digits(value, column.digits || 5);
};
