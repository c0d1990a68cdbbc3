"""Campaigns in corners: chains of subset simulation on equal values, large batches, failures by chance, waves, idle choices.

    python benchmarks/corners.py ties [--seeds 300]
    python benchmarks/corners.py many [--seeds 300]
    python benchmarks/corners.py repeats [--seeds 1500]
    python benchmarks/corners.py batches [--seeds 16]
    python benchmarks/corners.py chance [--seeds 30]
    python benchmarks/corners.py waves [--seeds 12]
    python benchmarks/corners.py sometimes [--seeds 60]
    python benchmarks/corners.py idle [--seeds 12]
    python benchmarks/corners.py bands [--seeds 12]

`ties` repeats one subset simulation of 200 points a level on a plane in two and ten normal inputs whose margin is rounded or
cut off. `many` is what campaigns with many inputs do where no few directions explain the metric, without the store: the
choice between crude Monte Carlo and subset simulation, and both. `repeats` are the limits of subset simulation alone.
`batches` runs campaigns on P(x >= 2) of a normal x beside a second input that moves the edge, or makes the metric jump.
`chance` has a smooth region of P = .001, and a sixth of the space where one seed in ten fails, which no metric shows, with a
gate of .012; `waves` a deterministic metric with seven periods along an input. `sometimes` are falsifications of 100 runs
where the conflict arises with some seeds only; `idle` such of wells beside choices that change nothing; `bands` such of 80 runs
where a narrow range within a smooth metric's is critical.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2, norm

import sbt
from sbt.campaigns.crude import points_a_level
from sbt.campaigns.gate import Limits
from sbt.campaigns.many_inputs import halves_that_count
from sbt.campaigns.repeated import limits_by_repeats
from sbt.estimators.monte_carlo import Proportion
from sbt.estimators.subset import RepeatedEstimate, SubsetRun, combine_repeats, next_levels
from sbt.seeds import stream

MARGINS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "plain": lambda s: 3.0 - s,
    "whole numbers": lambda s: 3.0 - np.floor(s),
    "halves": lambda s: 6.0 - np.floor(2.0 * s),
    "cut off at 2": lambda s: np.minimum(3.0 - s, 2.0),
    "cut off at 1.3": lambda s: np.minimum(3.0 - s, 1.3),
}
WAVE = 0.3 * np.sin(5.0 * (np.arange(20_000) + 0.5) / 20_000)
METRICS: dict[str, tuple[Callable[[float, float], float], float]] = {
    "smooth": (lambda x, y: 2.0 - x + 0.3 * np.sin(5.0 * y), float(ndtr(-2.0 - WAVE).mean())),
    "cut off at 1.5": (lambda x, y: min(2.0 - x + 0.3 * np.sin(5.0 * y), 1.5), float(ndtr(-2.0 - WAVE).mean())),
    "inf where y < .1 and beyond 1.5": (lambda x, y: 2.0 - x if y >= 0.1 and x > 0.5 else np.inf, 0.9 * float(ndtr(-2.0))),
    "5 where y < .1": (lambda x, y: 2.0 - x if y >= 0.1 else 5.0, 0.9 * float(ndtr(-2.0))),
}
SHAPES = ("sphere", "plane", "two planes")
LIMITS: tuple[tuple, ...] = (
    *((0.001, 20, budget) for budget in (400, 600, 1000, 2000, 4000)), (0.01, 20, 400), (0.01, 20, 2000), (1e-5, 20, 4000),
    (0.001, 50, 600), (0.001, 50, 2000), (2e-4, 30, 2000, "plane"), (2e-4, 80, 2000, "plane"),
)  # fmt: skip
"""P, inputs, runs, and of which shapes; all, if of none."""
SIZES = ((300, 150), (300, 75), (150, 75))


def ties(seeds: int) -> None:
    print("| inputs | margin | mean / P (std. error) | std. deviation / P | runs |\n|---|---|---|---|---|")
    for d in (2, 10):
        for name, margin in MARGINS.items():
            shares, runs = [], 0
            for k in range(seeds):
                repeat, rng = SubsetRun(200, d), stream(k, "corners", name, d)
                while not repeat.finished:
                    z = repeat.ask(rng)
                    repeat, runs = repeat.tell(z, margin(z.sum(axis=1) / np.sqrt(d))), runs + len(z)
                shares.append(repeat.share / float(ndtr(-3.0)))
            mean, std = np.mean(shares), np.std(shares)
            print(f"| {d} | {name} | {mean:.2f} ({std / np.sqrt(seeds):.2f}) | {std:.2f} | {runs / seeds:.0f} |", flush=True)


def _by_repeats(margin, d: int, budget: int, rng: np.random.Generator) -> tuple[list[SubsetRun], int, int]:
    """Return five repeats within the budget, how many runs they took, and critical ones of their first level."""
    repeats, spent, hits = [SubsetRun(points_a_level(budget), d, alone=False) for _ in range(5)], 0, 0
    while (width := sum(r.width for r in repeats if r.asks)) and spent + width <= budget:
        told = []
        for r in repeats:
            z = r.ask(rng) if r.asks else None
            y = None if z is None else margin(z)
            hits += int((y <= 0).sum()) if y is not None and r.levels == 0 else 0
            told.append(r if z is None else r.tell(z, y))
        repeats, spent = next_levels(told), spent + width
    return repeats, spent, hits


def _campaign(margin, d: int, budget: int, rng: np.random.Generator) -> tuple[float, Limits, bool]:
    """Return estimate, limits, and whether it is crude Monte Carlo."""
    first = margin(rng.standard_normal((min(max(budget // 6, 3 * d), budget // 2), d)))
    left, counts = budget - len(first), halves_that_count(first, budget)
    if any(counts):
        kept = [half for half, counted in zip(np.array_split(first, 2), counts, strict=True) if counted]
        y = np.concatenate([*kept, margin(rng.standard_normal((left, d)))])
        share = Proportion(len(y), int((y <= 0).sum()))
        return share.value, Limits(share.lower, share.upper), True
    repeats, spent, hits = _by_repeats(margin, d, left, rng)
    rest = margin(rng.standard_normal((left - spent, d)))
    hits += int((first <= 0).sum() + (rest <= 0).sum())
    share = Proportion(len(first) + 5 * repeats[0].n + len(rest), hits)
    found = combine_repeats([r.estimate for r in repeats])
    if found.value == 0.0:
        return share.value, Limits(share.lower, share.upper), False
    limits = limits_by_repeats(found, share)
    reached = found.tells_spread and (all(r.finished for r in repeats) or all(r.estimate > 0.0 for r in repeats))
    return found.value, limits if reached else Limits(limits.lower, share.upper), False


def many(seeds: int) -> None:
    print("| problem | P | runs | crude chosen | RMSE / P | crude | mean error (std. error) | covered | half width / P |")
    print("|---|---|---|---|---|---|---|---|---|")
    for budget in (300, 2000, 4000):
        for p in (0.2, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0002, 0.00003):
            edge, plane, top = chi2(20).isf(p), norm.isf(p), norm.isf(1.0 - (1.0 - p) ** (1.0 / 20))
            problems = {
                "sphere 20": (20, lambda z, edge=edge: edge - (z**2).sum(axis=1)),
                "largest of 20": (20, lambda z, top=top: top - z.max(axis=1)),
                "plane 80": (80, lambda z, plane=plane: plane - z.sum(axis=1) / np.sqrt(80)),
            }
            for name, (d, margin) in problems.items():
                rows = [_campaign(margin, d, budget, stream(k, "corners", "many", name)) for k in range(seeds)]
                error = np.array([value / p - 1.0 for value, _, _ in rows])
                ends = [(limits.lower(0.975), limits.upper(0.975)) for _, limits, _ in rows]
                print(
                    f"| {name} | {p:g} | {budget} | {np.mean([row[2] for row in rows]):.2f} | {np.sqrt(np.mean(error**2)):.2f} | "
                    f"{np.sqrt((1.0 - p) / p / budget):.2f} | {error.mean():+.3f} ({error.std() / np.sqrt(seeds):.3f}) | "
                    f"{np.mean([low <= p <= high for low, high in ends]):.3f} | "
                    f"{np.median([0.5 * (high - low) / p for low, high in ends]):.2f} |",
                    flush=True,
                )  # fmt: skip


def _of_shape(shape: str, d: int, p: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a margin in d normal inputs, negative with probability p: outside of a sphere, beyond a plane or one of two."""
    if shape == "sphere":
        edge = chi2(d).isf(p)
        return lambda z: edge - (z**2).sum(axis=1)
    if shape == "plane":
        edge = norm.isf(p)
        return lambda z: edge - z.sum(axis=1) / np.sqrt(d)
    edge, half = norm.isf(1.0 - np.sqrt(1.0 - p)), d // 2
    return lambda z: edge - np.maximum(z[:, :half].sum(axis=1), z[:, half:].sum(axis=1)) / np.sqrt(half)


