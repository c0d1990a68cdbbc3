"""Accessibility: axe-core finds nothing serious on any page, in light and dark, at the width of a screen and of a phone."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import PROGRAM, Browser
from test_explorer import film_of, films_of
from test_report import fill, predict, scenario_of

from sbt.report.html import write_report
from sbt.report.versus import Question, write_versus

_AXE = importlib.util.find_spec("axe_core_python")
pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium"),
    pytest.mark.skipif(_AXE is None, reason="axe-core-python is not installed"),
]
SERIOUS = """axe.run().then(found => found.violations.filter(v => ["serious", "critical"].includes(v.impact))
    .map(v => `${v.id}: ${v.nodes.length} times, ${v.nodes[0].html.slice(0, 200)}`))"""
DRAWN = "window.explorer && window.Plotly && document.querySelector('[data-part=curves] .main-svg')"


def faults(browser: Browser) -> list[str]:
    """Return what axe-core finds on the page that is open, in light and dark; nothing of it is left out of view."""
    assert _AXE is not None
    script = Path(str(_AXE.origin)).parent / "axe.min.js"
    browser.ask("document.documentElement.style.setProperty('scroll-behavior', 'auto')")
    browser.ask(script.read_text(encoding="utf-8") + ";0")
    found: list[str] = []
    for width, dark in ((1280, False), (390, True)):
        browser.size(width, 1600, dark=dark)
        browser.ask("new Promise(then => setTimeout(then, 300))")
        found += browser.ask(SERIOUS)
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as found:
        yield found


@pytest.mark.slow
def test_the_report_has_no_serious_fault(browser: Browser, tmp_path: Path) -> None:
    """With its explorer, a film, slices, figures and tables."""
    scenario = scenario_of(3)
    with fill(tmp_path, scenario, runs=16, held_out=10) as store:
        page = write_report(store, scenario, predict, None, film=films_of)
    browser.open(f"file://{page}")
    browser.wait(DRAWN)
    assert browser.ask("[...document.querySelectorAll('main > section')].map(each => each.id)") == [
        "explore", "figures", "inputs", "critical", "failed", "iterations", "reproduce", "about"
    ], "what is read after the first paint is in its place"
    heads = "[...document.querySelectorAll('#inputs tbody td:first-child')].map(cell => cell.textContent)"
    before = browser.ask(heads)
    browser.ask("document.querySelector('#inputs th').click(); 0")
    assert browser.ask(heads) == sorted(before)
    browser.ask("document.querySelector('#inputs th').click(); 0")
    assert browser.ask(heads) == sorted(before, reverse=True)
    assert faults(browser) == []


def test_the_comparison_has_no_serious_fault(browser: Browser, tmp_path: Path) -> None:
    """With two films in step."""
    pairs = [("fixed", film_of(1), film_of(2))]
    side = {"probability": 0.1, "low": 0.05, "high": 0.2, "failed": 0, "critical": 1}
    result = {
        "fixed": [{"run": 1, "inputs": {"d_v": 3.0}, "seed": 7, "before": {"pet": 0.2}, "after": {"pet": math.inf}}],
        "new": [], "pairs": 10, "still": 0,
        "before": side, "after": side, "difference": -0.1, "low": -0.2, "high": 0.0, "confidence": 0.95, "verdict": "fell",
    }  # fmt: skip
    question = Question("pet ≤ 1 s", {"pet": "s"}, ("a.yaml", "that of cut_in"), ("b.yaml", "acc_aeb, reaction_time: 1.5"))
    command = "sumo-sbt replay DIR 1"
    page = write_versus(tmp_path, "Two egos", result, pairs, question=question, units={"d_v": "m/s"}, commands=command)
    browser.open(f"file://{page}")
    browser.wait("window.versus && window.Plotly && document.querySelector('#pairs .main-svg')")
    assert faults(browser) == []
