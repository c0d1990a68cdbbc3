"""Five simulations as people bring them: made with SUMO's programs, with traffic that comes and goes."""

# ruff: noqa: E501  (networks, an edge a line)

from __future__ import annotations

import gzip
import os
import random
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

_TYPES = """<vType id="truck" vClass="truck" length="12" width="2.5"/><vType id="bus" vClass="bus" length="12" width="2.5"/>
  <vType id="bike" vClass="bicycle"/>"""
_YAML = """sumo: my.sumocfg
inputs: {{{input}}}
ego: {{id: {ego}, may_leave: true}}
duration: {duration}
metrics: [ttc_path_min, distance_min, collision]
requirement: {{metric: {metric}, critical: [-.inf, 0.5]}}
"""


def program(name: str) -> str:
    """Return one of SUMO's programs, or skip the test."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed (pip install 'sumo-sbt[tools]')")
    return found


def run_program(folder: Path, name: str, *options: str) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "SUMO_HOME"}
    subprocess.run([program(name), *options], cwd=folder, check=True, capture_output=True, env=environment)


def _write(folder: Path, traffic: str, value: str, *, types: str = _TYPES, ego: str = "ego", more: str = "", duration: float = 8, options: str = "", metric: str = "ttc_path_min") -> Path:
    """Write routes, configuration and scenario."""
    (folder / "my.rou.xml").write_text(f"<routes>\n  {types}\n{traffic}</routes>\n")
    files = f'<net-file value="net.net.xml"/><route-files value="my.rou.xml"/>{more}'
    (folder / "my.sumocfg").write_text(f"<configuration><input>{files}</input>{options}</configuration>\n")
    (folder / "scenario.yaml").write_text(_YAML.format(input=value, ego=ego, duration=duration, metric=metric))
    return folder / "scenario.yaml"


def _cars(n: int, edges: Callable[[random.Random], tuple[str, str]], *, every: float, seed: int, kinds: str = "") -> str:
    rng, lines = random.Random(seed), []
    for k in range(n):
        start, end = edges(rng)
        kind = f'type="{rng.choice(kinds.split())}" ' if kinds and rng.random() < 0.3 else ""
        lines.append(f'  <trip id="c{k}" {kind}depart="{k * every:.2f}" from="{start}" to="{end}" departLane="best" departSpeed="max"/>\n')
    return "".join(lines)


def grid(folder: Path) -> Path:
    """Traffic lights, cars, trucks and buses; gzipped routes from the additional file, and a detector."""
    run_program(folder, "netgenerate", "--grid", "--grid.number", "5", "--grid.length", "120", "--tls.guess", "-L", "2", "-o", "net.net.xml")

    def across(rng: random.Random) -> tuple[str, str]:
        i, j = rng.randrange(5), rng.randrange(5)
        return rng.choice([(f"A{i}B{i}", f"D{j}E{j}"), (f"E{i}D{i}", f"B{j}A{j}"), (f"{'ABCDE'[i]}0{'ABCDE'[i]}1", f"{'ABCDE'[j]}3{'ABCDE'[j]}4")])

    ego = '  <trip id="ego" depart="60" from="A2B2" to="D2E2" departSpeed="${speed}"/>\n'
    path = _write(folder, ego, types="", value="speed: {min: 2, max: 13, unit: m/s}", more='<additional-files value="more.add.xml,traffic.rou.xml.gz"/>', metric="distance_min")
    with gzip.open(folder / "traffic.rou.xml.gz", "wt") as file:
        file.write(f"<routes>\n{_cars(110, across, every=0.6, seed=2, kinds='truck bus')}</routes>\n")
    (folder / "more.add.xml").write_text(
        f'<additional>\n  {_TYPES}\n  <inductionLoop id="loop" lane="A2B2_0" pos="50" period="10" file="loop_${{speed}}.xml"/>\n'
        '  <edgeData id="means" file="means.xml"/>\n</additional>\n'
    )
    return path


_ROUNDABOUT = [("n", 0, 20), ("w", -20, 0), ("s", 0, -20), ("e", 20, 0), ("N", 0, 150), ("W", -150, 0), ("S", 0, -150), ("E", 150, 0)]


def roundabout(folder: Path) -> Path:
    """Four arms, cars from all of them, long trucks in bends and bicycles."""
    nodes = "".join(f'<node id="{name}" x="{x}" y="{y}"/>' for name, x, y in _ROUNDABOUT)
    corner = {"nw": (-14.1, 14.1), "ws": (-14.1, -14.1), "se": (14.1, -14.1), "en": (14.1, 14.1)}
    edges = "".join(
        f'<edge id="{a}{b}" from="{a}" to="{b}" speed="8" spreadType="center" shape="'
        + " ".join(f"{x},{y}" for x, y in ([p for n, *p in _ROUNDABOUT if n == a] + [list(corner[a + b])] + [p for n, *p in _ROUNDABOUT if n == b]))
        + '"/>'
        for a, b in ("nw", "ws", "se", "en")
    ) + "".join(f'<edge id="in{a}" from="{a.upper()}" to="{a}" speed="14"/><edge id="out{a}" from="{a}" to="{a.upper()}" speed="14"/>' for a in "nwse")
    (folder / "r.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "r.edg.xml").write_text(f'<edges>{edges}<roundabout nodes="n w s e" edges="nw ws se en"/></edges>')
    run_program(folder, "netconvert", "-n", "r.nod.xml", "-e", "r.edg.xml", "-o", "net.net.xml")

    def arms(rng: random.Random) -> tuple[str, str]:
        start, end = rng.sample("nwse", 2)
        return f"in{start}", f"out{end}"

    ego = '  <trip id="ego" depart="20.5" from="ins" to="outn" departSpeed="${speed}" departPos="60"/>\n'
    cars = _cars(14, arms, every=1.45, seed=5, kinds="truck bike")
    later = _cars(20, arms, every=1.5, seed=6, kinds="truck bike").replace('id="c', 'id="d').replace('depart="', 'depart="2')
    first, rest = later.split("\n", 1)  # what departs before ego stands before it: SUMO leaves out what is not sorted
    return _write(folder, cars + first + "\n" + ego + rest, "speed: {min: 4, max: 12, unit: m/s}", duration=9)


def bridges(folder: Path) -> Path:
    """A random network, and a motorway above it that meets no junction; numbers as names, the ego among them."""
    run_program(folder, "netgenerate", "--rand", "--rand.iterations", "30", "--rand.max-distance", "130", "--seed", "5",
                "--plain-output-prefix", "p", "-o", "flat.net.xml")
    nodes, edges = (folder / "p.nod.xml").read_text(), (folder / "p.edg.xml").read_text()
    spots = [line.split('x="')[1].split('"')[0] + "," + line.split('y="')[1].split('"')[0] for line in nodes.splitlines() if "<node " in line]
    x, y = (sorted(float(s.split(",")[k]) for s in spots) for k in (0, 1))
    middle = 0.5 * (y[0] + y[-1])
    (folder / "p.nod.xml").write_text(nodes.replace("</nodes>", "".join(
        f'<node id="{name}" x="{at}" y="{middle}" z="8"/>' for name, at in (("west", x[0] - 100), ("east", x[-1] + 100))) + "</nodes>"))  # fmt: skip
    (folder / "p.edg.xml").write_text(edges.replace("</edges>",
        '<edge id="over" from="west" to="east" numLanes="2" speed="33"/><edge id="under" from="east" to="west" numLanes="2" speed="33"/></edges>'))  # fmt: skip
    run_program(folder, "netconvert", "-n", "p.nod.xml", "-e", "p.edg.xml", "-x", "p.con.xml", "-o", "net.net.xml",
                *(("-i", "p.tll.xml") if (folder / "p.tll.xml").exists() else ()))  # fmt: skip
    below = [part.split('"')[0] for part in edges.split('<edge id="')[1:]]

    def random_edges(rng: random.Random) -> tuple[str, str]:
        return ("over", "over") if rng.random() < 0.3 else tuple(rng.sample(below, 2))  # type: ignore[return-value]

    trips = _cars(90, random_edges, every=0.5, seed=3).replace('id="c', 'id="')
    return _write(folder, '  <vType id="DEFAULT_VEHTYPE" sigma="${sigma}"/>\n' + trips, "sigma: {min: 0, max: 1}", ego="'45'", duration=8,
                  options='<processing><ignore-route-errors value="true"/></processing>')  # fmt: skip


def crossing(folder: Path) -> Path:
    """Pavements and zebra crossings, people on them, bicycles, flows."""
    run_program(folder, "netgenerate", "--grid", "--grid.number", "3", "--grid.length", "90", "--sidewalks.guess", "--crossings.guess",
                "--bikelanes.guess", "-o", "net.net.xml")  # fmt: skip
    rng = random.Random(1)
    people = "".join(
        f'  <person id="p{k}" depart="{k * 0.7:.1f}" departPos="{rng.uniform(0, 60):.0f}"><walk from="{a}" to="{b}"/></person>\n'
        for k, (a, b) in enumerate(rng.choice([("A1B1", "B1B2"), ("B2B1", "B1B0"), ("B0B1", "B1B2"), ("C1B1", "B1B0")]) for _ in range(30))
    )
    flows = "".join(
        f'  <flow id="{name}" type="{kind}" begin="0" end="60" period="{period}" from="{a}" to="{b}" departSpeed="max"/>\n'
        for name, kind, period, a, b in (("f", "DEFAULT_VEHTYPE", 6, "A1B1", "B1C1"), ("b", "bike", 5, "B0B1", "B1B2"), ("g", "DEFAULT_VEHTYPE", 7, "C1B1", "B1A1"))
    )
    ego = '  <trip id="ego" depart="20" from="B0B1" to="B1B2" departSpeed="${speed}" departPos="10"/>\n'
    lines = sorted((people + flows + ego).splitlines(keepends=True), key=lambda line: float((line.split('depart="')[-1] if "depart=" in line else "0").split('"')[0]))
    return _write(folder, "".join(lines), "speed: {min: 3, max: 12, unit: m/s}", duration=9, metric="distance_min")


def merge(folder: Path) -> Path:
    """A motorway with an entry, dense flows, the ego on the ramp driven by a controller."""
    (folder / "m.nod.xml").write_text(
        '<nodes><node id="a" x="0" y="0"/><node id="b" x="500" y="0"/><node id="c" x="750" y="0"/><node id="d" x="1500" y="0"/>'
        '<node id="r" x="150" y="-70"/></nodes>'
    )
    (folder / "m.edg.xml").write_text(
        '<edges><edge id="up" from="a" to="b" numLanes="2" speed="33"/><edge id="acc" from="b" to="c" numLanes="3" speed="33"/>'
        '<edge id="down" from="c" to="d" numLanes="2" speed="33"/><edge id="ramp" from="r" to="b" numLanes="1" speed="22"/></edges>'
    )
    run_program(folder, "netconvert", "-n", "m.nod.xml", "-e", "m.edg.xml", "--ramps.guess", "-o", "net.net.xml")
    flows = "".join(
        f'  <flow id="{name}" type="{kind}" begin="0" end="90" vehsPerHour="{flow}" from="up" to="down" departSpeed="desired" departLane="{lane}"/>\n'
        for name, kind, flow, lane in (("left", "DEFAULT_VEHTYPE", "${flow}", 1), ("right", "truck", 400, 0), ("cars", "DEFAULT_VEHTYPE", 600, 0))
    )
    ego = '  <trip id="ego" depart="30" from="ramp" to="down" departSpeed="20" departPos="60"/>\n'
    path = _write(folder, flows + ego, "flow: {min: 400, max: 1500, kind: integer, unit: 1/h}", duration=9)
    path.write_text(path.read_text().replace("may_leave: true", "may_leave: true, kind: acc_aeb"))
    return path


FIVE = {f.__name__: f for f in (grid, roundabout, bridges, crossing, merge)}