def repeats_alone(p: float, d: int, budget: int, shape: str, seed: int) -> tuple[RepeatedEstimate, Proportion, bool]:
    """Return what subset simulation in all of the budget says, its first level, and whether its limits count."""
    repeats, _, hits = _by_repeats(_of_shape(shape, d, p), d, budget, stream(seed, "corners", "repeats", shape, d, budget))
    found, first = combine_repeats([r.estimate for r in repeats]), Proportion(5 * repeats[0].n, hits)
    return found, first, found.tells_spread and (all(r.finished for r in repeats) or all(r.estimate > 0.0 for r in repeats))


def _ends(found: RepeatedEstimate, first: Proportion, told: bool) -> tuple[float, float, float, float]:
    """Return the ends of the two-sided 95 % interval, then one-sided 95 % limits."""
    limits = limits_by_repeats(found, first) if found.value else Limits(first.lower, first.upper)
    if found.value and not told:
        limits = limits.reaching(lambda c: max(first.upper(c), found.value))
    return limits.lower(0.975), limits.upper(0.975), limits.lower(0.95), limits.upper(0.95)


def repeats(seeds: int) -> None:
    print("| problem | P | runs | mean / P (std. error) | covered | above, below P (.05 each) | interval / P (median) |")
    print("|---|---|---|---|---|---|---|")
    for p, d, budget, *shapes in LIMITS:
        for shape in shapes or SHAPES:
            found = [repeats_alone(p, d, budget, shape, seed) for seed in range(seeds)]
            low, high, least, most = np.array([_ends(*each) for each in found]).T / p
            value = np.array([each[0].value for each in found]) / p
            print(
                f"| {shape} {d} | {p:g} | {budget} | {value.mean():.2f} ({value.std() / np.sqrt(seeds):.2f}) | "
                f"{np.mean((low <= 1.0) & (high >= 1.0)):.3f} | {np.mean(least > 1.0):.3f}, {np.mean(most < 1.0):.3f} | "
                f"{np.median(low):.2f} to {np.median(high):.2f} |",
                flush=True,
            )


