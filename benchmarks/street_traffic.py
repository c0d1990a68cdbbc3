"""Networks and mixed traffic made by SUMO's own tools, for the benchmarks of the recorder: `contacts.py` and `watcher.py`."""

from __future__ import annotations

import math
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import numpy as np

TYPES = {
    "car": 'vClass="passenger" length="4.6" width="1.8"',
    "truck": 'vClass="truck" length="10" width="2.5"',
    "trailer": 'vClass="trailer" length="16.5" width="2.5"',
    "bus": 'vClass="bus" length="12" width="2.5"',
    "bicycle": 'vClass="bicycle" length="1.6" width="0.65"',
}
CARELESS = 'minGap="0.5" tau="0.4" sigma="0.8" jmIgnoreFoeProb="0.5" jmIgnoreFoeSpeed="20" jmIgnoreKeepClearTime="1"'
"""Driving that causes collisions of all kinds."""


def tool(name: str) -> str:
    """Return a program of SUMO, or the path of a script among its tools."""
    import sumo

    home = Path(sumo.SUMO_HOME)
    found = home / "tools" / name if name.endswith(".py") else home / "bin" / name
    return str(found)


def call(*command: str, folder: Path | None = None) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")


def grid(folder: Path, number: int = 3, lanes: int = 2, length: float = 120.0) -> Path:
    """Make a grid with traffic lights, pavements and crossings."""
    net = folder / "grid.net.xml"
    call(tool("netgenerate"), "--grid", "--grid.number", str(number), "--grid.length", str(length), "-L", str(lanes),
         "--default-junction-type", "traffic_light", "--sidewalks.guess", "--crossings.guess", "--turn-lanes", "1",
         "--turn-lanes.length", "25", "-o", str(net))  # fmt: skip
    return net


def bends_and_bridges(folder: Path, seed: int = 3, bridges: int = 4, iterations: int = 24) -> Path:
    """Make a random network, bend its edges, and lead long roads over it without junctions or heights."""
    plain = folder / "plain"
    call(tool("netgenerate"), "--rand", "--rand.iterations", str(iterations), "--rand.min-distance", "60", "--rand.max-distance",
         "150", "--seed", str(seed), "--default-junction-type", "priority", "--sidewalks.guess", "--crossings.guess",
         "--plain-output-prefix", str(plain))  # fmt: skip
    rng = np.random.default_rng(seed)
    nodes = {n.get("id"): (float(n.get("x", 0)), float(n.get("y", 0))) for n in ET.parse(f"{plain}.nod.xml").iter("node")}
    edges = ET.parse(f"{plain}.edg.xml")
    root, bent = edges.getroot(), {}
    for edge in root.iter("edge"):
        a, b = str(edge.get("from")), str(edge.get("to"))
        (ax, ay), (bx, by) = nodes[a], nodes[b]
        key = (min(a, b), max(a, b))
        bent.setdefault(key, rng.uniform(-0.2, 0.2))
        push = bent[key] * (1 if a == key[0] else -1)  # both directions along the same curve
        shape = [(ax + t * (bx - ax) - push * math.sin(math.pi * t) * (by - ay), ay + t * (by - ay)
                  + push * math.sin(math.pi * t) * (bx - ax)) for t in np.linspace(0, 1, 9)]  # fmt: skip
        edge.set("shape", " ".join(f"{x:.2f},{y:.2f}" for x, y in shape))
    far = sorted(((math.dist(nodes[a], nodes[b]), a, b) for a in nodes for b in nodes if a < b), reverse=True)
    for k in range(bridges):
        _, a, b = far[k * 3]
        for start, end in ((a, b), (b, a)):
            ET.SubElement(root, "edge", {"id": f"bridge{k}{start}", "from": start, "to": end, "numLanes": "1", "speed": "19.44"})
    edges.write(f"{plain}.edg.xml")
    net = folder / "random.net.xml"
    call(tool("netconvert"), "-n", f"{plain}.nod.xml", "-e", f"{plain}.edg.xml", "-o", str(net), "--sidewalks.guess",
         "--crossings.guess", "--no-warnings", "true")  # fmt: skip
    return net


def roundabout(folder: Path, radius: float = 14.0, arms: int = 4, lanes: int = 1) -> Path:
    """Make a roundabout with bent lanes, on which long vehicles turn tightly."""
    n = 2 * arms
    at = [(radius * math.cos(2 * math.pi * k / n), radius * math.sin(2 * math.pi * k / n)) for k in range(n)]
    nodes = [f'<node id="r{k}" x="{x:.2f}" y="{y:.2f}" type="priority"/>' for k, (x, y) in enumerate(at)]
    edges = []
    for k in range(n):
        angles = [2 * math.pi * (k + t) / n for t in np.linspace(0, 1, 5)]
        shape = " ".join(f"{radius * math.cos(a):.2f},{radius * math.sin(a):.2f}" for a in angles)
        ends = f'from="r{k}" to="r{(k + 1) % n}"'
        edges.append(f'<edge id="ring{k}" {ends} numLanes="{lanes}" speed="8.33" priority="9" shape="{shape}"/>')
    for arm in range(arms):
        x, y = math.cos(2 * math.pi * (arm + 0.25) / arms), math.sin(2 * math.pi * (arm + 0.25) / arms)
        nodes.append(f'<node id="a{arm}" x="{110 * x:.2f}" y="{110 * y:.2f}"/>')
        edges.append(f'<edge id="out{arm}" from="r{2 * arm}" to="a{arm}" numLanes="{lanes}" speed="13.89" priority="1"/>')
        edges.append(f'<edge id="in{arm}" from="a{arm}" to="r{2 * arm + 1}" numLanes="{lanes}" speed="13.89" priority="1"/>')
    (folder / "r.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
    (folder / "r.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    net = folder / "roundabout.net.xml"
    parts = ("-n", str(folder / "r.nod.xml"), "-e", str(folder / "r.edg.xml"))
    call(tool("netconvert"), *parts, "-o", str(net), "--no-warnings", "true")
    return net


def traffic(net: Path, seed: int, end: float, periods: dict[str, float], *, careless: bool = False) -> list[Path]:
    """Make a file of trips for every kind of road user; the period is the time between two departures (s)."""
    made = []
    for kind, period in periods.items():
        stem = net.parent / f"{net.name.partition('.')[0]}.{seed}.{'careless.' if careless else ''}{kind}"
        route = Path(f"{stem}.rou.xml")
        more: Sequence[str] = ("--pedestrians",) if kind == "person" else (
            "--edge-permission", "bicycle" if kind == "bicycle" else "passenger")
        options = ["--seed", str(seed + 31 * len(made)), "-b", "0", "-e", f"{end:g}", "-p", f"{period:g}", "--prefix", f"{kind}_"]
        if kind != "person":
            options += ["--trip-attributes", f'departLane="best" departPos="random_free" departSpeed="max" type="{kind}"']
        call(sys.executable, tool("randomTrips.py"), "-n", str(net), "-o", str(route), *options, *more, folder=net.parent)
        text = route.read_text()
        kinds = "" if kind == "person" else f'<vType id="{kind}" {TYPES[kind]} {CARELESS if careless else ""}/>'
        head, tail = text.split("<routes", 1)
        attributes, body = tail.split(">", 1)
        body = "\n".join(line for line in body.splitlines() if "<vType" not in line)
        route.write_text(f"{head}<routes{attributes}>{kinds}{body}")
        made.append(route)
    return made
