// Two egos on the same draws: the films of a pair run side by side with one slider.
class Versus {
  constructor(place, data) {
    this.place = place;
    this.data = data;
    this.lanes = data.lanes.map(outlined);
    this.part = name => place.querySelector(`[data-part=${name}]`);
    data.pairs.forEach((pair, k) => this.part("list").append(make("button", { type: "button", class: "chip", onclick: () => this.open(k) }, pair.title)));
    this.player = new Player(2, t => this.moved.forEach(move => move(t)));
    this.part("bar").append(this.player.bar);
    this.open(0);
  }
  open(k) {
    const pair = this.data.pairs[k];
    this.k = k;
    const widest = pair.films.reduce((a, b) => b.half[0] > a.half[0] ? b : a);  // both films to one scale
    this.films = pair.films.map(film => developed({ ...film, half: widest.half, ratio: widest.ratio }));
    this.moved = [];
    const labels = ["before", "after"].map((name, j) => `${pair.title}, ${name}: ${pair.films[j].contacts.length ? "contact" : "no contact"}`);
    this.player.load(this.films, this.lanes, labels);
    this.part("title").textContent = pair.title;
    this.part("inputs").textContent = pair.inputs;
    this.curves = this.films.map(() => make("div"));
    this.part("films").replaceChildren(...this.player.scenes.map((scene, j) =>
      make("div", {}, make("p", { class: "role" }, `${["Before", "After"][j]}: ${pair.said[j]}`), scene.canvas, this.curves[j])));
    this.part("legend").textContent = legend(this.films);
    this.player.begin();
    this.draw();
  }
  async draw() {
    if (!window.Plotly) return;
    const k = this.k, moved = [];
    const all = this.films.flatMap(film => film.curves);
    for (let j = 0; j < this.films.length; j++) moved.push(await drawCurves(Plotly, this.curves[j], this.films[j], look, this.player.end, all));
    if (k !== this.k) return;
    this.moved = moved;
    moved.forEach(move => move(this.player.now));
  }
}
const compare = async () => {
  const place = document.getElementById("pairs");
  if (!place || !window.DecompressionStream) return;
  const data = JSON.parse(await unpacked("explorer-data"));
  if (!data.pairs.length) return;
  place.hidden = false;
  const versus = window.versus = new Versus(place, data);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { painted.clear(); versus.player.show(versus.player.now); versus.draw(); });
  new ResizeObserver(() => versus.player.show(versus.player.now)).observe(place);
  if (document.getElementById("library").textContent.trim()) setTimeout(() => withLibrary(() => versus.draw()), 30);
};
afterPaint(compare);
