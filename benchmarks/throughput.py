"""How many concrete scenarios a second: isolation levels, SUMO started anew, traci, every scenario, one and two workers.

    python benchmarks/throughput.py [--runs 256] [--repeats 5]        the ways to SUMO, for cut_in
    python benchmarks/throughput.py --every [--seconds 6]             every scenario (or --only NAME ...), isolation and step

Every row runs the same Sobol points of the same scenario with the same controller and step; only the
way to SUMO differs. Rows take turns and the table gives the median of the repeats, because machines
are noisy; rates in one process are per second of CPU time, those of campaigns and of the `sumo` program
(extra `tools`, left out without it) per second on the clock.
"""

from __future__ import annotations

import argparse
import gc
import math
import shutil
import statistics
import time
from collections.abc import Callable
from types import SimpleNamespace

from scipy.stats import qmc

import sbt
from sbt.execution.local import settle
from sbt.execution.protocol import CHUNK
from sbt.execution.spec import ScenarioSpec
from sbt.execution.worker import run_jobs
from sbt.problem.outcome import Job, Status
from sbt.problem.scenario import LogicalScenario
from sbt.sumo import session as sumo_session

STEPS = (0.05, 0.1)


def points(scenario: LogicalScenario, n: int) -> list[dict[str, float]]:
    x = scenario.space.from_unit(qmc.Sobol(scenario.space.dimension, rng=1).random(n))
    return [dict(zip(scenario.space.names, map(float, row), strict=True)) for row in x]


def level(scenario: LogicalScenario, isolation: str, values: list[dict[str, float]]) -> Callable[[], None]:
    """Runs as a worker does them: several at once where the isolation level does that."""
    configured = scenario.configured(isolation=isolation)
    jobs = [Job(k, v, k) for k, v in enumerate(values)]

    def run() -> None:
        for first in range(0, len(jobs), CHUNK):
            outcomes = run_jobs(configured, jobs[first : first + CHUNK], lambda _: None)
            failed = [o.reason for o in outcomes if o.status != Status.OK]
            if failed:
                raise RuntimeError(f"every run must be ok, but {failed[0]}")

    return run


def start_close(scenario: LogicalScenario, values: list[dict[str, float]]) -> Callable[[], None]:
    """SUMO through `libsumo.start` and `libsumo.close` for each run."""
    fresh = scenario.configured(isolation="fresh")

    def run() -> None:
        for k, v in enumerate(values):
            if sumo_session.libsumo().isLoaded():
                sumo_session.libsumo().close()
            fresh.run(v, k)

    return run


def traci_load(scenario: LogicalScenario, values: list[dict[str, float]], program: str) -> Callable[[], None]:
    """A `sumo` subprocess kept alive by `traci.load`, the same controller over the socket."""
    import traci

    client = SimpleNamespace(
        vehicle=traci.vehicle, route=traci.route, load=traci.load, isLoaded=traci.isLoaded,
        simulationStep=traci.simulationStep, TraCIException=traci.TraCIException, FatalTraCIError=traci.FatalTraCIError,
        start=lambda command: traci.start([program, *command[1:]]),
        edge=traci.edge,
        simulation=SimpleNamespace(step=traci.simulationStep, getCollisions=traci.simulation.getCollisions,
                                   getCollidingVehiclesNumber=traci.simulation.getCollidingVehiclesNumber),
    )  # fmt: skip
    fresh = scenario.configured(isolation="fresh")

    def run() -> None:
        with sumo_session.session().using(client):  # the subprocess stays, `traci.load` goes on with it
            for k, v in enumerate(values):
                fresh.run(v, k)

    return run


def measure(rows: dict[str, tuple[Callable[[], None], int]], repeats: int) -> dict[str, list[float]]:
    rates: dict[str, list[float]] = {name: [] for name in rows}
    for run, _ in rows.values():
        run()
    gc.collect()
    settle()  # as a worker does
    for _ in range(repeats):
        for name, (run, n) in rows.items():
            clock = time.perf_counter if "subprocess" in name else time.process_time
            start = clock()
            run()
            rates[name].append(n / (clock() - start))
    return rates


