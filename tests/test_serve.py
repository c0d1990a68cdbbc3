"""The live view: who may ask, what it shows of stores in every state, stop, resume and films; and the pages in a browser."""

from __future__ import annotations

import gzip
import importlib.util
import json
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import sbt

uvicorn = pytest.importorskip("uvicorn", reason="the extra serve is not installed")

from browser import Browser  # noqa: E402
from test_accessibility import faults  # noqa: E402

from sbt.errors import InputError  # noqa: E402
from sbt.serve.app import application  # noqa: E402
from sbt.serve.campaigns import Campaigns, _heeded  # noqa: E402

TOKEN = "a-token"


class Served:
    """A server of a folder, and how to ask it."""

    def __init__(self, folder: Path):
        self.campaigns = Campaigns([folder])
        app = application(self.campaigns, token=TOKEN, hosts=frozenset({"127.0.0.1"}))
        self._server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
        self._server.capture_signals = _nothing  # a thread takes no signals
        self._thread = threading.Thread(target=self._server.run)
        self._thread.start()
        while not self._server.started:
            time.sleep(0.01)
        self.address = f"http://127.0.0.1:{self._server.servers[0].sockets[0].getsockname()[1]}"

    def close(self) -> None:
        self._server.should_exit = True
        self._thread.join()
        self.campaigns.close()

    def ask(self, path: str, *, token: str = TOKEN, post: bool = False, **headers: str) -> tuple[int, bytes]:
        """Return the status of an answer, and its content."""
        given = {"Cookie": f"sbt-token={token}", **({"x-sbt": "1"} if post else {}), **headers}
        request = urllib.request.Request(self.address + path, headers=given, method="POST" if post else "GET")
        try:
            with urllib.request.urlopen(request, timeout=120) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read()

    def json(self, path: str, **more: Any) -> Any:
        return json.loads(self.ask(path, **more)[1])

    def key(self, name: str) -> str:
        return str(next(row["key"] for row in self.json("/api/campaigns") if row["name"].endswith(name)))


class _nothing:
    def __enter__(self) -> None: ...
    def __exit__(self, *_: object) -> None: ...


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign of SUMO's that has ended, one that is damaged, and a folder that is none."""
    place = tmp_path_factory.mktemp("serve") / "runs"
    sbt.run(campaign="coverage", scenario="cut_in", budget=8, seed=1, store=str(place / "cut_in"), executor={"kind": "serial"})
    (place / "broken").mkdir()
    (place / "broken" / "campaign.sqlite").write_bytes(b"SQLite format 3\0" + b"x" * 4000)
    (place / "other").mkdir()
    return place


@pytest.fixture(scope="module")
def served(folder: Path) -> Iterator[Served]:
    server = Served(folder)
    yield server
    server.close()


def test_only_who_has_the_token_and_asks_this_machine_is_answered(served: Served) -> None:
    """Without the token 403, under a foreign name 421, a POST that a foreign page could send 403; the token becomes a cookie."""
    assert served.ask("/", token="")[0] == served.ask("/api/campaigns", token="another")[0] == 403
    assert served.ask("/", Host="evil.example")[0] == 421
    key = served.key("cut_in")
    assert served.ask(f"/api/{key}/resume", post=True, **{"x-sbt": "0"})[0] == 403
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with browser.open(f"{served.address}/?token={TOKEN}", timeout=60) as answer:  # follows the redirection
        assert "token" not in answer.url
    assert served.ask("/c/000000000000")[0] == served.ask("/c/..%2f..%2fetc")[0] == 404
    assert served.ask(f"/api/{key}/report")[0] in (404, 405)
    assert served.ask("/plotly.js", token="")[0] == 403
    assert gzip.decompress(served.ask("/plotly.js", **{"Accept-Encoding": "gzip"})[1]) == served.ask("/plotly.js")[1]


