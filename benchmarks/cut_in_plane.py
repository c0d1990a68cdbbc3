"""The metric of cut_in over its whole plane of inputs: the figures of docs/scenarios/cut_in.md.

    python benchmarks/cut_in_plane.py [--size 200] [--out docs/figures]

Runs two size x size grids with one seed a point on all cores: the whole plane, for ttc_min, and the
lowest quarter of d_t, for what happened. Keeps the numbers in OUT/*.npz, which are not part of the
repository.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from sbt.execution.local import LocalExecutor
from sbt.execution.spec import ScenarioSpec
from sbt.problem.outcome import Job
from sbt.seeds import run_seed

KINDS = ("passes before the cut-in", "uncritical", "critical, no collision", "collision from behind", "collision side by side")
Grid = tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]
COLOURS = ("#c9d6df", "#f4f1ea", "#f2b35e", "#b3202a", "#5b2a86")


def simulate(size: int, d_t_max: float) -> Grid:
    spec = ScenarioSpec("cut_in")
    a, b = spec.resolve().space.parameters
    d_v, d_t = np.linspace(a.low, a.high, size), np.linspace(b.low, d_t_max, size)
    jobs = [
        Job(i * size + j, {"d_v": float(v), "d_t": float(t)}, run_seed(0, i * size + j))
        for i, t in enumerate(d_t) for j, v in enumerate(d_v)
    ]  # fmt: skip
    found: dict[str, np.ndarray] = {}
    with LocalExecutor(spec, os.cpu_count() or 1, 60.0) as executor:
        for outcome in executor.run(jobs):
            for name, value in outcome.metrics.items():
                found.setdefault(name, np.full(size * size, np.nan))[outcome.index] = value
    return d_v, d_t, {name: values.reshape(size, size) for name, values in found.items()}


def outcome_kind(y: dict[str, np.ndarray]) -> np.ndarray:
    ttc = y["ttc_min"]
    kind = np.where(ttc <= -9.99, 0, np.where((ttc >= -5) & (ttc <= 0.5), 2, 1))
    kind = np.where((y["collision"] > 0) & (ttc >= 0), 3, kind)
    return np.where((y["collision"] > 0) & (ttc < 0), 4, kind)


def draw(whole: Grid, zoom: Grid, path: Path) -> None:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    d_v, d_t, y = whole
    image = left.pcolormesh(d_v, d_t, np.clip(y["ttc_min"], -5, 10), cmap="viridis", shading="nearest", rasterized=True)
    left.contour(d_v, d_t, y["ttc_min"], levels=[0.5], colors="white", linewidths=1.2)
    figure.colorbar(image, ax=left, label="ttc_min (s), -10 shown as -5")
    left.set(xlabel="d_v (km/h)", ylabel="d_t (s)", title="smallest time to collision; white: 0.5 s")
    d_v, d_t, y = zoom
    norm = BoundaryNorm(np.arange(len(KINDS) + 1) - 0.5, len(KINDS))
    right.pcolormesh(d_v, d_t, outcome_kind(y), cmap=ListedColormap(COLOURS), norm=norm, shading="nearest", rasterized=True)
    right.legend(handles=[Patch(color=c, label=k) for c, k in zip(COLOURS, KINDS, strict=True)], fontsize=8, loc="upper left")
    right.set(xlabel="d_v (km/h)", ylabel="d_t (s)", title="what happened, at small time gaps")
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("docs/figures"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    whole, zoom = simulate(args.size, 10.0), simulate(args.size, 2.5)
    for name, (d_v, d_t, y) in {"whole": whole, "zoom": zoom}.items():
        np.savez_compressed(args.out / f"cut_in_plane_{name}.npz", d_v=d_v, d_t=d_t, **y)
    draw(whole, zoom, args.out / "cut_in_plane.png")
    kinds = outcome_kind(whole[2])
    print("| what happened | share of the plane |\n|---|---|")
    for k, kind in enumerate(KINDS):
        print(f"| {kind} | {float((kinds == k).mean()):.4f} |")


if __name__ == "__main__":
    main()