def campaign_rate(name: str, workers: int, n: int, step: float | None = None) -> float:
    """Runs a second of a whole coverage campaign, the driver and the store included."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="coverage", scenario=name, budget=n, batch=n, validation={"share": 0.0}, executor="local", workers=workers,
            simulation={"step_length": step}, store=f"{folder}/store", report=False,
        )  # fmt: skip
        return n / result.summary["seconds"]["simulate"]


def every(names: list[str], repeats: int, seconds: float) -> None:
    """Print the rate of every built-in scenario at its isolation levels and two steps, and of campaigns."""
    print("| scenario | step (s) | simulated s a run | fresh | reuse | replicas | ms a simulated s, default | times cut_in |")
    print("|---|---|---|---|---|---|---|---|")
    cut_in: dict[float, float] = {}
    for name in sorted({"cut_in", *names}, key=lambda n: (n != "cut_in", n)):
        for step in STEPS:
            scenario = ScenarioSpec(name, step_length=step).resolve()
            if not scenario.isolations:
                continue
            few = points(scenario, 8)
            start = time.process_time()
            level(scenario, scenario.isolations[-1], few)()
            n = 1 << max(int(math.log2(max(seconds / repeats / ((time.process_time() - start) / 8), 8))), 3)
            values = points(scenario, min(n, 256))
            rows = {i: (level(scenario, i, values), len(values)) for i in scenario.isolations}
            rates = {i: statistics.median(r) for i, r in measure(rows, repeats).items()}
            lasting = statistics.fmean(float(scenario.simulate(v, k).time[-1]) for k, v in enumerate(values[:64]))
            cost = 1e3 / rates[scenario.isolations[-1]] / lasting
            cut_in.setdefault(step, cost)
            told = " | ".join(f"{rates[i]:.0f}" if i in rates else "-" for i in ("fresh", "reuse", "replicas"))
            print(f"| {name} | {step} | {lasting:.1f} | {told} | {cost:.2f} | {cost / cut_in[step]:.1f} |", flush=True)


def campaigns(names: list[str], repeats: int, seconds: float) -> None:
    """Print the rate of whole campaigns with one and two workers."""
    print("\n| scenario | step (s) | runs | 1 worker: runs/s | 2 workers | ratio |\n|---|---|---|---|---|---|")
    for name in names:
        for step in STEPS:
            n = 1 << int(math.log2(max(seconds * campaign_rate(name, 1, 32, step), 64)))
            rates = [(campaign_rate(name, 1, n, step), campaign_rate(name, 2, n, step)) for _ in range(repeats)]
            one, two = (statistics.median(r) for r in zip(*rates, strict=True))
            print(f"| {name} | {step} | {n} | {one:.0f} | {two:.0f} | {two / one:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cut_in")
    parser.add_argument("--runs", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--every", action="store_true", help="every built-in scenario, isolation level and step")
    parser.add_argument("--seconds", type=float, default=6.0, help="time for a row of --every")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="scenarios of --every; default: all built-in ones")
    parser.add_argument("--only-campaigns", action="store_true", help="of --every, only the rows of whole campaigns")
    parser.add_argument("--sumo", default=shutil.which("sumo"), help="the sumo program for the traci row")
    parser.add_argument("--no-campaign", action="store_true", help="leave out the rows of whole campaigns")
    args = parser.parse_args()
    if args.every:
        names = args.only or [n for n in sbt.list("scenarios") if ScenarioSpec(n).resolve().isolations]
        if not args.only_campaigns:
            every(names, args.repeats, args.seconds)
        if not args.no_campaign:
            campaigns(names, args.repeats, args.seconds)
        return
    scenario = ScenarioSpec(args.scenario).resolve()
    values = points(scenario, args.runs)
    few = values[: max(args.runs // 10, 10)]
    rows: dict[str, tuple[Callable[[], None], int]] = {
        "libsumo.start / close a run": (start_close(scenario, values), len(values))
    }
    for isolation in scenario.isolations:
        rows[f"isolation {isolation}"] = (level(scenario, isolation, values), len(values))
    if args.sumo:
        rows["traci.load, sumo subprocess"] = (traci_load(scenario, few, args.sumo), len(few))
    rates = measure(rows, args.repeats)
    base = statistics.median(rates["libsumo.start / close a run"])
    print(f"{args.scenario}, {args.runs} runs, median (min, max) of {args.repeats} repeats, one process\n")
    print("| way to SUMO | runs/s | times start / close |\n|---|---|---|")
    for name, values_ in rates.items():
        mid = statistics.median(values_)
        print(f"| {name} | {mid:.0f} ({min(values_):.0f}, {max(values_):.0f}) | {mid / base:.2f} x |")
    if not args.no_campaign:
        one, two = ([campaign_rate(args.scenario, w, 4000) for _ in range(args.repeats)] for w in (1, 2))
        print("\n| whole campaign, 4,000 runs | runs/s | ratio |\n|---|---|---|")
        print(f"| 1 worker | {statistics.median(one):.0f} ({min(one):.0f}, {max(one):.0f}) | 1.00 |")
        ratio = statistics.median(two) / statistics.median(one)
        print(f"| 2 workers | {statistics.median(two):.0f} ({min(two):.0f}, {max(two):.0f}) | {ratio:.2f} |")


if __name__ == "__main__":
    main()
