"""The report's explorer: what lies in the page, and what a browser makes of it."""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
import subprocess
from importlib.resources import files
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from browser import PROGRAM
from test_report import CRITICAL, fill, metric, predict, scenario_of

from sbt.problem.metric import Metric
from sbt.problem.outcome import Outcome, Status
from sbt.problem.requirement import Requirement
from sbt.problem.trace import FieldOfView, Trace
from sbt.report.explorer import packed
from sbt.report.html import write_report
from sbt.report.reel import Film, Reels
from sbt.report.slices import slices_through
from sbt.store.database import PlannedRun, Store
from sbt.sumo.nets import Lane

EVIL = "</script><script>alert(1)</script><b>\N{COLLISION SYMBOL}" + "x" * 180


def trace_of(k=0):
    """Return two cars on a road, of which the first drives into the second in the end; a third leaves half-way."""
    time = np.arange(0.0, 4.01, 0.1)
    x = np.stack([10.0 * time + k, 40.0 - 2.0 * time, np.where(time < 2.0, 5.0 * time, np.nan)], axis=1)
    y = np.stack([0.0 * time, 0.1 * time, np.where(time < 2.0, 3.0, np.nan)], axis=1)
    speed = np.where(np.isnan(x), np.nan, np.array([[10.0, 2.0, 5.0]]))
    heading = np.where(np.isnan(x), np.nan, np.array([[0.0, math.pi, 0.0]]))
    size = np.array([4.5, 4.5, 4.5]), np.array([1.8, 1.8, 1.8])
    names, view = ("ego", f"co{EVIL}", "bike"), FieldOfView(50.0, 2.0)
    return Trace(time, names, x, y, heading, speed, 0.0 * speed, *size, ended="collision", view=view)


NEAREST = Metric("gap", lambda t: float(np.nanmin(np.hypot(t.x[:, 1] - t.x[:, 0], t.y[:, 1] - t.y[:, 0]))), "m")
LANES = (Lane(((-50.0, 0.0), (100.0, 0.0)), 3.2), Lane(((0.0, 900.0), (9.0, 900.0)), 3.2))


def film_of(run, role="critical run"):
    return Film(run, role, trace_of(run % 7), NEAREST, Requirement("gap", high=3.0), LANES)


def films_of(chosen):
    return [film_of(run, role) for run, role in chosen.items()], ""


def data_in(text):
    packed = re.search(r'id="explorer-data">([^<]*)<', text).group(1)
    return json.loads(gzip.decompress(base64.b64decode(packed)))


def numbers(column, kind="<f4"):
    return np.frombuffer(base64.b64decode(column), kind)


def back(series, unit):
    """Return the values of a series of differences, in metres."""
    values, last = [], 0
    for step in series:
        last = last if step is None else last + step
        values.append(math.nan if step is None else last / unit)
    return np.array(values)


def test_the_page_holds_every_run_film_and_slice(tmp_path):
    scenario = scenario_of(3)
    with fill(tmp_path, scenario) as store:
        text = write_report(store, scenario, predict, None, film=films_of).read_text(encoding="utf-8")
        history = store.history()
    data = data_in(text)
    assert numbers(data["index"], "<i4").tolist() == history.index.tolist()
    for k in range(3):
        np.testing.assert_allclose(numbers(data["x"][k]), history.x[:, k], rtol=1e-6)
    assert [data["verdict"][k] for k in np.flatnonzero(~history.ok)] == [2, 2, 2]
    assert sum(v == 1 for v in data["verdict"]) == scenario.requirement.critical_runs(history).sum()
    assert 3 < len(data["films"]) <= 24
    assert data["films"][0]["role"] == "most critical run"
    assert set(data["slices"]["runs"]) >= {film["run"] for film in data["films"]}
    assert data["slices"]["error_p"] < 0.01


def test_a_film_is_the_trace_to_the_centimetre():
    reels, film = Reels(), film_of(3)
    data = reels.add(film)
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    for j, actor in enumerate(data["actors"]):
        states, origins = (film.trace.x, film.trace.y, film.trace.heading), (*data["origin"], 0.0)
        for name, values, unit, origin in zip("xyh", states, (100.0, 100.0, 1000.0), origins, strict=True):
            np.testing.assert_allclose(back(actor[name], unit) + origin, values[:, j], atol=0.0051)
    assert data["contacts"][0]["with"] == film.trace.actors[1]
    assert len(reels.lanes) == 1, "what is far away is left out"
    assert [curve["panel"] for curve in data["curves"]] == ["speed", "speed", "gap", "TTC", "gap so far"]


