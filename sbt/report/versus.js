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
    this.films = pair.films.map(developed);
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
    for (let j = 0; j < this.films.length; j++) moved.push(await drawCurves(Plotly, this.curves[j], this.films[j], look, this.player.end));
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
compare();