@pytest.mark.sumo
def test_stores_are_shown_in_every_state(served: Served) -> None:
    """The ended one with its counts, its runs and its report; the damaged one with what is wrong; nothing of other folders."""
    rows = {row["name"]: row for row in served.json("/api/campaigns")}
    assert set(rows) == {"runs/cut_in", "runs/broken"}
    ended = rows["runs/cut_in"]
    assert (ended["state"], ended["done"], ended["budget"], ended["report"]) == ("finished", 8, 8, True)
    assert rows["runs/broken"]["state"] == "damaged"
    assert "damaged" in rows["runs/broken"]["error"]
    data = served.json(f"/api/{ended['key']}/explorer")
    assert (data["total"], data["critical_total"]) == (8, ended["critical"])
    first = served.json(f"/api/{ended['key']}/explorer?first=1")
    assert {k: first[k] for k in ("total", "index", "sentences")} == {k: data[k] for k in ("total", "index", "sentences")}
    assert data["sentences"]
    assert b"<html" in served.ask(f"/c/{ended['key']}/report")[1]
    assert served.ask(f"/api/{rows['runs/broken']['key']}/explorer")[0] == 500


@pytest.mark.sumo
def test_films_are_made_on_demand(served: Served) -> None:
    """A run that was executed again, with its road users and lanes; a run that there is not has none, with the reason."""
    key = served.key("cut_in")
    found = served.json(f"/api/{key}/film/3")
    assert found["film"]["run"] == 3
    assert len(found["film"]["actors"]) >= 2
    assert found["lanes"]
    none = served.json(f"/api/{key}/film/99")
    assert none["film"] is None
    assert "no run 99" in none["note"]


SLOW = """
import time
from pathlib import Path
import sbt

def evaluate(values, seed):
    if (Path(__file__).parent / "hold").exists():
        time.sleep(0.4)
    return {"y": values["a"]}

SCENARIO = sbt.Scenario("slow", [sbt.Parameter("a", 0, 1)], sbt.Requirement("y", high=0.5), evaluate=evaluate)
"""


def _until(server: Served, key: str, state: str) -> Any:
    """Wait until a campaign is in a state; return what is known of it then."""
    deadline = time.monotonic() + 120
    while (found := server.json(f"/api/{key}/status"))["state"] != state:
        assert time.monotonic() < deadline, found
        time.sleep(0.1)
    return found


def test_a_campaign_is_stopped_and_resumed(tmp_path: Path) -> None:
    """It ends in order, goes on to its end, with the rows of one that was never stopped; what does not run is not stopped.

    It was begun as by a script in the background (`&`), which lets it ignore Ctrl-C.
    """
    (tmp_path / "slow.py").write_text(SLOW)
    text = {"campaign": "coverage", "scenario": "slow.py:SCENARIO", "budget": 40, "seed": 1, "executor": {"kind": "serial"}}
    (tmp_path / "slow.yaml").write_text(json.dumps(text))
    run = [sys.executable, "-m", "sbt", "run", str(tmp_path / "slow.yaml"), "--quiet", "--store", str(tmp_path / "runs" / "slow")]
    (tmp_path / "runs").mkdir()
    (tmp_path / "hold").touch()
    begin = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); os.execv(sys.argv[1], sys.argv[1:])"
    driver, server = subprocess.Popen([sys.executable, "-c", begin, *run], stdout=subprocess.DEVNULL), Served(tmp_path / "runs")
    try:
        deadline = time.monotonic() + 120
        while not (found := server.json("/api/campaigns")) or found[0]["done"] < 2:
            assert time.monotonic() < deadline, found
            time.sleep(0.1)
        key = server.key("slow")
        assert found[0]["state"] == "running"
        assert found[0]["rate"] > 0
        assert server.ask(f"/api/{key}/resume", post=True)[0] == 409
        assert server.ask(f"/api/{key}/stop", post=True)[0] == 200
        assert driver.wait(60) == 130
        stopped = _until(server, key, "interrupted")
        assert server.ask(f"/api/{key}/stop", post=True)[0] == 409
        assert stopped["done"] < 40
        (tmp_path / "hold").unlink()
        assert server.ask(f"/api/{key}/resume", post=True)[0] == 200
        assert server.ask(f"/api/{key}/resume", post=True)[0] == 409, "it is about to begin"
        assert _until(server, key, "finished")["done"] == 40
    finally:
        driver.kill()
        driver.wait()
        server.close()
    again = sbt.run(str(tmp_path / "slow.yaml"), store=str(tmp_path / "again"), report=False)
    rows = [result.frame.drop(columns="seconds") for result in (sbt.open(tmp_path / "runs" / "slow"), again)]
    assert rows[0].equals(rows[1])


