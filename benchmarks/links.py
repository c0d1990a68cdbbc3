"""How many failure modes does a falsification tell, and how many are there? Random balls that are critical, and bent regions.

    python benchmarks/links.py [--kinds balls,band,ring,ridge,helix,shell] [--seeds 24] [--first 0] [--budget 200]
    python benchmarks/links.py --kinds corners,equal,box,wide,slab --seeds 12 --budget 150

`balls`: five balls in two to six inputs, some of which overlap; modes are what overlaps. `band`: half a ring, .12 thick, in two
to four inputs. Thin sets: `ring` and `ridge` (a sine) .02 thick in two inputs, `helix` and `shell` .06 and .03 thick in three.
All but the balls are one mode.

Noisy ones: `corners`: .6 of the seeds fail by .1 in 3 % of the space, .15 by 4 in 5 %, at opposite corners of three inputs.
`equal`: two corners of four inputs, 7.5 % each, fail with .3. One region: `box` fails with .15 in 20 % of three inputs, `wide`
with .15 in 70 % of four, `slab` with .3 in 10 % of three.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

import sbt
from sbt.problem.plain import Values
from sbt.seeds import stream

Array = NDArray[np.float64]


def balls(seed: int) -> tuple[int, Callable[[Array], Array], Callable[[Array], NDArray[np.int64]]]:
    """Return dimension, metric of points (n, d), and the mode that critical points are of."""
    rng = stream(seed, "balls")
    d = int(rng.integers(2, 7))
    centres, radius = rng.uniform(0.1, 0.9, (5, d)), 0.07 * math.sqrt(d)
    label = connected_components(np.linalg.norm(centres[:, None] - centres, axis=-1) < 2.0 * radius, directed=False)[1]

    def distance(u: Array) -> Array:
        return np.linalg.norm(u[:, None] - centres, axis=-1)

    return d, lambda u: distance(u).min(axis=1) - radius, lambda u: np.asarray(label[distance(u).argmin(axis=1)], dtype=np.int64)


def band(seed: int) -> tuple[int, Callable[[Array], Array], Callable[[Array], NDArray[np.int64]]]:
    """Return the same of half a ring of radius .3, .06 thick, in the first two inputs."""
    rng = stream(seed, "band")
    d = int(rng.integers(2, 5))
    centre = rng.uniform(0.35, 0.65, d)

    def metric(u: Array) -> Array:
        v = u - centre
        beside = np.maximum(-v[:, 1], 0.0)
        across = np.abs(np.hypot(v[:, 0], v[:, 1]) - 0.3)
        return np.sqrt(across**2 + beside**2 + (v[:, 2:] ** 2).sum(axis=1)) - 0.06

    return d, metric, lambda u: np.zeros(len(u), dtype=np.int64)


def thin(kind: str, seed: int) -> tuple[int, Callable[[Array], Array], Callable[[Array], NDArray[np.int64]]]:
    """Return the same of a thin set, its place and phase by the seed."""
    rng = stream(seed, kind)
    centre, phase = rng.uniform(0.4, 0.6, 3), rng.uniform(0.0, 2.0 * math.pi)
    t = np.linspace(0.0, 1.0, 400)
    helix = np.column_stack([0.3 * np.cos(4 * np.pi * t + phase), 0.3 * np.sin(4 * np.pi * t + phase), 0.7 * (t - 0.5)])

    def metric(u: Array) -> Array:
        v = u - centre[: u.shape[1]]
        if kind == "ring":
            return np.asarray(np.abs(np.hypot(v[:, 0], v[:, 1]) - 0.3) - 0.01)
        if kind == "ridge":
            return np.asarray(np.abs(v[:, 1] - 0.25 * np.sin(2.0 * np.pi * u[:, 0] + phase)) - 0.01)
        if kind == "shell":
            return np.asarray(np.abs(np.linalg.norm(v, axis=1) - 0.3) - 0.015)
        return np.asarray(np.linalg.norm(v[:, None] - helix, axis=-1).min(axis=1) - 0.03)

    return 2 if kind in ("ring", "ridge") else 3, metric, lambda u: np.zeros(len(u), dtype=np.int64)


NOISY: dict[str, tuple[int, tuple[tuple[tuple[float, ...], tuple[float, ...], float, float], ...]]] = {
    "corners": (3, (((0.85, 0.8), (1.0, 1.0), 0.6, 0.1), ((0.0, 0.0), (0.2, 0.25), 0.15, 4.0))),
    "equal": (4, (((0.75, 0.7), (1.0, 1.0), 0.3, 0.5), ((0.0, 0.0), (0.25, 0.3), 0.3, 3.0))),
    "box": (3, (((0.6, 0.5), (1.0, 1.0), 0.15, 0.5),)),
    "wide": (4, (((0.3,), (1.0,), 0.15, 0.5),)),
    "slab": (3, (((0.9,), (1.0,), 0.3, 0.5),)),
}
"""Inputs, and boxes in the first of them: lower and upper corner, failure rate, and by how much the metric fails."""


def box_of(kind: str, u: Array) -> int:
    """Return in which box a point (d,) is; -1: in none."""
    boxes = [(np.array(low), np.array(high)) for low, high, _, _ in NOISY[kind][1]]
    return next((k for k, (low, high) in enumerate(boxes) if ((low <= u[: len(low)]) & (u[: len(low)] <= high)).all()), -1)


def in_noise(kind: str, u: Array, seed: int) -> float:
    """Return the metric of one seed at a point (d,): critical with the rate of its box, else 2 to 3 and noise of .4."""
    rng, k = stream(seed, "links"), box_of(kind, u)
    fails, noise = rng.random(), rng.standard_normal()
    if k >= 0 and fails < NOISY[kind][1][k][2]:
        return -NOISY[kind][1][k][3] * (1.0 + 0.3 * abs(noise))
    return 2.0 + u[-1] + 0.4 * noise


def problem(kind: str, seed: int) -> tuple[int, Callable[[Array, int], float], Callable[[Array], NDArray[np.int64]]]:
    """Return the inputs of a problem, its metric at a point by a run's seed, and the modes of critical points."""
    if kind in NOISY:
        which = np.vectorize(lambda u: box_of(kind, u), signature="(d)->()")
        return NOISY[kind][0], lambda u, run: in_noise(kind, u, run), which
    d, metric, mode = balls(seed) if kind == "balls" else band(seed) if kind == "band" else thin(kind, seed)
    return d, lambda u, _: float(metric(u[None])[0]), mode


