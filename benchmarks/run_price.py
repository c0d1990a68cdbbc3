"""What does a run of traffic cost beside SUMO? CPU time of a run with its metrics against SUMO's own load and steps of its scene.

    python benchmarks/run_price.py [--runs 64] [--repeats 3] [--only NAME ...]

Each run takes turns with a bare one: the same network, types and options are loaded, the same actors inserted, and the same number
of steps made, with nothing read. Only its load and its steps count; drawing the scene, writing its types and inserting its actors
are the price of the run. CPU time of the process, median of the repeats.
"""

from __future__ import annotations

import argparse
import statistics
import time

import libsumo
from throughput import points

from sbt.execution.local import settle
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_job
from sbt.problem.outcome import Job, Status
from sbt.problem.plain import Values
from sbt.problem.scenario import LogicalScenario
from sbt.seeds import run_seed
from sbt.sumo.insertion import insert
from sbt.sumo.simulation import SumoSimulation

SCENARIOS = ("unprotected_left_turn", "roundabout_entry", "highway_merge", "crossing_pedestrian")


def bare(simulation: SumoSimulation, values: Values, seed: int, steps: int) -> tuple[float, float]:
    """Return the CPU times of SUMO's load and of its steps (s)."""
    from sbt.sumo.session import session

    scene = simulation.build_scene(values, seed)
    command = simulation.setup(scene).command(seed)
    begun = time.process_time()
    libsumo.load(command)
    loaded = time.process_time()
    registry = session()
    registry._routes.clear()
    registry._inserted.clear()
    insert(libsumo, scene)
    inserted = time.process_time()
    for _ in range(steps):
        libsumo.simulationStep()
    return loaded - begun, time.process_time() - inserted


def priced(scenario: LogicalScenario, jobs: list[Job], steps: list[int]) -> tuple[float, float, float]:
    """Return means of the CPU times of a run with its metrics, of the load alone and of the steps alone (s)."""
    if not isinstance(scenario.simulate, SumoSimulation):
        raise TypeError(f"{scenario.name} is not one of the installed scenarios")
    whole = load = stepping = 0.0
    for job, n in zip(jobs, steps, strict=True):
        begun = time.process_time()
        outcome = run_job(scenario, job)
        whole += time.process_time() - begun
        if outcome.status != Status.OK:
            raise RuntimeError(f"every run must be ok, but {outcome.reason}")
        one, other = bare(scenario.simulate, job.inputs, job.seed, n)
        load, stepping = load + one, stepping + other
    return whole / len(jobs), load / len(jobs), stepping / len(jobs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=SCENARIOS, default=SCENARIOS)
    asked = parser.parse_args()
    print("| scenario | a run, ms CPU | load | steps | run / (load + steps) | steps / run |\n|---|---|---|---|---|---|", flush=True)
    for name in asked.only:
        scenario = ScenarioSpec(name).resolve()
        simulate = scenario.simulate
        if simulate is None:
            raise TypeError(f"{name} is not simulated")
        jobs = [Job(k, values, run_seed(1, k)) for k, values in enumerate(points(scenario, asked.runs))]
        steps = [len(simulate(job.inputs, job.seed).time) for job in jobs]
        settle()
        found = [priced(scenario, jobs, steps) for _ in range(asked.repeats)]
        whole, load, stepping = (1e3 * statistics.median(column) for column in zip(*found, strict=True))
        ratios = sorted(a / (b + c) for a, b, c in found)
        spread = f"{statistics.median(ratios):.2f} ({ratios[0]:.2f}, {ratios[-1]:.2f})"
        print(f"| {name} | {whole:.1f} | {load:.1f} | {stepping:.1f} | {spread} | {100 * stepping / whole:.0f} % |", flush=True)


if __name__ == "__main__":
    main()