def batches(seeds: int) -> None:
    print("| metric | runs, batch | rel. RMSE | half width (median) | covered |\n|---|---|---|---|---|")
    inputs = [sbt.Parameter("x", -5, 5, distribution=sbt.Normal(0, 1)), sbt.Parameter("y", 0, 1)]
    for name, (metric, p) in METRICS.items():
        scenario = sbt.Scenario(
            "corner", inputs, sbt.Requirement("m", high=0.0),
            evaluate=lambda v, seed, metric=metric: {"m": float(metric(v["x"], v["y"]))},
        )  # fmt: skip
        for budget, batch in SIZES:
            found = []
            for seed in range(seeds):
                with tempfile.TemporaryDirectory() as folder:
                    found.append(sbt.run(
                        campaign="estimation", scenario=scenario, budget=budget, batch=batch, stop={"cov": None}, seed=seed,
                        executor="serial", report=False, store=f"{folder}/s",
                    ).conclusion)  # fmt: skip
            error = np.array([(c.probability or 0.0) / p - 1.0 for c in found])
            width = np.median([0.5 * (c.high - c.low) / p for c in found])
            covered = sum(c.low <= p <= c.high for c in found)
            rmse = np.sqrt(np.mean(error**2))
            print(f"| {name} | {budget}, {batch} | {rmse:.3f} | {width:.3f} | {covered} of {seeds} |", flush=True)


