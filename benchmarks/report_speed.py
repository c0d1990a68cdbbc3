"""How soon a report shows its first paint, and the film of a run whose point was clicked, in a headless Chromium.

    python benchmarks/report_speed.py --runs 10000 --scenario parking --clicks 8

A mouse presses and lets go of points of the scatter whose runs have films, the first as soon as the points are there,
each other one `--pause` s after the film before. The time goes from the press to the end of the first frame with the
clicked run's own title and film.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from browser import Browser

import sbt

READY = "window.explorer && window.explorer.listening"
PAINT = "(performance.getEntriesByName('first-contentful-paint')[0] || { startTime: 0 }).startTime"
WATCH = """window.took = null;
addEventListener('pointerdown', event => {
  const begun = event.timeStamp, { index, filmOf } = window.explorer.data;
  window.took = null;
  const look = () => {
    const run = window.awaited, canvas = document.querySelector('[data-part=film] canvas');
    const there = canvas && canvas.width > 0 && canvas.getAttribute('aria-label').startsWith(`run ${run} from above`)
      && document.querySelector('[data-part=run-title]').textContent.startsWith(`Run ${run}:`);
    if (!there) return requestAnimationFrame(look);
    const seen = new MessageChannel();
    seen.port1.onmessage = () => { window.took = performance.now() - begun; };
    seen.port2.postMessage(0);
  };
  requestAnimationFrame(look);
}, true);"""
# Runs with films, and where the point of one lies in the window.
FILMED = (
    """(({ data, view }) => data.films.map(film => film.run).filter(run => data.rowOf.get(run) !== view.run))(window.explorer)"""
)
PLACE = """(run => {
  const { data } = window.explorer, plot = document.querySelector('[data-part=scatter]'), { xaxis, yaxis } = plot._fullLayout;
  plot.scrollIntoView({ block: 'center', behavior: 'instant' });
  const box = plot.querySelector('.nsewdrag').getBoundingClientRect();
  for (const trace of plot.data) for (const [k, row] of trace.rows.entries())
    if (data.index[row] === run) return [box.x + xaxis.d2p(trace.x[k]), box.y + yaxis.d2p(trace.y[k])];
})"""


def clicked(browser: Browser, run: int) -> float | None:
    """Return the milliseconds from a click on a run's point to the frame with its film; None where the mouse misses it."""
    x, y = browser.ask(f"(window.awaited = {run}, {PLACE}({run}))")
    browser.move(x, y)
    if not browser.ask(f"document.querySelector('[data-part=tip]').textContent.startsWith('run {run},')"):
        return None
    browser.click(x, y)
    try:
        browser.wait("window.took !== null", 10)
    except AssertionError:  # the page still scrolled to the run before, and the point was no longer there
        return None
    return float(browser.ask("window.took"))


def first_paint(report: Path) -> float:
    """Return the milliseconds to the first paint of a report in a browser that has just started."""
    with Browser(height=900) as browser:
        browser.open(f"file://{report}")
        browser.wait(f"{PAINT} > 0")
        return float(browser.ask(PAINT))


def main() -> None:
    """Make a report, open it, click, and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--scenario", default="parking")
    parser.add_argument("--clicks", type=int, default=8)
    parser.add_argument("--pause", type=float, default=0.5, help="seconds from a film to the next click")
    parser.add_argument("--opened", type=int, default=3, help="times that the report is opened, in new browsers and then in one")
    parser.add_argument("--store", type=Path, help="a store that is there already")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        store = args.store or Path(made, "store")
        if args.store is None:
            sbt.run(campaign="coverage", scenario=args.scenario, budget=args.runs, seed=1, store=str(store), report=False)
        start = time.process_time()
        report = Path(sbt.open(store).report()).resolve()
        cpu = time.process_time() - start
        cold = [first_paint(report) for _ in range(args.opened)]
        with Browser(height=900) as browser:
            paints, times = [], []
            for k in range(args.opened):
                browser.open(f"file://{report}?{k}")
                browser.wait(READY)
                browser.ask(WATCH)
                for run in browser.ask(FILMED):
                    took = clicked(browser, run) if len(times) < (k + 1) * args.clicks else None
                    if took is not None:
                        times.append(took)
                        time.sleep(args.pause)
                paints.append(float(browser.ask(PAINT)))
        load = os.getloadavg()[0]
        print("clicks (ms):", *(f"{took:.0f}" for took in times))
        paint = "first paint (ms): new browsers | one browser"
        print(f"| runs | size (MB) | made (CPU s) | {paint} | film after a click (ms): median | most | load |")
        print("|---|---|---|---|---|---|---|---|")
        told = " | ".join(" ".join(f"{paint:.0f}" for paint in each) for each in (cold, paints))
        middle, most = (f"{statistics.median(times):.0f}", f"{max(times):.0f}") if times else ("-", "-")
        print(f"| {args.runs:,} | {report.stat().st_size / 1e6:.1f} | {cpu:.1f} | {told} | {middle} | {most} | {load:.1f} |")


if __name__ == "__main__":
    main()
