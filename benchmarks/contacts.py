"""Contacts in random traffic against SUMO's own list: what is confirmed, and why the rest is not.

    python benchmarks/contacts.py --runs 2000 [--nets grid random roundabout] [--rows rows.jsonl]

Networks by netgenerate and netconvert (a grid with traffic lights, a random one with bends and with bridges that have no
heights, a roundabout), traffic by randomTrips: cars, trucks, semitrailers, buses, bicycles, pedestrians; half of the runs with
careless drivers. Every run has another ego. A run with a contact is simulated once more by a bare loop that asks SUMO for
its list in every step and knows nothing of this package: a confirmed contact must be in it, an unconfirmed one must not.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import libsumo
import street_traffic as street

from sbt import RunError
from sbt.metrics.longitudinal import COLLISION
from sbt.metrics.pairwise import in_traffic
from sbt.problem.outcome import LISTED_ONLY
from sbt.sumo.contacts import CONFIRMED_WITHIN
from sbt.sumo.ego_vehicle import EgoVehicle
from sbt.sumo.files import SumoFiles
from sbt.sumo.recorder import RecordingSettings
from sbt.sumo.user_simulation import UserSimulation

NETS = {
    "grid": (street.grid, {"car": 0.7, "truck": 6, "trailer": 12, "bus": 6, "bicycle": 3, "person": 2}),
    "random": (street.bends_and_bridges, {"car": 0.7, "truck": 5, "trailer": 10, "bus": 5, "bicycle": 3, "person": 3}),
    "roundabout": (street.roundabout, {"car": 2, "truck": 9, "trailer": 15, "bus": 9, "bicycle": 6}),
}
REASONS = {
    "side by side across lanes": r"side by side on lanes",
    "oncoming, across the middle": r"oncoming, across",
    "roads at a junction": r"on different roads at a junction",
    "lanes of a junction that do not conflict": r"knows no conflict",
    "shapes with corners cut off, in a junction": r"SUMO's shapes \(cars",
    "in a junction and beside it": r"beside it, and SUMO compares a junction",
    "rear beside another lane": r"the rear of one reaches back",
    "roads without a common junction": r"share no junction",
    "pedestrian on an edge": r"walks on edge",
    "pedestrian on a walking area": r"is on the walking area",
    "pedestrian at a crossing": r"SUMO compares a crossing",
    "a gap along the lane": r"SUMO sees a gap",
    "not sideways on one lane": r"into each other and",
    "off the lanes": r"is on no lane|moved by poses",
}
STEP, DEPARTURES, DURATION = 0.1, 30.0, 25.0


def scenarios(folder: Path, net: str, runs: int) -> Iterator[tuple[list[Path], Path, str, int, bool]]:
    """Yield route files, network, ego and seed of runs."""
    make, periods = NETS[net]
    (folder / net).mkdir(exist_ok=True)
    file, done, seed = make(folder / net), 0, 0
    while done < runs:
        careless = seed % 2 == 1
        routes = street.traffic(file, seed, DEPARTURES, periods, careless=careless)
        texts = "".join(route.read_text() for route in routes if ".person." not in route.name)
        egos = re.findall(r'<trip id="(\w+)"', texts)
        for ego in egos:
            if done < runs:
                yield routes, file, ego, seed, careless
                done += 1
        seed += 1


def listed(files: SumoFiles, seed: int, ego: str, until: float) -> set[tuple[str, float]]:
    """Return what a bare loop finds in SUMO's list: with whom the ego collides, and when (s since its departure)."""
    libsumo.load(files.launch({}, Path(), None).command(seed))
    found, departed = set(), None
    while departed is None or libsumo.simulation.getTime() - departed < until:
        libsumo.simulationStep()
        now = libsumo.simulation.getTime()
        if ego in libsumo.simulation.getDepartedIDList():
            departed = now
        for c in libsumo.simulation.getCollisions():
            if ego in (c.collider, c.victim) and departed is not None:
                found.add((c.victim if c.collider == ego else c.collider, now - departed))
    return found