def campaign(scenario: sbt.Scenario, seed: int, **keys: object) -> object:
    """Return the conclusion of an estimation of 200 runs."""
    with tempfile.TemporaryDirectory() as folder:
        return sbt.run(
            campaign="estimation", scenario=scenario, seed=seed, budget=200, executor="serial", report=False, store=f"{folder}/s",
            **keys,
        ).conclusion  # fmt: skip


def told(found: list, p: float, name: str) -> None:
    """Print errors beside those of crude Monte Carlo, and how far up intervals reach."""
    error = np.sqrt(np.mean([((r.probability or 0.0) / p - 1.0) ** 2 for r in found]))
    crude = np.sqrt((1.0 - p) / (p * 200))
    covered = sum(r.low <= p <= r.high for r in found)
    high = np.median([r.high for r in found]) / p
    print("| problem | rel. RMSE (crude) | covered | upper end / P (median) | gates passed |\n|---|---|---|---|---|")
    passed = sum(r.gate is not None and r.gate.verdict == "pass" for r in found)
    print(f"| {name} | {error:.2f} ({crude:.2f}) | {covered} of {len(found)} | {high:.1f} | {passed} |", flush=True)


def chance(seeds: int) -> None:
    def evaluate(v: dict, seed: int) -> dict:
        by_chance = v["c"] > 1.0 and np.random.default_rng(seed).random() < 0.1
        return {"m": -1.0 - 0.2 * v["b"] if by_chance else 3.2 - v["a"] - 0.3 * v["b"]}

    inputs = [sbt.Parameter(name, -6.0, 6.0, distribution=sbt.Normal(0, 1)) for name in "abc"]
    scenario = sbt.Scenario("chance", inputs, sbt.Requirement("m", high=0.0), evaluate=evaluate, metrics=["m"])
    region = float(ndtr(-3.2 / np.sqrt(1.09)))
    p = region + (1.0 - region) * 0.1 * float(ndtr(-1.0))
    told([campaign(scenario, s, gate={"probability": 0.012, "confidence": 0.95}) for s in range(seeds)], p, "chance")


