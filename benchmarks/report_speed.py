"""How soon a report shows its first paint, and the film of a run that was clicked, in a headless Chromium.

    python benchmarks/report_speed.py --runs 10000 --scenario parking --clicks 8

Clicks are real events of a mouse on the list of films; the time goes to the end of the frame that follows the click.
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

READY = "window.explorer && window.Plotly && document.querySelector('[data-part=scatter] .main-svg')"
PAINT = "(performance.getEntriesByName('first-contentful-paint')[0] || { startTime: 0 }).startTime"
WATCH = """window.took = [];
document.addEventListener('click', event => {
  const begun = event.timeStamp;
  requestAnimationFrame(() => {
    const seen = new MessageChannel();
    seen.port1.onmessage = () => window.took.push(performance.now() - begun);
    seen.port2.postMessage(0);
  });
}, true);"""
PLACE = """(k => { const button = document.querySelectorAll('[data-part=films] button')[k];
  button.scrollIntoView({ block: 'center' }); const box = button.getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2]; })"""


def clicked(browser: Browser, k: int) -> float:
    """Return the milliseconds from a click on the k-th film of the list to the frame that shows it."""
    x, y = browser.ask(f"{PLACE}({k})")
    before = browser.ask("window.took.length")
    browser.click(x, y)
    browser.wait(f"window.took.length > {before}", 20)
    if not browser.ask("document.querySelector('[data-part=film] canvas')?.width > 0"):
        raise SystemExit("no film is shown after the click")
    return float(browser.ask("window.took.at(-1)"))


def main() -> None:
    """Make a report, open it, click, and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--scenario", default="parking")
    parser.add_argument("--clicks", type=int, default=8)
    parser.add_argument("--opened", type=int, default=3, help="times that the report is opened")
    parser.add_argument("--store", type=Path, help="a store that is there already")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        store = args.store or Path(made, "store")
        if args.store is None:
            sbt.run(campaign="coverage", scenario=args.scenario, budget=args.runs, seed=1, store=str(store), report=False)
        start = time.process_time()
        report = Path(sbt.open(store).report()).resolve()
        cpu = time.process_time() - start
        with Browser(height=900) as browser:
            paints = []
            for k in range(args.opened):
                browser.open(f"file://{report}?{k}")
                browser.wait(READY)
                paints.append(float(browser.ask(PAINT)))
            browser.ask(WATCH)
            films = int(browser.ask("document.querySelectorAll('[data-part=films] button').length"))
            times = [clicked(browser, k) for k in range(min(args.clicks, films))]
        load = os.getloadavg()[0]
        print("| runs | size (MB) | made (CPU s) | first paint (ms) | film after a click (ms): median | most | load |")
        print("|---|---|---|---|---|---|---|")
        told = " ".join(f"{paint:.0f}" for paint in paints)
        middle, most = (f"{statistics.median(times):.0f}", f"{max(times):.0f}") if times else ("-", "-")
        print(f"| {args.runs:,} | {report.stat().st_size / 1e6:.1f} | {cpu:.1f} | {told} | {middle} | {most} | {load:.1f} |")


if __name__ == "__main__":
    main()
