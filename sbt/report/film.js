// Films: one or several runs of the same draw from above, in step, with their curves over time.
const ACTORS = { ego: "#1f6fb4", other: "#d9822b", standing: "#8a8f94", person: "#8e63c0", bicycle: "#2f8d57" };
const FEW = 6;  // so many road users are named; of more only ego and its opponent
const AHEAD = 3;  // seconds of the way that is drawn before the ego and its opponent

const legend = films => ["Dashed: the way driven in the next 3 s; dotted: where they would be after 1, 2 and 3 s with the same speed and heading.",
  ...(films.some(film => film.view) ? ["Yellow: what ego's sensor can see."] : []), "Space plays, arrow keys step."].join(" ");
const developed = film => {
  const states = s => ({ length: s.length, width: s.width, x: summed(s.x).map(v => v / 100), y: summed(s.y).map(v => v / 100),
    h: summed(s.h).map(v => v / 1000) });
  return { ...film, time: summed(film.time).map(v => v / 1000), middle: film.middle.map(m => summed(m).map(v => v / 100)),
    actors: film.actors.map(a => ({ ...a, ...states(a), v: summed(a.v).map(v => v / 100), parts: a.parts.map(states) })) };
};
const outlined = lane => ({ ...lane, x: summed(lane.x).map(v => v / 100), y: summed(lane.y).map(v => v / 100) });

// The instant before t, and the share of the way to the next one.
const placed = (time, t) => {
  let low = 0, high = time.length - 1;
  if (t >= time[high]) return [high, 0];
  while (high - low > 1) { const mid = (low + high) >> 1; if (time[mid] <= t) low = mid; else high = mid; }
  return [low, Math.max(0, Math.min(1, (t - time[low]) / ((time[high] - time[low]) || 1)))];
};
const between = (values, [k, share]) => {
  const next = values[k + 1];
  return share === 0 || next === undefined || Number.isNaN(next) ? values[k] : values[k] + share * (next - values[k]);
};

