"""Records pairs of inputs and seed of a traffic scenario: python benchmarks/pairs_record.py SCENARIO CHUNK PAIRS NOISES FILE."""

import sys
import time
from dataclasses import replace

import numpy as np

from sbt.errors import RunError
from sbt.execution.spec import ScenarioSpec
from sbt.seeds import run_seed, stream


def main(name: str, chunk: int, pairs: int, noises: int, file: str) -> None:
    """Run each pair once with its own seed, and again with other seeds of SUMO for the same drawn scene."""
    scenario = ScenarioSpec(name).resolve()
    scenario.prepare()
    sim, space = scenario.simulate, scenario.space
    u = stream(chunk, "pairs", name).random((pairs, space.dimension))
    x = space.from_unit(u)
    seeds = [run_seed(chunk + 1000, k) for k in range(pairs)]
    y = np.full((pairs, noises, len(scenario.measured)), np.nan)
    begin, done = time.monotonic(), pairs
    for k in range(pairs):
        if time.monotonic() - begin > 330.0:
            done = k
            break
        values = dict(zip(space.names, x[k], strict=True))
        for j in range(noises):
            scene = lambda values, ego, rng, s=seeds[k]: sim.scene(values, ego, stream(s, "scene"))  # noqa: E731
            try:
                trace = replace(sim, scene=scene)(values, seeds[k] if j == 0 else run_seed(seeds[k], j))
                y[k, j] = [scenario.measure(trace)[m] for m in scenario.measured]
            except RunError:
                pass
    x, seeds, y = x[:done], seeds[:done], y[:done]
    np.savez_compressed(file, x=x, seeds=seeds, y=y, names=space.names, metrics=scenario.measured)
    need = scenario.requirement
    one = y[:, :, scenario.measured.index(need.metric)]
    print(name, chunk, done, time.monotonic() - begin, time.process_time(), need, "critical", np.mean(need.critical.contains(one)), "nan", np.isnan(one).mean())


main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