def waves(seeds: int) -> None:
    def margin(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return 0.95 - np.sin(2.0 * np.pi * (7.0 * a + 2.0 * b**2)) * (0.6 + 0.4 * c)

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    scenario = sbt.Scenario(
        "waves", inputs, sbt.Requirement("m", high=0.0),
        evaluate=lambda v, seed: {"m": float(margin(v["a"], v["b"], v["c"]))}, metrics=["m"],
    )  # fmt: skip
    p = float((margin(*np.random.default_rng(0).random((3, 10_000_000))) <= 0.0).mean())
    told([campaign(scenario, s, stop={"cov": None}) for s in range(seeds)], p, "waves")


def _from(v: dict, a: float, b: float) -> float:
    return float(np.hypot(v["a"] - a, v["b"] - b))


def _met(v: dict) -> float:
    return 0.2 + 2 * _from(v, 0.3, 0.6) + 0.5 * v["c"]


SOMETIMES: dict[str, tuple[float, float, Callable[[dict], float], Callable[[dict], float]]] = {
    "a car comes with .15 of the seeds, else 10 s": (0.15, 0.9, _met, lambda v: 10.0),
    "with .2, else a slope": (0.2, 0.9, _met, lambda v: 4.0 - 2 * _from(v, 0.3, 0.6)),
    "two ways to meet, .4 and .6": (
        0.4, 0.8, lambda v: 0.6 + 1.5 * float(np.hypot(v["a"] - 0.8, v["c"] - 0.7)), lambda v: 1.0 + _from(v, 0.2, 0.2)
    ),
}  # fmt: skip
"""Share of the seeds with the conflict, edge, metric with it and without it."""


def _falsified(scenario: sbt.Scenario, seed: int, budget: int = 100) -> object:
    with tempfile.TemporaryDirectory() as folder:
        result = sbt.run(
            campaign="falsification", scenario=scenario, seed=seed, budget=budget, executor="serial", report=False,
            store=f"{folder}/s",
        )  # fmt: skip
        return result.frame, result.conclusion


def sometimes(seeds: int) -> None:
    print("| conflict | critical share | nothing met in 100 runs | random | critical runs (mean) | random |")
    print("|---|---|---|---|---|---|")
    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    for name, (share, edge, conflict, other) in SOMETIMES.items():
        def evaluate(v: dict, seed: int, share: float = share, conflict=conflict, other=other) -> dict:
            return {"m": conflict(v) if np.random.default_rng(seed).random() < share else other(v)}

        points = np.random.default_rng(0).random((100_000, 3))
        p = share * float(np.mean([conflict(dict(zip("abc", u, strict=True))) <= edge for u in points[:20_000]]))
        hits = []
        for seed in range(seeds):
            frame, _ = _falsified(sbt.Scenario("sometimes", inputs, sbt.Requirement("m", high=edge), evaluate=evaluate), seed)
            hits.append(int((frame["critical"].fillna(False).astype(bool) & (frame["stage"] != "confirm")).sum()))
        missed, none = sum(h == 0 for h in hits), (1.0 - p) ** 100
        told = f"{missed} of {seeds} | {none * seeds:.1f} | {np.mean(hits):.1f} | {100 * p:.1f}"
        print(f"| {name} | {p:.3f} | {told} |", flush=True)


def idle(seeds: int) -> None:
    print("| choices that change nothing | wells | told as modes, by seed | wells met, by seed |\n|---|---|---|---|")
    for choices in ((), (6,), (3, 3)):
        inputs = [sbt.Parameter(f"k{j}", choices=[f"v{i}" for i in range(n)]) for j, n in enumerate(choices)]
        inputs += [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]

        def metric(v: dict, seed: int) -> dict:
            near = 0.8 * _from(v, 0.25, 0.7) + 0.2 * abs(v["c"] - 0.5)
            return {"m": min(near, 0.08 + 1.2 * _from(v, 0.85, 0.15) + 0.3 * abs(v["c"] - 0.2))}

        told, met = [], []
        for seed in range(seeds):
            frame, found = _falsified(sbt.Scenario("idle", inputs, sbt.Requirement("m", high=0.16), evaluate=metric), seed)
            told.append(len(found.failure_modes))
            met.append(len(set(frame[frame["critical"].fillna(False).astype(bool)]["x.a"] > 0.55)))
        print(f"| {choices or 'none'} | 2 | {told} | {met} |", flush=True)


BANDS: dict[str, tuple[float, float, Callable[[dict], np.ndarray]]] = {
    "sin 5a + b^2 + .3c": (0.5, 0.506, lambda v: np.sin(5 * v["a"]) + v["b"] ** 2 + 0.3 * v["c"]),
    "6a cos 3b + 2c + a^2": (3.0, 3.04, lambda v: 6 * v["a"] * np.cos(3 * v["b"]) + 2 * v["c"] + v["a"] ** 2),
}
"""Ends of the critical interval, metric."""


def bands(seeds: int) -> None:
    print("| metric | critical share | runs to the first, by seed | critical runs of 80 (mean) | random |\n|---|---|---|---|---|")
    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in "abc"]
    for name, (low, high, metric) in BANDS.items():
        need = sbt.Requirement("m", low=low, high=high)
        scenario = sbt.Scenario("band", inputs, need, evaluate=lambda v, seed, metric=metric: {"m": float(metric(v))})
        y = metric(dict(zip("abc", np.random.default_rng(0).random((3, 1_000_000)), strict=True)))
        p = float(((y >= low) & (y <= high)).mean())
        found = [_falsified(scenario, 100 + seed, 80)[1] for seed in range(seeds)]
        first = ", ".join("none" if each.runs_to_first is None else str(each.runs_to_first) for each in found)
        hits = np.mean([each.critical_runs for each in found])
        print(f"| {name} | {p:.4f} | {first} | {hits:.1f} | {80 * p:.1f} |", flush=True)


CORNERS = {
    "many": many, "ties": ties, "repeats": repeats, "batches": batches, "chance": chance, "waves": waves, "sometimes": sometimes,
    "idle": idle, "bands": bands,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corner", choices=tuple(CORNERS))
    parser.add_argument("--seeds", type=int, default=16)
    asked = parser.parse_args()
    CORNERS[asked.corner](asked.seeds)


if __name__ == "__main__":
    main()