// One film on a canvas, which goes from film to film: a new one would cost the browser more than all that is drawn.
class Scene {
  constructor() { this.canvas = make("canvas", { role: "img", tabindex: "0" }); }
  load(film, lanes, label) {
    this.film = film;
    this.lanes = lanes;
    this.canvas.setAttribute("aria-label", label);
    this.canvas.style.aspectRatio = String(film.ratio);
  }
  draw(t) {
    const { canvas, film } = this, sharp = Math.min(window.devicePixelRatio || 1, 2);
    const w = Math.round(canvas.clientWidth * sharp), h = Math.round(w / film.ratio);
    if (!w) return;
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const c = canvas.getContext("2d"), at = placed(film.time, t), scale = w / (2 * film.half[0]);
    const mx = between(film.middle[0], at), my = between(film.middle[1], at);
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colour("--ground");
    c.fillRect(0, 0, w, h);
    c.setTransform(scale, 0, 0, -scale, w / 2 - scale * mx, h / 2 + scale * my);
    this.roads(c, scale);
    const order = film.actors.map((_, j) => j).sort((a, b) => this.rank(a) - this.rank(b));
    drawArea(c, film, at, scale);
    for (const j of [0, film.opponent]) if (j !== null && film.actors[j]) this.way(c, film.actors[j], at, t, scale);
    film.actors.forEach((actor, j) => { if (this.named(j) && actor.kind !== "standing") drawExpected(c, actor, at, scale); });
    for (const j of order) this.actor(c, film.actors[j], at, scale, j === film.opponent);
    this.contact(c, t, scale);
    c.setTransform(1, 0, 0, 1, 0, 0);
    this.words(c, at, t, { scale, mx, my, w, h, sharp });
  }
  named(j) { return this.film.actors.length <= FEW || j === 0 || j === this.film.opponent; }
  rank(j) { return j === this.film.opponent ? 2 : j === 0 ? 1 : 0; }
  roads(c, scale) {
    const [ox, oy] = this.film.origin;
    c.save();
    c.translate(-ox, -oy);
    for (const pass of ["rim", "face"]) {
      for (const id of this.film.lanes) {
        const lane = this.lanes[id], area = lane.kind === "area" || lane.kind === "walking_area";
        c.beginPath();
        lane.x.forEach((x, k) => k ? c.lineTo(x, lane.y[k]) : c.moveTo(x, lane.y[k]));
        const paint = colour(lane.kind === "walk" || lane.kind === "walking_area" ? "--walk" : lane.kind === "bike" ? "--bike"
          : lane.kind === "crossing" ? "--stripe-road" : "--road");
        if (area) { if (pass === "face") continue; c.fillStyle = paint; c.fill(); continue; }
        c.lineJoin = "round";
        c.strokeStyle = pass === "rim" ? colour("--road-edge") : paint;
        c.lineWidth = lane.width + (pass === "rim" ? 0.3 : -0.14);
        c.stroke();
        if (lane.kind === "crossing" && pass === "face") {
          c.strokeStyle = colour("--road-edge"); c.lineWidth = 0.8 * lane.width; c.setLineDash([0.5, 0.5]); c.stroke(); c.setLineDash([]);
        }
      }
    }
    c.restore();
  }
  way(c, actor, at, t, scale) {
    const x = between(actor.x, at), y = between(actor.y, at);
    if (Number.isNaN(x)) return;
    c.beginPath();
    c.moveTo(x, y);
    for (let k = at[0] + 1; k < actor.x.length && this.film.time[k] <= t + AHEAD; k++)
      if (!Number.isNaN(actor.x[k])) c.lineTo(actor.x[k], actor.y[k]);
    c.strokeStyle = ACTORS[actor.kind]; c.lineWidth = 1.6 / scale; c.setLineDash([5 / scale, 4 / scale]); c.stroke(); c.setLineDash([]);
  }
  actor(c, actor, at, scale, opponent) {
    for (const body of [...(actor.parts.length ? [...actor.parts].reverse() : [actor])]) {
      const x = between(body.x, at), y = between(body.y, at), h = between(body.h, at);
      if ([x, y, h].some(Number.isNaN)) continue;
      const a = body.length / 2, b = body.width / 2;
      c.save();
      c.translate(x, y);
      c.rotate(h);
      c.beginPath();
      if (actor.kind === "person" || body.length === body.width) c.ellipse(0, 0, a, b, 0, 0, 2 * Math.PI);
      else {
        const nose = actor.kind !== "standing" && (!actor.parts.length || body === actor.parts[0]) ? Math.min(0.14 * a, 0.6) : 0;
        c.moveTo(a, b / 2); c.lineTo(a - nose, b); c.lineTo(-a, b); c.lineTo(-a, -b); c.lineTo(a - nose, -b); c.lineTo(a, -b / 2);
        c.closePath();
      }
      c.fillStyle = ACTORS[actor.kind];
      c.fill();
      c.strokeStyle = colour("--ink");
      c.lineWidth = (opponent ? 1.8 : 0.8) / scale;
      c.stroke();
      c.restore();
    }
  }
  contact(c, t, scale) {
    for (const hit of this.film.contacts) {
      if (t < hit.time) continue;
      c.beginPath();
      c.arc(hit.x, hit.y, 12 / scale, 0, 2 * Math.PI);
      c.strokeStyle = colour("--critical"); c.lineWidth = 3 / scale; c.stroke();
    }
  }
  words(c, at, t, { scale, mx, my, w, h, sharp }) {
    c.font = `${12 * sharp}px system-ui, sans-serif`;
    c.lineWidth = 3 * sharp; c.lineJoin = "round";
    c.strokeStyle = colour("--ground"); c.fillStyle = colour("--ink");
    const write = (text, x, y, align) => { c.textAlign = align; c.strokeText(text, x, y); c.fillText(text, x, y); };
    this.film.actors.forEach((actor, j) => {
      if (!this.named(j)) return;
      const x = w / 2 + scale * (between(actor.x, at) - mx), y = h / 2 - scale * (between(actor.y, at) - my);
      if (!(x > 0 && x < w && y > 0 && y < h)) return;
      write(shortened(actor.name, 24), x, y - (scale * actor.width / 2 + 7 * sharp), "center");
    });
    write(`${t.toFixed(1)} s   ego ${(3.6 * between(this.film.actors[0].v, at)).toFixed(0)} km/h`, w - 8 * sharp, 18 * sharp, "right");
    const bar = [1, 2, 5, 10, 20, 50].find(m => m * scale > 50 * sharp) || 100;
    c.fillRect(10 * sharp, h - 9 * sharp, bar * scale, 2 * sharp);
    write(`${bar} m`, 10 * sharp, h - 14 * sharp, "left");
    const other = this.film.actors[this.film.opponent ?? -1], dx = other ? between(other.x, at) - mx : NaN, dy = other ? between(other.y, at) - my : NaN;
    if (Math.abs(dx) > this.film.half[0] || Math.abs(dy) > this.film.half[1] * 1.02) {
      const ego = this.film.actors[0], away = Math.hypot(dx + mx - between(ego.x, at), dy + my - between(ego.y, at));
      write(`${shortened(other.name, 20)} ${away.toFixed(0)} m away`, w / 2, h - 14 * sharp, "center");
    }
    const hits = this.film.contacts.filter(hit => hit.time <= t).map(hit => `contact with ${shortened(hit.with, 20)} at ${hit.time.toFixed(1)} s`);
    if (hits.length) { c.fillStyle = colour("--critical"); write(hits[0], w - 8 * sharp, h - 9 * sharp, "right"); }
  }
}