def test_slices_are_the_metamodel(tmp_path):
    space = scenario_of(2).space
    x = space.from_unit(np.array([[0.3, 0.6]]))
    found = slices_through(predict, CRITICAL, space, x, [17])
    assert found["runs"] == [17]
    at = np.array(found["grid"][1])
    u = space.to_unit(np.stack([np.full(len(at), x[0, 0]), at], axis=1))
    np.testing.assert_allclose(found["of"][0][1][0], metric(u), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("values", ["none critical", "all critical", "equal", "no number"])
def test_any_rows_can_be_packed(tmp_path, values):
    scenario = scenario_of(2)
    given = {"none critical": [5.0, 6.0, 7.0], "all critical": [0.0, 0.1, -1.0], "equal": [3.0] * 3, "no number": [math.inf] * 3}
    with Store.open(tmp_path, {"names": ["d_t", "d_v"], "scenario": "w", "campaign": "coverage"}, durable=False) as store:
        store.plan(0, "initial", [PlannedRun("initial", {"d_t": 1.0, "d_v": 2.0})] * 3, [1, 2, 3], {})
        for k in range(3):
            store.append(Outcome(k, Status.OK, {"ttc_min": given[values][k]}))
        data = data_in(write_report(store, scenario, None, None).read_text(encoding="utf-8"))
    assert data["verdict"] == [int(values == "all critical")] * 3


def test_data_cannot_leave_its_element():
    assert re.fullmatch(r"[A-Za-z0-9+/=]+", packed({EVIL: EVIL}))


SCRIPT = (Path(__file__).parent / "data" / "tries_explorer.js").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="needs chromium, which is not installed")
def test_a_browser_goes_from_a_point_to_its_film(tmp_path):
    scenario = scenario_of(3, description=EVIL)
    with fill(tmp_path, scenario, configuration={"scenario": EVIL}) as store:
        page = write_report(store, scenario, predict, None, film=films_of)
        critical = int(scenario.requirement.critical_runs(store.history()).sum())
    text = page.read_text(encoding="utf-8").replace("</body>", f"<script>{SCRIPT}</script></body>")
    (tmp_path / "tried.html").write_text(text, encoding="utf-8")
    drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    own = [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=390,900", "--hide-scrollbars"]
    asked = ["--virtual-time-budget=30000", "--dump-dom", f"file://{tmp_path}/tried.html"]
    command = [PROGRAM, "--headless=new", "--no-sandbox", *drawing, *own, *asked]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    answer = re.search(r'<pre id="answer">([^<]*)<', done.stdout)
    assert answer, done.stderr[-2000:]
    told = json.loads(unquote(base64.b64decode(answer.group(1)).decode()))
    assert told["errors"] == []
    assert told["loaded"] == 0, "nothing is asked from outside"
    assert told["shares"] == 0, "and no button sends anything there"
    assert told["title"] == f"Run {told['run']}: critical" != told["other"]
    assert f"run {told['run']}, critical" in told["tip"]
    assert "d_v: " in told["tip"]
    assert told["command"].endswith(f"{told['run']} --gif {told['run']}.gif")
    assert told["moves"] == 3, "slider and keys move the cars"
    assert told["brushed"] == told["filtered"] == critical < told["cleared"] == told["all"] == 110
    assert "P(critical)" in told["slice"]
    assert told["markup"] == 1, "names are text: the only bold one is the head of what hovers"
    assert told["width"] <= 500, "nothing is wider than a narrow window, which is 500 wide at least without a screen"


def test_every_text_of_a_figure_is_escaped_for_plotly():
    """`<b>m</b>` as a unit was drawn bold on the axes of the parallel coordinates."""
    written = files("sbt.report").joinpath("charts.js").read_text(encoding="utf-8")
    named = re.findall(r"(?:label|text): ([^,}]*(?:titled|name)\([^,}]*)", written)
    assert len(named) >= 3
    assert all(each.startswith("safe(") for each in named), named
