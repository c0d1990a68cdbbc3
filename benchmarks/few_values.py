"""Metrics that tell little: flags, speeds of impact, noise that is a share of the value. Is what is concluded so?

    python benchmarks/few_values.py combinations [--seeds 20]      # ten combinations of whole numbers and choices, noisy flags
    python benchmarks/few_values.py values [--seeds 20]            # 18 combinations of a value each; few seeds decide
    python benchmarks/few_values.py estimation [--seeds 8]         # normal and uniform inputs, 150 runs, no stop rule
    python benchmarks/few_values.py logarithms [--seeds 12]        # the same problem as y and as log y, 200 runs
    python benchmarks/few_values.py steps [--seeds 4]              # boundaries of counts, rounded metrics and flags, 100 runs
    python benchmarks/few_values.py hits [--seeds 100]             # P(critical) of flags by random runs, few of them critical
    python benchmarks/few_values.py searched [--seeds 40]          # the same after a falsification of 90 runs, by `predict`
    python benchmarks/few_values.py ends [--seeds 6]               # P(critical) of metrics that end, by 60 and 150 random runs

Campaigns with the product's defaults. Combinations: how many falsifications of 100 runs meet a failure, and how many of as many
random runs do; how many intervals of an estimation cover, and how many gates pass that should not. Estimation: error and half
width of the interval over those of crude Monte Carlo of as many runs, intervals that cover. Boundaries: what lies on the wrong
side of P = .5 at 10,000 random points, what is expected to, and the log loss of P there.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.special import ndtr
from scipy.stats import norm

import sbt
from sbt.metamodels.automatic import Auto
from sbt.metamodels.joint import metamodel_for
from sbt.problem.arrays import Mask, Points, Vector
from sbt.problem.requirement import CriticalInterval
from sbt.seeds import stream

Evaluate = Callable[[dict, int], dict[str, float]]
QUICK, FLAG = Auto(**Auto.PRESETS["quick"]), CriticalInterval(low=0.5)


def campaign(kind: str, inputs: list[sbt.Parameter], low: float, evaluate: Evaluate, seed: int, **keys: object) -> sbt.Result:
    scenario = sbt.Scenario("few", inputs, sbt.Requirement("y", low=low), evaluate=evaluate)
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign=kind, scenario=scenario, seed=seed, store=Path(folder) / "s", executor="serial", report=False, **keys
        )
        _ = result.conclusion, result.history
    return result


def coin(rate: float, where: Callable[[dict], bool] = lambda values: True) -> Evaluate:
    return lambda values, seed: {"y": float(where(values) and stream(seed, "coin").random() < rate)}


def impact(values: dict, seed: int) -> dict[str, float]:
    return {"y": max(0.0, values["n"] - 8.0 + 4.0 * stream(seed, "impact").standard_normal())}


TEN = [sbt.Parameter("n", 1, 5, kind="integer"), sbt.Parameter("k", choices={"x": 0.7, "y": 0.3})]
COMBINATIONS: dict[str, tuple[Evaluate, float]] = {
    "5 % of the seeds": (coin(0.05), 0.05), "2 % of the seeds": (coin(0.02), 0.02),
    "30 % at one of ten": (coin(0.3, lambda values: values["n"] == 5 and values["k"] == "y"), 0.018),
    "93 % of the seeds": (coin(0.93), 0.93), "a speed of impact": (impact, float(norm.sf((8.5 - np.arange(1, 6)) / 4.0).mean())),
    "deterministic": (coin(1.0, lambda values: values["n"] >= 4), 0.4),
}  # fmt: skip


def combinations(seeds: range) -> Iterator[str]:
    yield "| metric | P | a failure met | by random runs | covered | false passes | runs of the estimation |"
    for name, (evaluate, p) in COMBINATIONS.items():
        met = random = covered = passed = 0
        runs = []
        for seed in seeds:
            met += campaign("falsification", TEN, 0.5, evaluate, seed, budget=100).conclusion.critical_runs > 0
            rng = stream(seed, "random")
            drawn = [({"n": int(rng.integers(1, 6)), "k": "xy"[rng.integers(2)]}, int(rng.integers(2**31))) for _ in range(100)]
            random += any(evaluate(*each)["y"] >= 0.5 for each in drawn)
            result = campaign("estimation", TEN, 0.5, evaluate, seed, budget=150, gate={"probability": 0.5 * p})
            found = result.conclusion
            covered += found.low - 1e-9 <= p <= found.high + 1e-9
            passed += found.gate.verdict == "pass"
            runs.append(found.counted)
        n = len(seeds)
        yield f"| {name} | {p:.3g} | {met} of {n} | {random} | {covered} | {passed} | {int(np.median(runs))} |"


ROAD_USERS = {"car": 0.8, "truck": 0.15, "moto": 0.05}
EIGHTEEN = [sbt.Parameter("n", 0, 5, kind="integer"), sbt.Parameter("k", choices=ROAD_USERS)]


def own(rate: float, event: float, kinds: str = "", low: float = -1.0) -> tuple[Evaluate, float, float]:
    """Return a metric that a share of the seeds replaces by `event`; P with failed runs as safe, and as critical."""

    def value(n: float, k: str) -> float:
        return -(2.0 + 0.37 * n + {"car": 0.0, "truck": 0.11, "moto": 0.23}[k])

    def evaluate(values: dict, seed: int) -> dict[str, float]:
        rare = stream(seed, "event").random() < rate and values["k"] in (kinds or values["k"])
        return {"y": event if rare else value(values["n"], values["k"])}

    cells = [(value(n, k) >= low, p / 6.0, k in (kinds or k)) for n in range(6) for k, p in ROAD_USERS.items()]
    sure = sum(p for critical, p, _ in cells if critical)
    gone, met = (sum(p for critical, p, may in cells if may and critical is which) * rate for which in (True, False))
    return evaluate, sure - gone + (0.0 if math.isnan(event) else gone + met), sure + met


VALUES: dict[str, tuple[tuple[Evaluate, float, float], float]] = {
    "3 % of the seeds": (own(0.03, 0.3), -1.0), "10 % of the seeds": (own(0.1, 0.3), -1.0),
    "40 % of the seeds of trucks": (own(0.4, 0.3, "truck"), -1.0), "8 % of the seeds fail": (own(0.08, math.nan, low=-2.3), -2.3),
    "deterministic": (own(0.0, 0.3, low=-2.3), -2.3),
}  # fmt: skip


def values(seeds: range) -> Iterator[str]:
    yield "| metric | P | covered | error / P | crude | false passes | runs |"
    for name, ((evaluate, p, worst), low) in VALUES.items():
        runs = [campaign("estimation", EIGHTEEN, low, evaluate, seed, budget=200).conclusion for seed in seeds]
        gate = {"probability": 0.5 * p}
        gated = [campaign("estimation", EIGHTEEN, low, evaluate, seed, budget=200, gate=gate).conclusion for seed in seeds]
        covered = sum(found.low - 1e-9 <= p and worst <= found.high + 1e-9 for found in runs)
        error = math.sqrt(np.mean([(found.probability / p - 1.0) ** 2 for found in runs]))
        passed, counted = sum(found.gate.verdict == "pass" for found in gated), int(np.median([found.counted for found in runs]))
        crude = math.sqrt((1.0 - p) / p / 200.0)
        yield f"| {name} | {p:.3g} | {covered} of {len(runs)} | {error:.2f} | {crude:.2f} | {passed} | {counted} |"


SHAPES: dict[str, Callable[[Points], Vector]] = {
    "ball": lambda u: np.sqrt(((u - 0.7) ** 2).sum(axis=1)),
    "two": lambda u: np.minimum(np.sqrt(((u - 0.7) ** 2).sum(axis=1)), np.sqrt(((u - 0.2) ** 2).sum(axis=1))),
    "half": lambda u: 1.0 - u.mean(axis=1),
    "corner": lambda u: 1.0 - u[:, :2].min(axis=1),
    "wave": lambda u: 1.0 - u.mean(axis=1) + 0.1 * np.sin(9.0 * u[:, 0]),
}
KINDS: dict[str, tuple[Callable[[Vector], Vector], float]] = {
    "flag": (lambda margin: (margin <= 0.0).astype(float), 0.0), "speed": (lambda margin: np.maximum(-10.0 * margin, 0.0), 0.0),
    "noisy flag": (lambda margin: (margin <= 0.0).astype(float), 0.3),
}  # fmt: skip


def estimation(seeds: range) -> Iterator[str]:
    yield "| metric | region | inputs | P | error / crude | half width / crude | covered |"
    for kind, (metric, noise) in KINDS.items():
        for k, (shape, distance) in enumerate(SHAPES.items()):
            d, normal, target = 2 + k % 3, k % 2 == 0, (0.01, 0.02, 0.05)[k % 3]
            draws = stream(k, "draws").standard_normal((400_000, d))
            far = distance(ndtr(draws))
            edge, scale = float(np.quantile(far, target)), float(far.std())
            drawn = stream(k, "noise").standard_normal(len(draws))
            p = float((far / scale + noise * drawn <= edge / scale).mean())

            def evaluate(values, seed, d=d, normal=normal, distance=distance, edge=edge, scale=scale, metric=metric, noise=noise):
                x = np.array([list(values.values())])
                margin = (distance(ndtr(x) if normal else x) - edge) / scale
                return {"y": float(metric(margin + noise * stream(seed, "seed").standard_normal())[0])}

            inputs = [sbt.Parameter(n, -6, 6, "", sbt.Normal(0, 1)) if normal else sbt.Parameter(n, 0, 1) for n in "abcd"[:d]]
            runs = [campaign("estimation", inputs, 1e-9, evaluate, s, budget=150, stop={"cov": None}).conclusion for s in seeds]
            crude, value = math.sqrt(p * (1.0 - p) / 150), np.array([found.probability or 0.0 for found in runs])
            width = np.median([found.high - found.low for found in runs]) / 2.0 / 1.96 / crude
            covered = sum(found.low <= p <= found.high for found in runs)
            error = math.sqrt(np.mean((value - p) ** 2)) / crude
            told = f"{d} {'normal' if normal else 'uniform'} | {p:.4f} | {error:.2f} | {width:.2f} | {covered} of {len(runs)} |"
            yield f"| {kind} | {shape} | {told}"


def logarithms(seeds: range) -> Iterator[str]:
    yield "| metric | P | error / P | crude | covered |"
    p, inputs = float(norm.sf(math.log(20.0) / math.sqrt(1.34))), [sbt.Parameter(n, -6, 6, "", sbt.Normal(0, 1)) for n in "ab"]
    for name, unit in (("y", math.exp), ("log y", float)):

        def evaluate(values: dict, seed: int, unit: Callable[[float], float] = unit) -> dict[str, float]:
            return {"y": unit(values["a"] + 0.5 * values["b"] + 0.3 * float(stream(seed, "seed").standard_normal()))}

        low = 20.0 if name == "y" else math.log(20.0)
        runs = [campaign("estimation", inputs, low, evaluate, s, budget=200, stop={"cov": None}).conclusion for s in seeds]
        error = math.sqrt(np.mean([((found.probability or 0.0) / p - 1.0) ** 2 for found in runs]))
        covered = sum(found.low <= p <= found.high for found in runs)
        yield f"| {name} | {p:.4f} | {error:.2f} | {math.sqrt((1.0 - p) / p / 200):.2f} | {covered} of {len(runs)} |"


STEPPED: dict[str, tuple[Callable[[Points], Vector], int]] = {
    "ring": (lambda u: 3.0 * np.hypot(u[:, 0] - 0.4, 1.3 * (u[:, 1] - 0.6)) + 0.4 * np.sin(6.0 * u[:, 0]), 2),
    "slope": (lambda u: 4.0 * u[:, 0] + 2.0 * u[:, 1] ** 2 - 1.5 * u[:, 2], 3),
    "bowl": (lambda u: 2.0 * np.sqrt(((u - 0.5) ** 2).sum(axis=1)) + 0.5 * u[:, 0], 4),
}
STEPS = {"ring": (0.1, 0.5, 1.2), "slope": (0.1, 1.2), "bowl": (0.1, 0.5)}


def stepped() -> Iterator[tuple[str, Callable[[Points], Vector], int, float]]:
    """Yield a metric, at least 0 where it is critical, its name and its inputs."""
    for name, (shape, d) in STEPPED.items():
        edge = float(np.quantile(shape(stream(0, "edge").random((100_000, d))), 0.25))
        for step in STEPS[name]:
            yield f"{name}, steps of {step:g}", lambda u, f=shape, s=step, e=edge: np.floor((e - f(u)) / s) * s, d, 0.0
        yield f"{name}, a flag", lambda u, f=shape, e=edge: (f(u) <= e).astype(float), d, 0.5


def steps(seeds: range) -> Iterator[str]:
    yield "| metric | inputs | wrong side, in % | expected | log loss | CPU s |"
    for name, metric, d, low in stepped():
        u, told = stream(1, "points").random((10_000, d)), []
        critical, names = metric(u) >= low, "abcd"[:d]
        inputs, began = [sbt.Parameter(n, 0, 1) for n in names], time.process_time()

        def evaluate(values: dict, seed: int, metric: Callable[[Points], Vector] = metric) -> dict[str, float]:
            return {"y": float(metric(np.array([list(values.values())]))[0])}

        for seed in seeds:
            scenario = sbt.Scenario("steps", inputs, sbt.Requirement("y", low=low), evaluate=evaluate)
            with tempfile.TemporaryDirectory() as folder:
                store = Path(folder) / "s"
                result = sbt.run(
                    campaign="boundary", scenario=scenario, seed=seed, store=store, executor="serial", report=False, budget=100
                )  # fmt: skip
                p = result.predict(dict(zip(names, u.T, strict=True)))["p_critical"].to_numpy()
            sure = np.clip(np.where(critical, p, 1.0 - p), 1e-6, 1.0)
            told.append([100.0 * ((p > 0.5) != critical).mean(), 100.0 * np.minimum(p, 1.0 - p).mean(), -np.log(sure).mean()])
        wrong, expected, loss = np.mean(told, axis=0)
        took = (time.process_time() - began) / len(seeds)
        yield f"| {name} | {d} | {wrong:.2f} | {expected:.2f} | {loss:.4f} | {took:.0f} |"


def region(rng: np.random.Generator) -> tuple[Callable[[Points], Mask], int]:
    """Return a half space, a corner or a ball by some inputs, or a shell, .5 to 20 % of the box, and the number of inputs."""
    d, share, kind = int(rng.choice([2, 3, 5])), math.exp(rng.uniform(math.log(0.005), math.log(0.2))), int(rng.integers(4))
    some, middle, weight = rng.permutation(d)[: rng.integers(1, min(d, 3) + 1)], rng.random(d), rng.standard_normal(d)
    shape: Callable[[Points], Vector] = (
        lambda u: u @ weight, lambda u: u[:, some].max(axis=1), lambda u: ((u - middle)[:, some] ** 2).sum(axis=1),
        lambda u: np.abs((u - middle) @ np.abs(weight)),
    )[kind]  # fmt: skip
    edge = float(np.quantile(shape(stream(0, "edge").random((20_000, d))), share))
    return lambda u: shape(u) <= edge, d


def hits(seeds: range) -> Iterator[str]:
    yield "| critical runs | flags | wrong side, in % | expected | log loss | of one P wherever |"
    told: list[tuple[int, list[float]]] = []
    for seed in seeds:
        rng = stream(seed, "flag")
        inside, d = region(rng)
        u, at = rng.random((int(rng.choice([40, 90, 150])), d)), stream(1, "points").random((8000, d))
        hit, critical = inside(u), inside(at)
        if not hit.any():
            continue
        found = metamodel_for(QUICK, FLAG).fit(u, hit.astype(float), stream(seed, "fit"))(at)
        p, (log_p, log_not), share = found.probability(FLAG), found.log_probability(FLAG), (hit.sum() + 0.5) / (len(u) + 1.0)
        wrong, loss = ((p > 0.5) != critical).mean(), -np.where(critical, log_p, log_not).mean()
        base = -np.where(critical, math.log(share), math.log1p(-share)).mean()
        told.append((int(hit.sum()), [100.0 * wrong, 100.0 * np.minimum(p, 1.0 - p).mean(), loss, base]))
    for first, last in ((1, 1), (2, 2), (3, 5), (6, 12), (13, 99)):
        group = [row for n, row in told if first <= n <= last]
        wrong, expected, loss, base = np.mean(group, axis=0)
        yield f"| {first} to {last} | {len(group)} | {wrong:.1f} | {expected:.1f} | {loss:.3f} | {base:.3f} |"


def searched(seeds: range) -> Iterator[str]:
    yield "| critical runs | flags | expected critical, in % | critical | log loss | of one P wherever |"
    told: list[tuple[int, list[float]]] = []
    for seed in seeds:
        inside, d = region(stream(seed, "flag"))
        inputs = [sbt.Parameter(f"x{k}", 0.0, 1.0) for k in range(d)]

        def evaluate(values: dict[str, float], _: int, inside: Callable[[Points], Mask] = inside) -> dict[str, float]:
            return {"flag": float(inside(np.array([list(values.values())]))[0])}

        scenario = sbt.Scenario("region", inputs, sbt.Requirement("flag", low=0.5), evaluate=evaluate)
        with tempfile.TemporaryDirectory() as folder:
            found = sbt.run(
                campaign="falsification", scenario=scenario, budget=90, seed=seed, executor="serial", report=False,
                store=Path(folder) / "store",
            )  # fmt: skip
            at = stream(1, "points").random((4000, d))
            p, n, critical = found.predict(at)["p_critical"].to_numpy(), int(found.frame["critical"].sum()), inside(at)
        share = critical.mean()
        loss = -np.log(np.clip(np.where(critical, p, 1.0 - p), 1e-6, 1.0)).mean()
        base = -np.where(critical, math.log(share), math.log1p(-share)).mean()
        told.append((n, [100.0 * p.mean(), 100.0 * share, loss, base]))
    for first, last in ((0, 0), (1, 2), (3, 12), (13, 199)):
        group = [row for n, row in told if first <= n <= last]
        if group:
            expected, share, loss, base = np.mean(group, axis=0)
            yield f"| {first} to {last} | {len(group)} | {expected:.1f} | {share:.1f} | {loss:.3f} | {base:.3f} |"


def rough(rng: np.random.Generator, d: int, length: float) -> Callable[[Points], Vector]:
    """Return a random function of d inputs that bends within a length, of variance 1."""
    waves, phase, size = rng.standard_normal((200, d)) / length, rng.uniform(0.0, 2.0 * math.pi, 200), rng.standard_normal(200)
    return lambda u: 0.1 * np.cos(u @ waves.T + phase) @ size


def ending(seed: int) -> Iterator[tuple[str, int, Callable[[Points], Vector], CriticalInterval]]:
    """Yield metrics that end, their inputs and M_c: in most of them all that is critical has the last value, 0."""
    rng = stream(seed, "ending")
    f = [rough(rng, d, length) for d, length in ((4, 0.5), (3, 0.5), (3, 0.6), (5, 0.9))]
    c, w, at_most = rng.random(4), rng.standard_normal(6), CriticalInterval(high=0.0)
    shapes: list[tuple[str, int, Callable[[Points], Vector], CriticalInterval]] = [
        ("a rough band", 4, lambda u: np.abs(f[0](u)) - 0.28, at_most),
        ("a rough side", 3, lambda u: f[1](u) + 0.4, at_most),
        ("a ball", 3, lambda u: np.linalg.norm(u - c[:3], axis=1) - 0.35, at_most),
        ("two lines", 2, lambda u: 10.0 * np.abs(np.abs(u[:, 0] - 0.8) - np.abs(u[:, 1] - 0.5)) - 0.5, at_most),
        ("a slope", 6, lambda u: (u - 0.5) @ w + 0.3 + 0.4 * np.sin(5.0 * u[:, 0]), at_most),
        ("0 beyond the edge", 3, lambda u: 3.0 * (f[2](u) + 0.3), CriticalInterval(high=0.9)),
        ("0 on the other side", 5, lambda u: 10.0 * (f[3](u) + 0.1), CriticalInterval(low=1.0)),
    ]  # fmt: skip
    for name, d, shape, critical in shapes:
        yield name, d, lambda u, shape=shape: np.maximum(shape(u), 0.0), critical


def ends(seeds: range) -> Iterator[str]:
    yield "| metric | inputs | runs | critical, in % | told | wrong side | expected | log loss |"
    for runs in (60, 150):
        told: dict[tuple[str, int], list[list[float]]] = {}
        for seed in seeds:
            for name, d, metric, critical in ending(seed):
                u, at = stream(seed, "u").random((runs, d)), stream(1, "points").random((8000, d))
                hit = critical.contains(metric(at))
                if min(critical.contains(metric(u)).sum(), (~critical.contains(metric(u))).sum()) < 2:
                    continue
                found = metamodel_for(QUICK, critical).fit(u, metric(u), stream(seed, "fit"))(at)
                p, (log_p, log_not) = found.probability(critical), found.log_probability(critical)
                wrong, loss = ((p > 0.5) != hit).mean(), -np.where(hit, log_p, log_not).mean()
                row = [100.0 * hit.mean(), 100.0 * p.mean(), 100.0 * wrong, 100.0 * np.minimum(p, 1.0 - p).mean(), loss]
                told.setdefault((name, d), []).append(row)
        for (name, d), rows in told.items():
            share, p, wrong, expected, loss = np.mean(rows, axis=0)
            yield f"| {name} | {d} | {runs} | {share:.1f} | {p:.1f} | {wrong:.1f} | {expected:.1f} | {loss:.3f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tables = {
        "combinations": combinations, "values": values, "estimation": estimation, "logarithms": logarithms, "steps": steps,
        "hits": hits, "searched": searched, "ends": ends,
    }  # fmt: skip
    parser.add_argument("what", choices=tuple(tables))
    parser.add_argument("--seeds", type=int, default=8)
    given = parser.parse_args()
    rows = tables[given.what](range(given.seeds))
    for k, row in enumerate(rows):
        print(row, flush=True)
        if k == 0:
            print("|" + "---|" * (row.count("|") - 1), flush=True)


if __name__ == "__main__":
    main()