// A player of one or several scenes with one slider; `seen` is told every instant that is shown.
class Player {
  constructor(count, seen = () => {}) {
    this.seen = seen;
    this.scenes = Array.from({ length: count }, () => new Scene());
    this.slider = make("input", { type: "range", min: 0, step: "any", "aria-label": "time (s)",
      oninput: () => { this.pause(); this.show(Number(this.slider.value)); } });
    this.button = make("button", { type: "button", class: "play", onclick: () => this.toggle() }, "Play");
    this.speed = make("select", { "aria-label": "speed of the film" },
      ...[0.1, 0.25, 0.5, 1, 2, 4].map(v => make("option", { value: v, ...(v === 1 ? { selected: "" } : {}) }, `${v}\u00d7`)));
    const stepper = (sign, name, text) =>
      make("button", { type: "button", "aria-label": name, onclick: () => { this.pause(); this.show(this.now + sign * this.step); } }, text);
    this.bar = make("div", { class: "film-bar" }, this.button, stepper(-1, "one step back", "\u2212"),
      stepper(1, "one step on", "+"), this.slider, this.speed);
    for (const scene of this.scenes) scene.canvas.addEventListener("keydown", event => this.key(event));
  }
  // Takes films from now on, and stands at the worst moment of the first.
  load(films, lanes, labels) {
    this.pause();
    this.films = films;
    this.end = Math.max(...films.map(film => film.time[film.time.length - 1]));
    this.slider.max = this.end;
    this.scenes.forEach((scene, k) => scene.load(films[k], lanes, labels[k]));
    this.step = Math.max(...films.map(film => film.time.length > 1 ? film.time[1] - film.time[0] : 0.1));
    this.now = films[0].time[films[0].moment] ?? 0;
    this.fresh = true;
  }
  key(event) {
    const move = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (move) { this.pause(); this.show(this.now + move * this.step); } else if (event.key === " ") this.toggle(); else return;
    event.preventDefault();
  }
  show(t) {
    this.fresh = false;
    this.now = Math.max(0, Math.min(this.end, t));
    this.slider.value = this.now;
    this.slider.setAttribute("aria-valuetext", `${this.now.toFixed(1)} seconds`);
    for (const scene of this.scenes) scene.draw(this.now);
    this.seen(this.now);
  }
  begin() { this.show(this.now); this.fresh = true; }
  toggle() { if (this.playing) this.pause(); else this.play(); }
  pause() { this.playing = false; this.button.textContent = "Play"; }
  play() {
    if (this.fresh || this.now >= this.end) this.show(0);
    this.playing = true;
    this.button.textContent = "Pause";
    let last = performance.now();
    const tick = now => {
      if (!this.playing || !this.slider.isConnected) return;
      this.show(this.now + Number(this.speed.value) * (now - last) / 1000);
      last = now;
      if (this.now >= this.end) this.pause(); else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }
}

// The title of a panel, which is as high as about 14 letters are long.
const inLines = (panel, unit) => {
  const whole = withUnit(panel, unit ? `(${unit})` : "");
  if (whole.length < 15) return safe(whole);
  const words = panel.replace(/ so far$/, ""), rest = withUnit(panel.slice(words.length + 1), unit ? `(${unit})` : "").trim();
  return [shortened(words, 15), rest].filter(Boolean).map(safe).join("<br>");
};
// The range of a panel of curves that shows all of some curves, and their limits.
const reachOf = (panel, curves) => {
  const values = curves.filter(curve => curve.panel === panel).flatMap(curve => [...curve.values, ...(curve.limits || [])]).filter(Number.isFinite);
  const low = Math.min(...values), high = Math.max(...values), air = 0.06 * (high - low) || 0.5;
  return values.length ? [low - air, high + air] : undefined;
};
// Curves over time, a panel each, on axes for `all` curves; returns a function that moves the line of the moment.
const drawCurves = async (Plotly, place, film, look, end = film.time[film.time.length - 1], all = null) => {
  const known = new Set((all || film.curves).filter(curve => curve.values.some(Number.isFinite)).map(curve => curve.panel));
  const panels = [...new Set(film.curves.map(curve => curve.panel))].filter(panel => known.has(panel));
  const colours = [ACTORS.ego, ACTORS.other];
  const n = panels.length, layout = look({ height: 40 + 96 * n, margin: { l: 52, r: 12, t: 8, b: 34 }, showlegend: false, shapes: [] });
  const drawn = film.curves.filter(curve => known.has(curve.panel));
  const traces = drawn.map((curve, k) => {
    const p = panels.indexOf(curve.panel);
    const mine = drawn.slice(0, k).filter(other => other.panel === curve.panel).length;
    return { x: film.time, y: curve.values, name: safe(curve.name), mode: "lines", type: "scatter", xaxis: "x", yaxis: `y${p ? p + 1 : ""}`,
      line: { color: panels[p] === "speed" ? colours[mine % 2] : colour("--model"), width: 1.8 },
      hovertemplate: `${safe(curve.name)}: %{y:.3g} ${safe(curve.unit)}<extra></extra>` };
  });
  panels.forEach((panel, p) => {
    const curve = film.curves.find(each => each.panel === panel), top = 1 - p / n;
    layout[`yaxis${p ? p + 1 : ""}`] = { ...layout.yaxis, domain: [top - 1 / n + 0.04, top], zeroline: false, nticks: 4, range: all ? reachOf(panel, all) : undefined,
      title: { text: inLines(panel, curve.unit), font: { size: 11 } } };
    for (const limit of curve.limits || []) layout.shapes.push({ type: "line", xref: "paper", x0: 0, x1: 1, y0: limit, y1: limit,
      yref: `y${p ? p + 1 : ""}`, line: { color: colour("--critical"), width: 1, dash: "dash" } });
  });
  layout.xaxis = { ...layout.xaxis, anchor: `y${n > 1 ? n : ""}`, title: { text: "time (s)", font: { size: 11 } }, range: [0, end || 1] };
  layout.hovermode = "x unified";
  const cursor = layout.shapes.length;
  layout.shapes.push({ type: "line", xref: "x", yref: "paper", x0: 0, x1: 0, y0: 0, y1: 1, line: { color: colour("--ink"), width: 1.2 } });
  await Plotly.newPlot(place, traces, layout, PLAIN);
  return t => Plotly.relayout(place, { [`shapes[${cursor}].x0`]: t, [`shapes[${cursor}].x1`]: t });
};