def judged(folder: Path, net: str, runs: int) -> Iterator[dict[str, Any]]:
    """Yield what every run found."""
    for routes, file, ego, seed, careless in scenarios(folder, net, runs):
        named = {"net-file": str(file), "route-files": ",".join(map(str, routes)), "step-length": str(STEP)}
        named |= {"no-warnings": "true", "ignore-route-errors": "true"}
        files = SumoFiles.of(named, folder, "benchmark")
        simulation = UserSimulation(RecordingSettings(EgoVehicle(ego, may_leave=True), DURATION, wait=60.0), files)
        row: dict[str, Any] = {"net": net, "careless": careless, "ego": ego, "seed": seed}
        try:
            trace = simulation({}, seed)
        except RunError as error:
            yield row | {"status": str(error.status), "reason": error.reason}
            continue
        row["straight"] = trace.ended != "collision" and in_traffic(COLLISION, ego)(replace(trace, parts={})) == 1.0
        row |= {"status": "ok", "ended": trace.ended, "unconfirmed": list(trace.unconfirmed), "listed": list(trace.reported)}
        if trace.ended == "collision" or trace.unconfirmed:
            end = float(trace.time[-1])
            last = end + CONFIRMED_WITHIN + 0.5 * STEP
            bare = {who for who, t in listed(files, seed, ego, last) if t >= end - CONFIRMED_WITHIN - 1e-6}
            texts = [text for text in trace.unconfirmed if not text.startswith(LISTED_ONLY)]
            told = {re.findall(r"with '([^']*)'", text)[0] for text in texts}
            row |= {"bare": sorted(bare), "told": sorted(told)}
        yield row


def reason_of(text: str) -> str:
    return next((name for name, pattern in REASONS.items() if re.search(pattern, text)), "unexplained")


def table(rows: list[dict[str, Any]]) -> str:
    """Return the counts of all networks."""
    nets = list(dict.fromkeys(row["net"] for row in rows))
    counts: dict[str, Counter[str]] = {net: Counter() for net in nets}
    reasons: dict[str, Counter[str]] = {net: Counter() for net in nets}
    for row in rows:
        count = counts[row["net"]]
        count["runs"] += 1
        count[row["status"]] += 1
        if row["status"] != "ok":
            continue
        texts = [text for text in row["unconfirmed"] if not text.startswith(LISTED_ONLY)]
        count["touched by a straight rectangle only"] += row["straight"]
        count["SUMO lists, bodies do not touch"] += len(row["unconfirmed"]) - len(texts)
        reasons[row["net"]].update(map(reason_of, texts))
        if row["ended"] == "collision":
            count["contacts"] += 1
            count["unconfirmed" if texts else "confirmed"] += 1
            if not texts:
                count["confirmed, but not in the bare list"] += not row["bare"]
            else:
                count["unconfirmed, but in the bare list"] += bool(set(row["told"]) & set(row["bare"]))
    lines = ["| | " + " | ".join(nets) + " | all |", "|---|" + "---|" * (len(nets) + 1)]
    names = ["runs", "invalid", "failed", "contacts", "confirmed", "confirmed, but not in the bare list", "unconfirmed",
             "unconfirmed, but in the bare list", "SUMO lists, bodies do not touch",
             "touched by a straight rectangle only"]  # fmt: skip
    for name in names:
        values = [counts[net][name] for net in nets]
        lines.append(f"| {name} | " + " | ".join(map(str, [*values, sum(values)])) + " |")
    for name in [*REASONS, "unexplained"]:
        values = [reasons[net][name] for net in nets]
        if sum(values) or name == "unexplained":
            lines.append(f"| unconfirmed: {name} | " + " | ".join(map(str, [*values, sum(values)])) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--nets", nargs="+", choices=NETS, default=list(NETS))
    parser.add_argument("--rows", type=Path, help="write a line of JSON a run")
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for net in options.nets:
            share = options.runs // len(options.nets) + (net == options.nets[0]) * (options.runs % len(options.nets))
            for row in judged(Path(folder), net, share):
                rows.append(row)
                if options.rows is not None:
                    with options.rows.open("a") as file:
                        file.write(json.dumps(row) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
