"""How soon the live view shows a large campaign, in a headless Chromium: numbers, runs, the scatter, and all that is shown.

    python benchmarks/serve_speed.py --runs 100000

From the request of the page to the first frame with each; the list of campaigns was open before, as one comes from there.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from browser import Browser

import sbt

WATCH = """window.seen = {};
const conditions = {
  numbers: () => /runs/.test((document.getElementById('numbers') || {}).textContent || ''),
  runs: () => window.explorer && window.explorer.table.rows.length > 0,
  scatter: () => window.explorer && window.explorer.listening && document.querySelector('[data-part=scatter] .main-svg'),
  all: () => window.explorer && window.explorer.listening && window.explorer.data.index.length >= MOST
    && !document.getElementById('said').textContent,
};
const look = () => {
  for (const [name, holds] of Object.entries(conditions)) if (!(name in window.seen) && holds()) {
    window.seen[name] = 0;
    const painted = new MessageChannel();
    painted.port1.onmessage = () => { window.seen[name] = performance.now() / 1000; };
    painted.port2.postMessage(0);
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);"""


def page(folder: Path, shown: int) -> dict[str, float]:
    """Return the seconds until each part of a campaign's page is painted, of a server and a browser that were just started."""
    command = [sys.executable, "-m", "sbt", "serve", str(folder), "--port", "0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        address = next(found.group() for line in server.stdout or () if (found := re.search(r"http://\S+", line)))
        with Browser(height=900) as browser:
            browser.open(address)
            browser.wait("document.querySelector('#campaigns a')")
            time.sleep(2)
            browser.beforehand(WATCH.replace("MOST", str(shown)))
            browser.ask("location.href = document.querySelector('#campaigns a').href; 0")
            browser.wait("window.seen && window.seen.all > 0")
            return dict(browser.ask("window.seen"))
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(20)


def main() -> None:
    """Make a campaign, show it some times, and print what it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--scenario", default="testbed:damped_oscillator_15")
    parser.add_argument("--opened", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        store = str(Path(made, "large"))
        sbt.run(campaign="coverage", scenario=args.scenario, budget=args.runs, seed=1, store=store, report=False)
        seen = [page(Path(made), min(args.runs, 20_000)) for _ in range(args.opened)]
    print(f"load {os.getloadavg()[0]:.1f}\n| s | median | slowest |\n|---|---|---|")
    for name in seen[0]:
        times = [each[name] for each in seen]
        print(f"| {name} | {statistics.median(times):.1f} | {max(times):.1f} |")


if __name__ == "__main__":
    main()
