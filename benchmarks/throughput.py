"""How many concrete scenarios a second: isolation levels, SUMO started anew, traci, one and two workers.

    python benchmarks/throughput.py [--runs 300] [--repeats 5]

Every row runs the same Sobol points of the same scenario with the same controller and step; only the
way to SUMO differs. Rows take turns and the table gives the median of the repeats, because machines
are noisy. The traci row needs the `sumo` program (extra `tools`) and is left out without it.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

from scipy.stats import qmc

from sbt.plugins import load
from sbt.problem.scenario import LogicalScenario
from sbt.sumo import session as sumo_session


def points(scenario: LogicalScenario, n: int) -> list[dict[str, float]]:
    x = scenario.space.from_unit(qmc.Sobol(scenario.space.dimension, rng=1).random(n))
    return [dict(zip(scenario.space.names, map(float, row), strict=True)) for row in x]


def level(scenario: LogicalScenario, isolation: str, values: list[dict[str, float]]) -> Callable[[], None]:
    configured = scenario.configured(isolation=isolation)

    def run() -> None:
        for k, v in enumerate(values):
            configured.run(v, k)

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
        simulation=SimpleNamespace(step=traci.simulationStep, getCollisions=traci.simulation.getCollisions,
                                   getCollidingVehiclesNumber=traci.simulation.getCollidingVehiclesNumber),
    )  # fmt: skip
    fresh = scenario.configured(isolation="fresh")

    def run() -> None:
        own, direct = sumo_session.session(), sumo_session.session()._sumo
        own._sumo = client
        try:
            for k, v in enumerate(values):
                fresh.run(v, k)
        finally:
            own._sumo = direct  # the subprocess stays, `traci.load` goes on with it

    return run


def measure(rows: dict[str, tuple[Callable[[], None], int]], repeats: int) -> dict[str, list[float]]:
    rates: dict[str, list[float]] = {name: [] for name in rows}
    for run, _ in rows.values():
        run()
    for _ in range(repeats):
        for name, (run, n) in rows.items():
            start = time.perf_counter()
            run()
            rates[name].append(n / (time.perf_counter() - start))
    return rates


def campaign_rate(name: str, workers: int, n: int) -> float:
    """Runs a second of a whole coverage campaign, the driver and the store included."""
    import tempfile

    from sbt.config.load import parse
    from sbt.run import run_campaign

    with tempfile.TemporaryDirectory() as folder:
        text = (
            f"campaign: coverage\nscenario: {name}\nbudget: {n}\nbatch: {n}\nvalidation: {{share: 0}}\n"
            f"executor: {{kind: local, workers: {workers}}}\nstore: {Path(folder) / 'store'}\n"
        )
        result = run_campaign(parse(text), report=False)
        return n / result["seconds"]["simulate"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cut_in")
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--sumo", default=shutil.which("sumo"), help="the sumo program for the traci row")
    parser.add_argument("--no-campaign", action="store_true", help="leave out the rows of whole campaigns")
    args = parser.parse_args()
    scenario = load("scenarios", args.scenario)
    values = points(scenario, args.runs)
    few = values[: max(args.runs // 10, 10)]
    rows: dict[str, tuple[Callable[[], None], int]] = {
        "libsumo.start / close a run": (start_close(scenario, values), len(values)),
        "isolation fresh (libsumo.load)": (level(scenario, "fresh", values), len(values)),
        "isolation reuse": (level(scenario, "reuse", values), len(values)),
    }
    if args.sumo:
        rows["traci.load, sumo subprocess"] = (traci_load(scenario, few, args.sumo), len(few))
    rates = measure(rows, args.repeats)
    base = statistics.median(rates["isolation reuse"])
    print(f"{args.scenario}, {args.runs} runs, median (min, max) of {args.repeats} repeats, one process\n")
    print("| way to SUMO | runs/s | reuse is faster by |\n|---|---|---|")
    for name, values_ in rates.items():
        mid = statistics.median(values_)
        print(f"| {name} | {mid:.0f} ({min(values_):.0f}, {max(values_):.0f}) | {base / mid:.2f} x |")
    if not args.no_campaign:
        one, two = ([campaign_rate(args.scenario, w, 4000) for _ in range(args.repeats)] for w in (1, 2))
        print("\n| whole campaign, 4,000 runs | runs/s | ratio |\n|---|---|---|")
        print(f"| 1 worker | {statistics.median(one):.0f} ({min(one):.0f}, {max(one):.0f}) | 1.00 |")
        ratio = statistics.median(two) / statistics.median(one)
        print(f"| 2 workers | {statistics.median(two):.0f} ({min(two):.0f}, {max(two):.0f}) | {ratio:.2f} |")


if __name__ == "__main__":
    main()