def cell(kind: str, seed: int, budget: int) -> tuple[int, int, int, int, int, bool, bool]:
    """Return inputs, modes that were met, modes that are told, runs between critical ones, and runs beside the budget.

    With them: may there be fewer, and does the first mode fail with the largest rate of those that were met.
    """
    d, metric, mode = problem(kind, seed)
    names = [f"x{k}" for k in range(d)]

    def evaluate(values: Values, run: int) -> dict[str, float]:
        return {"y": metric(np.array([values[name] for name in names]), run)}

    inputs = [sbt.Parameter(name, 0.0, 1.0) for name in names]
    scenario = sbt.Scenario(kind, inputs, sbt.Requirement("y", high=0.0), evaluate=evaluate, metrics=["y"])
    with tempfile.TemporaryDirectory() as folder:
        found = sbt.run(
            campaign="falsification", scenario=scenario, budget=budget, seed=seed, store=f"{folder}/s", executor="serial",
            report=False,
        )  # fmt: skip
        runs = found.frame[found.frame["stage"] != "confirm"]
        x = runs[[f"x.{name}" for name in names]].to_numpy(dtype=np.float64)
        hits = x[runs["critical"].fillna(value=False).to_numpy(dtype=bool)]
    links = getattr(found.conclusion, "links", None)
    of, told = mode(hits) if len(hits) else np.zeros(0, dtype=np.int64), found.conclusion.failure_modes
    first = mode(np.array([list(told[0].inputs.values())])) if told else of
    rate = [0.0, *(box[2] for box in NOISY[kind][1])] if kind in NOISY else [0.0] * (2 + int(of.max(initial=0)))
    first_is_most = {rate[k + 1] for k in first} == {max((rate[k + 1] for k in of), default=0.0)}
    return (
        d, len(np.unique(of)), len(told), 0 if links is None else links.runs, len(found.frame) - len(runs),
        any(f"in {most} " in found.sentences()[0] for most in ("up to", "about")), first_is_most or not told,
    )  # fmt: skip


def main() -> None:
    """Print a row a problem and seed, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--budget", type=int, default=200)
    parser.add_argument("--kinds", default="balls,band,ring,ridge,helix,shell")
    asked = parser.parse_args()
    print(
        "| problem | seeds | as many as were met | fewer | more | more, told plainly | most told | links, median (most) |"
        " beside the budget | the largest rate first |"
    )
    print("|" + "---|" * 10, flush=True)
    for kind in asked.kinds.split(","):
        rows = np.array([cell(kind, seed, asked.budget) for seed in range(asked.first, asked.first + asked.seeds)])
        _, met, told, links, beside, up_to, first = rows.T
        print(
            f"| {kind} | {len(rows)} | {(told == met).sum()} | {(told < met).sum()} | {(told > met).sum()} |"
            f" {((told > met) & (up_to == 0)).sum()} | {told.max()} | {np.median(links):g} ({links.max()}) |"
            f" {np.median(beside):g} | {first.sum()} |", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    main()
