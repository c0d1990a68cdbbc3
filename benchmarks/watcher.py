"""What recording costs: a run of this package against a bare loop of `simulationStep` over the same files.

    python benchmarks/watcher.py [--repeats 5] [--vehicles 1000] [--only city]

`city`: a grid with that many vehicles at once; `rail`: a line with two trains, on which SUMO itself has nearly nothing to do.
Both loops load SUMO once more and make the same steps; loading is left out. CPU time of the process, loops alternating.
"""

from __future__ import annotations

import argparse
import re
import statistics
import tempfile
import time
from pathlib import Path

import libsumo
import street_traffic as street

from sbt.sumo import user_simulation
from sbt.sumo.ego_vehicle import EgoVehicle
from sbt.sumo.files import SumoFiles
from sbt.sumo.recorder import RecordingSettings
from sbt.sumo.user_simulation import UserSimulation

STEP, DURATION = 0.1, 10.0


def city(folder: Path, vehicles: int) -> tuple[Path, Path]:
    """Make a grid and vehicles that all depart at once."""
    net = street.grid(folder, number=9, length=150.0)
    (made,) = street.traffic(net, 1, float(vehicles), {"car": 1.0})
    head, trips = re.sub(r'depart="[\d.]+"', 'depart="0.00"', made.read_text()).split("<trip ", 1)
    made.write_text(head + trips_with_ego("<trip " + trips))
    return net, made


def trips_with_ego(trips: str) -> str:
    """Return trips with the ego before all others, on the edges of the first."""
    edges = re.search(r'from="[^"]+" to="[^"]+"', trips)
    if edges is None:
        raise SystemExit("randomTrips made no trip")
    return f'<trip id="ego" type="car" depart="0.00" departPos="random_free" {edges.group()}/>\n{trips}'


def rail(folder: Path, vehicles: int) -> tuple[Path, Path]:
    """Make a railway of 20 km with two trains beside each other."""
    nodes = "".join(f'<node id="n{k}" x="{5000 * k}" y="0"/>' for k in range(5))
    edges = "".join(f'<edge id="e{k}" from="n{k}" to="n{k + 1}" allow="rail" speed="44" numLanes="2"/>' for k in range(4))
    (folder / "r.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "r.edg.xml").write_text(f"<edges>{edges}</edges>")
    net, routes = folder / "rail.net.xml", folder / "rail.rou.xml"
    street.call(street.tool("netconvert"), "-n", str(folder / "r.nod.xml"), "-e", str(folder / "r.edg.xml"), "-o", str(net))
    kind = '<vType id="train" vClass="rail" length="200" maxSpeed="44"/><route id="all" edges="e0 e1 e2 e3"/>'
    start = 'type="train" route="all" depart="0" departPos="1100" departSpeed="30"'
    trains = f'<vehicle id="ego" {start} departLane="0"/><vehicle id="other" {start} departLane="1"/>'
    routes.write_text(f"<routes>{kind}{trains}</routes>")
    return net, routes


def bare(files: SumoFiles, steps: int) -> float:
    """Return the CPU time of a loop that only steps (s)."""
    libsumo.load(files.launch({}, Path(), None).command(1))
    start = time.process_time()
    for _ in range(steps):
        libsumo.simulationStep()
    return time.process_time() - start


def watched(simulation: UserSimulation) -> tuple[float, int, int, int]:
    """Return the CPU time of a recorded run from its first step on (s), its steps, road users recorded, and vehicles there."""
    begun: list[float] = []
    start_files = user_simulation.TraciProxy.start_files

    def started(proxy, files):
        start_files(proxy, files)
        begun.append(time.process_time())

    user_simulation.TraciProxy.start_files = started
    try:
        trace = simulation({}, 1)
        taken = time.process_time() - begun[0]
    finally:
        user_simulation.TraciProxy.start_files = start_files
    steps = round(libsumo.simulation.getTime() / STEP)
    return taken, steps, len(trace.actors), libsumo.vehicle.getIDCount()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--only", nargs="+", choices=("city", "rail"), default=("city", "rail"))
    options = parser.parse_args()
    columns = ("scenario", "vehicles at the end", "recorded", "steps", "bare, us a step", "watched", "ratio (least, most)")
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for make in (m for m in (city, rail) if m.__name__ in options.only):
            net, routes = make(Path(folder), options.vehicles)
            named = {"net-file": str(net), "route-files": str(routes), "step-length": str(STEP), "no-warnings": "true"}
            files = SumoFiles.of(named, Path(folder), "benchmark")
            simulation = UserSimulation(RecordingSettings(EgoVehicle("ego", may_leave=True), DURATION), files)
            simulation.prepare()
            watched(simulation)
            pairs = []
            for _ in range(options.repeats):
                taken, steps, recorded, there = watched(simulation)
                pairs.append((taken, bare(files, steps)))
            ratios = [a / b for a, b in pairs]
            taken, least = (1e6 * statistics.median(column) / steps for column in zip(*pairs, strict=True))
            span = f"{statistics.median(ratios):.2f} ({min(ratios):.2f}, {max(ratios):.2f})"
            print(f"| {make.__name__} | {there:,} | {recorded} | {steps} | {least:.0f} | {taken:.0f} | {span} |", flush=True)


if __name__ == "__main__":
    main()
