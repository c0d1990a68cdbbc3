"""What does it spare to warm up traffic once? CPU time of runs from snapshots, of fresh ones and of SUMO's stepping alone.

    python benchmarks/snapshots.py [--grid 28] [--departures 1300] [--warm-up 300] [--runs 50] [--fresh 3]

Makes a grid with netgenerate (2 lanes, edges of 150 m, lights), traffic with a distribution of drivers, and an ego that departs
at its end, with two inputs; runs last 10 s at steps of 0.1 s. Times are CPU seconds of this process and its children.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from sbt.execution.spec import ScenarioSpec
from sbt.execution.tasks import elsewhere
from sbt.problem.isolation import SNAPSHOT, warm_ups
from sbt.problem.trace import Trace
from sbt.seeds import run_seed
from sbt.sumo.forking import in_fork
from sbt.sumo.session import session
from sbt.sumo.user_simulation import UserSimulation

TYPES = '<vTypeDistribution id="drivers"><vType id="usual" sigma="0.5" speedFactor="normc(1,0.1,0.2,2)" probability="0.8"/>\
<vType id="slow" sigma="0.8" maxSpeed="10" probability="0.2"/></vTypeDistribution>'
POINTS = [{"accel": 2.0, "tau": 1.2}, {"accel": 1.1, "tau": 0.6}, {"accel": 2.9, "tau": 1.9}]


def cpu() -> float:
    return sum(os.times()[:4])


def scenario(folder: Path, grid: int, departures: int, warm_up: float) -> Path:
    """Write network, traffic and scenario."""
    words = f"--grid --grid.number {grid} --grid.length 150 -L 2 --tls.guess --seed 1".split()
    program = shutil.which("netgenerate") or "netgenerate"
    subprocess.run([program, *words, "-o", str(folder / "grid.net.xml")], check=True, capture_output=True)
    net = (folder / "grid.net.xml").read_text()
    names = sorted({word.split('"')[0] for word in net.split('<edge id="')[1:] if not word.startswith(":")})
    rng = random.Random(1)
    times = sorted(rng.uniform(0, warm_up + 12) for _ in range(departures))
    trips = (f'<trip id="t{k}" type="drivers" depart="{t:.2f}" from="{rng.choice(names)}" to="{rng.choice(names)}"/>'
             for k, t in enumerate(times))  # fmt: skip
    (folder / "traffic.rou.xml").write_text(f"<routes>{TYPES}\n" + "\n".join(trips) + "\n</routes>")
    (folder / "ego.rou.xml").write_text(
        f'<routes><vType id="av" sigma="0" tau="${{tau}}" accel="${{accel}}"/><trip id="ego" type="av" depart="{warm_up:g}" '
        f'from="{names[len(names) // 2]}" to="{names[0]}" departSpeed="0" departLane="free"/></routes>'
    )
    (folder / "scenario.yaml").write_text(
        "sumo: {net: grid.net.xml, routes: [traffic.rou.xml, ego.rou.xml]}\nego: {id: ego, delay: 30}\nduration: 10\n"
        "inputs: {accel: {min: 1, max: 3}, tau: {min: 0.5, max: 2}}\nmetrics: [ttc_path_min]\n"
        "requirement: {metric: ttc_path_min, critical: [-.inf, 1.0]}\n"
    )
    return folder / "scenario.yaml"


def simulation(path: str, isolation: str) -> UserSimulation:
    found = ScenarioSpec(path, isolation=isolation).resolve().simulate
    if not isinstance(found, UserSimulation):
        raise TypeError("a scenario of one's own files was written")
    return found


def alone(path: str, seeds: int, jobs: list[tuple[dict[str, float], int]]) -> list[Trace]:
    """Run in a process that warms up and loads everything itself."""
    found = simulation(path, SNAPSHOT)
    own = found.isolated(replace(found.isolation, seeds=seeds, forking=False))
    return [own(values, seed) for values, seed in jobs]


def stepping(found: UserSimulation, seconds: float) -> tuple[float, float, int, float]:
    """Return CPU seconds of loadState and of the steps alone, vehicles, and private memory (MB), in a child."""
    warmed, state = found._warmed, found._state(0)

    def work() -> tuple[float, float, int, float]:
        begun = time.process_time()
        with session().run(warmed.launch, 0, SNAPSHOT, lambda: state) as sumo:
            loaded = time.process_time()
            for _ in range(round(seconds / 0.1)):
                sumo.simulationStep()
            ended, vehicles = time.process_time(), sumo.vehicle.getIDCount()
        lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
        private = sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) / 1024
        return loaded - begun, ended - loaded, vehicles, private

    return in_fork(work, None, "stepping")


def main() -> None:
    parser = argparse.ArgumentParser()
    for name, default in (("grid", 28), ("departures", 1300), ("warm-up", 300), ("runs", 50), ("fresh", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = str(scenario(Path(folder), asked.grid, asked.departures, asked.warm_up))
        found = simulation(path, SNAPSHOT)
        seeds = warm_ups(asked.runs, estimating=False)
        found = found.isolated(replace(found.isolation, seeds=seeds, states=f"{folder}/states"))
        begun = cpu()
        for k in range(seeds):
            found.warm_up(k)
        warm = cpu() - begun
        until = found.isolation.until
        print(f"grid {asked.grid}: until t = {until:g} s, {seeds} warm-ups of {warm / seeds:.1f} s CPU", flush=True)
        jobs = [(POINTS[k % 3], run_seed(1, k)) for k in range(asked.runs)]
        found(*jobs[0])  # loads the network once a worker
        begun, wall = cpu(), time.monotonic()
        traces = [found(*job) for job in jobs]
        each = (cpu() - begun) / len(jobs)
        wall = (time.monotonic() - wall) / len(jobs)
        ended = max(float(trace.time[-1]) for trace in traces)
        load, steps, vehicles, private = stepping(found, 12.0)
        print(f"run: {each:.2f} s CPU, {wall:.2f} s wall (to {ended:g} s); 12 s of steps alone {steps:.2f} s", flush=True)
        print(f"loadState {load:.2f} s; {vehicles} vehicles; {private:.0f} MB private of a child", flush=True)
        same = elsewhere(3600, alone, path, seeds, [job for job in jobs if job[1] % seeds == jobs[0][1] % seeds][:3])
        expected = [trace for trace, job in zip(traces, jobs, strict=True) if job[1] % seeds == jobs[0][1] % seeds][:3]
        print(f"equal to a process of their own: {[a.identical(b) for a, b in zip(expected, same, strict=True)]}", flush=True)
        if asked.fresh:
            fresh = simulation(path, "fresh")
            begun = cpu()
            for job in jobs[: asked.fresh]:
                fresh(*job)
            full = (cpu() - begun) / asked.fresh
            total = warm + each * len(jobs)
            gain = full * len(jobs) / total
            print(f"fresh: {full:.1f} s CPU a run; {len(jobs)} runs with the warm-ups {total:.0f} s: {gain:.1f} x")


if __name__ == "__main__":
    main()