@pytest.mark.sumo
@pytest.mark.parametrize("width", [1280, pytest.param(390, marks=pytest.mark.slow)])
def test_the_pages_work_in_a_browser(served: Served, width: int) -> None:
    """From the list by keyboard to a campaign, its runs, a film made on demand; no error, no request to elsewhere."""
    with Browser(width=width, dark=width < 600) as browser:
        browser.open(f"{served.address}/?token={TOKEN}")
        browser.wait("document.querySelectorAll('#campaigns tr').length === 2")
        browser.ask("[...document.querySelectorAll('#campaigns a')].find(a => a.textContent.endsWith('cut_in')).focus()")
        browser.key("Enter")
        browser.wait("window.explorer && window.Plotly && document.querySelector('[data-part=scatter] .main-svg')")
        assert "8 runs" in browser.ask("document.getElementById('numbers').textContent")
        browser.ask("document.querySelector('[data-part=film] button').click()")
        browser.wait("document.querySelector('[data-part=film] canvas')")
        assert browser.ask("document.documentElement.scrollWidth") <= width
        if width < 600 and importlib.util.find_spec("axe_core_python") is not None:
            assert faults(browser) == []
            browser.open(served.address)
            browser.wait("document.querySelectorAll('#campaigns tr').length === 2")
            assert faults(browser) == []
        assert browser.errors == []
        assert {url.split("/")[2] for url in browser.requests if url.startswith("http")} == {served.address.split("/")[2]}


@pytest.mark.sumo
@pytest.mark.parametrize(("handlers", "heeded"), [
    ("", signal.SIGINT), ("signal.signal(signal.SIGINT, signal.SIG_IGN)", None),
    ("signal.signal(signal.SIGINT, signal.SIG_IGN); signal.signal(signal.SIGTERM, lambda *_: sys.exit())", signal.SIGTERM),
])  # fmt: skip
def test_a_process_is_sent_the_signal_that_it_heeds(handlers: str, heeded: signal.Signals | None) -> None:
    script = f"import signal, sys, time\n{handlers}\nprint(flush=True)\ntime.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            if heeded is None:
                with pytest.raises(InputError, match="must heed a signal"):
                    _heeded(process.pid)
            else:
                assert _heeded(process.pid) == heeded
        finally:
            process.kill()


def test_a_report_can_be_looked_at_and_asks_for_nothing(served: Served, folder: Path) -> None:
    """A report comes with a store, maybe somebody else's: its scripts draw, and reach neither the view nor its campaigns."""
    asked = "fetch('/api/campaigns').then(() => window.got = 'all', () => window.got = 'nothing')"
    report = folder / "cut_in" / "report.html"
    whole = report.read_text(encoding="utf-8")
    with Browser() as browser:
        browser.open(f"{served.address}/?token={TOKEN}")
        browser.open(f"{served.address}/c/{served.key('cut_in')}/report")
        browser.wait("window.explorer && document.querySelector('[data-part=scatter] .main-svg')")
        assert browser.errors == []
        try:
            report.write_text(whole.replace("</body>", f"<script>window.got = ''; {asked}</script></body>"), encoding="utf-8")
            browser.open(f"{served.address}/c/{served.key('cut_in')}/report?again")
            browser.wait("window.got")
            assert browser.ask("window.got") == "nothing"
            report.rename(folder / "elsewhere.html")
            report.symlink_to(folder / "elsewhere.html")
            assert served.ask(f"/c/{served.key('cut_in')}/report")[0] == 404
        finally:
            report.unlink()
            report.write_text(whole, encoding="utf-8")
            (folder / "elsewhere.html").unlink(missing_ok=True)
