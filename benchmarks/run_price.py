"""What does a run of traffic cost beside SUMO? CPU time of a run with its metrics against SUMO's own load and steps of its scene.

    python benchmarks/run_price.py [--runs 64] [--repeats 3] [--only NAME ...]

Runs take turns with bare ones in another process: the same network, types and options are loaded by `libsumo.load`, the
same actors inserted, and the same number of steps made, with nothing read. Only their load and their steps count; drawing the
scene, writing its types and inserting its actors are the price of the run. CPU time of the processes, median of the repeats.
"""

from __future__ import annotations

import argparse
import statistics
import time
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context

from throughput import points

from sbt.execution.local import settle
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.problem.outcome import Job, Status
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import run_seed
from sbt.sumo import session as sessions
from sbt.sumo.insertion import insert
from sbt.sumo.simulation import SumoSimulation

BLOCK = 8
"""Runs between which the two take turns."""
SCENARIOS = ("unprotected_left_turn", "roundabout_entry", "highway_merge", "crossing_pedestrian")


Sums = tuple[float, float]
"""CPU times of SUMO's loads and of its steps (s)."""


def bare(name: str, jobs: list[Job], steps: list[int]) -> Sums:
    """Load and step only, in a process that has nothing of what this package does to load quickly."""
    sessions._XML_BEGIN = "nothing"
    scenario = ScenarioSpec(name).resolve()
    simulation = scenario.simulate
    if not isinstance(simulation, SumoSimulation):
        raise TypeError(f"{name} is not one of the installed scenarios")
    libsumo, registry = sessions.libsumo(), sessions.session()
    load = stepping = 0.0
    for job, n in zip(jobs, steps, strict=True):
        scene = simulation.build_scene(job.inputs, job.seed)
        command = simulation.setup(scene).command(job.seed)
        begun = time.process_time()
        if libsumo.isLoaded():
            libsumo.load(command)
        else:
            libsumo.start(["sumo", *command])
        loaded = time.process_time()
        registry._routes.clear()
        registry._inserted.clear()
        insert(libsumo, scene)
        inserted = time.process_time()
        for _ in range(n):
            libsumo.simulationStep()
        load, stepping = load + loaded - begun, stepping + time.process_time() - inserted
    return load, stepping


def whole(scenario: LogicalScenario, jobs: list[Job]) -> float:
    """Return the CPU time of runs with their metrics (s)."""
    begun = time.process_time()
    for job in jobs:
        outcome = run_job(scenario, job)
        if outcome.status != Status.OK:
            raise RuntimeError(f"every run must be ok, but {outcome.reason}")
    return time.process_time() - begun


def priced(apart: Executor, scenario: LogicalScenario, jobs: list[Job], steps: list[int]) -> tuple[float, float, float]:
    """Return means of the CPU times of a run with its metrics, of the load alone and of the steps alone (s)."""
    taken = load = stepping = 0.0
    for first in range(0, len(jobs), BLOCK):
        some = slice(first, first + BLOCK)
        taken += whole(scenario, jobs[some])
        one, other = apart.submit(bare, scenario.name, jobs[some], steps[some]).result()
        load, stepping = load + one, stepping + other
    return taken / len(jobs), load / len(jobs), stepping / len(jobs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    asked = parser.parse_args()
    print("| scenario | a run, ms CPU | load | steps | run / (load + steps) | steps / run |\n" + "|---" * 6 + "|", flush=True)
    for name in asked.only:
        scenario = ScenarioSpec(name).resolve()
        simulate = scenario.simulate
        if simulate is None:
            raise TypeError(f"{name} is not simulated")
        jobs = [Job(k, values, run_seed(1, k)) for k, values in enumerate(points(scenario, asked.runs))]
        steps = [len(simulate(job.inputs, job.seed).time) for job in jobs]
        settle()
        with ProcessPoolExecutor(1, get_context("spawn")) as apart:
            apart.submit(bare, name, jobs[:2], steps[:2]).result()
            found = [priced(apart, scenario, jobs, steps) for _ in range(asked.repeats)]
        taken, load, stepping = (1e3 * statistics.median(column) for column in zip(*found, strict=True))
        ratios = sorted(a / (b + c) for a, b, c in found)
        spread = f"{statistics.median(ratios):.2f} ({ratios[0]:.2f}, {ratios[-1]:.2f})"
        print(f"| {name} | {taken:.1f} | {load:.1f} | {stepping:.1f} | {spread} | {100 * stepping / taken:.0f} % |", flush=True)


if __name__ == "__main__":
    main()
