// What ego's sensor sees, and where road users would be if they kept on: as in sight.py.
const HORIZON = [1, 2, 3];  // seconds ahead
const RAYS = 121, BESIDE = 1e-4, SLOW = 0.5;

// How far a ray from (x, y) along (u, v) goes before it meets a box, at most `reach`: nothing where it begins in one.
const free = (x, y, u, v, boxes, reach) => {
  for (const box of boxes) {
    const dx = x - box.x, dy = y - box.y;
    let enter = -Infinity, leave = Infinity;
    for (const [at, way, half] of [[dx * box.cos + dy * box.sin, u * box.cos + v * box.sin, box.length / 2], [dy * box.cos - dx * box.sin, v * box.cos - u * box.sin, box.width / 2]]) {
      const pace = 1 / (Math.abs(way) < 1e-12 ? 1e-12 : way), near = (-half - at) * pace, far = (half - at) * pace;
      enter = Math.max(enter, Math.min(near, far));
      leave = Math.min(leave, Math.max(near, far));
    }
    if (enter <= leave && leave > 0 && enter < reach) reach = Math.max(enter, 0);
  }
  return reach;
};
const cornersOf = box => [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([a, b]) =>
  [box.x + (a * box.length * box.cos - b * box.width * box.sin) / 2, box.y + (a * box.length * box.sin + b * box.width * box.cos) / 2]);
const spreadOut = (most, n, edges) => [...Array.from({ length: n }, (_, k) => most * (2 * k / (n - 1) - 1)),
  ...edges.flatMap(edge => [edge - BESIDE, edge + BESIDE]).filter(edge => Math.abs(edge) < most)].sort((a, b) => a - b);

// The outline of what is in view from (x, y, heading): points in metres.
const areaInView = (view, [x, y, heading], boxes, most) => {
  const cos = Math.cos(heading), sin = Math.sin(heading), ex = x + view.ahead * cos, ey = y + view.ahead * sin;
  const reach = Math.min(view.reach ?? Infinity, most), corners = boxes.flatMap(cornersOf).map(([px, py]) => [px - ex, py - ey]);
  if (view.half_width !== null) {
    const starts = spreadOut(view.half_width, 9, corners.map(([px, py]) => py * cos - px * sin)).map(left => [ex - left * sin, ey + left * cos]);
    const ends = starts.map(([sx, sy]) => { const far = free(sx, sy, cos, sin, boxes, reach); return [sx + far * cos, sy + far * sin]; });
    return [...starts, ...ends.reverse()];
  }
  const turned = corners.map(([px, py]) => Math.atan2(py * cos - px * sin, px * cos + py * sin));
  const ends = spreadOut(view.half_angle, RAYS, turned).map(turn => {
    const u = Math.cos(heading + turn), v = Math.sin(heading + turn), far = free(ex, ey, u, v, boxes, reach);
    return [ex + far * u, ey + far * v];
  });
  return view.half_angle >= Math.PI ? ends : [[ex, ey], ...ends];
};

const drawArea = (c, film, at, scale) => {
  if (!film.view) return;
  const place = actor => ["x", "y", "h"].map(name => between(actor[name], at)), own = place(film.actors[0]);
  if (own.some(Number.isNaN)) return;
  const boxes = film.view.hidden_by.map(j => film.actors[j]).map(actor => { const [x, y, h] = place(actor); return { x, y, cos: Math.cos(h), sin: Math.sin(h), length: actor.length, width: actor.width }; })
    .filter(box => !Number.isNaN(box.x));
  c.beginPath();
  areaInView(film.view, own, boxes, 2 * (film.half[0] + film.half[1])).forEach(([x, y], k) => k ? c.lineTo(x, y) : c.moveTo(x, y));
  c.closePath();
  c.fillStyle = colour("--seen");
  c.fill();
  c.strokeStyle = colour("--seen-edge"); c.lineWidth = 1 / scale; c.stroke();
};

// A dotted line to where an actor would be in three seconds with its speed and heading, a dot for each second.
const drawExpected = (c, actor, at, scale) => {
  const [x, y, h, v] = ["x", "y", "h", "v"].map(name => between(actor[name], at));
  if (!(Math.abs(v) >= SLOW) || Number.isNaN(x)) return;
  const [u, w] = [v * Math.cos(h), v * Math.sin(h)], last = HORIZON[HORIZON.length - 1];
  c.strokeStyle = c.fillStyle = ACTORS[actor.kind]; c.lineWidth = 1.4 / scale;
  c.beginPath(); c.moveTo(x, y); c.lineTo(x + last * u, y + last * w);
  c.setLineDash([1.5 / scale, 3.5 / scale]); c.stroke(); c.setLineDash([]);
  for (const t of HORIZON) { c.beginPath(); c.arc(x + t * u, y + t * w, 2.6 / scale, 0, 2 * Math.PI); c.fill(); }
};
