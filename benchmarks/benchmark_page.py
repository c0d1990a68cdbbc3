"""Write docs/benchmark.md and its figures from a benchmark's results, finished or not.

python benchmarks/benchmark_page.py configs/benchmark_reduced.yaml [--store DIR]
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np

from sbt.benchmark.cell import is_done
from sbt.benchmark.figures import Results, write_figures
from sbt.benchmark.table import write_table
from sbt.config.benchmark import LoadedBenchmark, load_benchmark

ROOT = Path(__file__).resolve().parent.parent
TRAFFIC = ("unprotected_left_turn", "roundabout_entry", "highway_merge", "crossing_pedestrian")
CAPTIONS = {
    "likelihood_even": "Log likelihood a run over all reference runs, even samples; mean and standard deviation over seeds.",
    "rmse_even": "RMSE over all reference runs, even samples.",
    "likelihood_critical": "Log likelihood a run over the critical reference runs with a_BI; even samples in grey.",
    "rmse_critical": "RMSE over the critical reference runs with a_BI; even samples in grey.",
    "precision_recall": "Precision and recall of P(critical) with a_BI, even samples in grey. Star: all critical runs found; "
    "dashed: share of critical runs.",
    "reliability": "Observed over expected recall with a_BI, even samples in grey; on the diagonal P(critical) is calibrated.",
    "times": "Seconds of a fit, and milliseconds of a sample from a_BI (wall clock, on a machine shared with other work).",
}


def main() -> None:
    """Write page and figures."""
    parser = argparse.ArgumentParser(description="Write docs/benchmark.md.")
    parser.add_argument("config", type=Path)
    parser.add_argument("--store", help="folder of the results, where it is another")
    args = parser.parse_args()
    loaded = load_benchmark(args.config, [] if args.store is None else [f"store={json.dumps(args.store)}"])
    table = Path(loaded.config.store) / "results.csv"
    if not write_table(table, loaded.cells()):
        sys.exit(f"no cell of {args.config} has begun: run sumo-sbt benchmark {args.config}")
    results = Results.of(loaded, table)
    folder = ROOT / "docs" / "figures" / "benchmark"
    shutil.rmtree(folder, ignore_errors=True)
    names = [path.stem for path in write_figures(loaded, table, folder)]
    text = "\n\n".join([_head(loaded, results, args.config), _table(results), _findings(results), _figures(names)]) + "\n"
    (ROOT / "docs" / "benchmark.md").write_text(text)


def _head(loaded: LoadedBenchmark, results: Results, config: Path) -> str:
    done, cells = sum(map(is_done, results.cells)), len(results.cells)
    state = "all" if done == cells else f"{done} of {cells}"
    entries = ", ".join(
        f"{s.label} {s.iterations or loaded.config.iterations} x {s.batch}" for s in loaded.config.scenarios
    )  # fmt: skip
    return f"""# The paper's experiment on SUMO

The experiment of Winkelmann et al. (2022), section VI, on this package's scenarios: metamodels learn from even (Sobol)
samples, or from samples drawn in proportion to a_BI after an even first batch, and are scored on random reference runs that
none of them learned from. Written by `benchmarks/benchmark_page.py` from the results of `{config.name}`, **{state} cells done**.
Iterations x runs: {entries}. Cells done: {_seeds(results)}. What is reduced against the paper
stands at the top of the configuration; {_few(loaded)}

```bash
sumo-sbt benchmark configs/{config.name}          # resumes where it was stopped; --workers 2
sumo-sbt benchmark configs/{config.name} --reference-only
python benchmarks/benchmark_page.py configs/{config.name}
```"""


def _few(loaded: LoadedBenchmark) -> str:
    count = len(loaded.config.seeds)
    return f"{count} seeds say little about the spread (the paper has 50)." if count < 10 else f"{count} seeds."


def _last(results: Results, scenario: str, metamodel: str, acquisition: str, key: str) -> float:
    """Return the mean over the seeds after the last iteration, NaN where it was not reached."""
    wanted = next(c for c in results.cells if c.scenario == scenario)
    _, mean, _ = results.curve(scenario, metamodel, acquisition, key)
    keys = {"scenario": scenario, "metamodel": metamodel, "acquisition": acquisition}
    runs = [row["runs"] for row in results.rows if keys.items() <= row.items() and math.isfinite(row[key])]
    return float(mean[-1]) if max(runs, default=0) == wanted.batch * wanted.iterations else math.nan


def _table(results: Results) -> str:
    columns = {
        "log_likelihood": "ll all", "rmse": "RMSE all", "log_likelihood_critical": "ll critical",
        "rmse_critical": "RMSE critical", "average_precision": "AP", "precision_at_recall_90": "P@R90",
        "calibration_error": "ECE", "coverage_95": "cov95",
    }  # fmt: skip
    lines = [
        "## After the last iteration", "", f"| scenario | metamodel | samples | {' | '.join(columns.values())} |",
        f"|{'---|' * (3 + len(columns))}",
    ]  # fmt: skip
    for scenario in results.scenarios:
        for metamodel in results.metamodels:
            for acquisition in ("even", "boundary"):
                values = [_last(results, scenario, metamodel, acquisition, key) for key in columns]
                if np.isfinite(values[0]):
                    cells = " | ".join("-" if math.isnan(v) else f"{v:.3f}" for v in values)
                    lines.append(f"| {scenario} | {metamodel} | {acquisition} | {cells} |")
    return "\n".join(lines)


def _findings(results: Results) -> str:
    """Return what the paper found beside what was found here."""
    lines = ["## Which of the paper's findings hold", "", "| finding of the paper | here |", "|---|---|"]
    best = _best(results, "even", "log_likelihood")
    lines.append(f"| the BNN has the highest likelihood over all runs (3 of 4 scenarios) | {best} |")
    lines.append(
        "| a_BI raises the likelihood of critical runs | "
        f"{_gains(results, 'log_likelihood_critical', lambda new, old: new > old)} |"
    )
    lines.append(f"| a_BI lowers the RMSE of critical runs | {_gains(results, 'rmse_critical', lambda new, old: new < old)} |")
    lines.append(
        "| the acquisition matters more than the metamodel: the worst with a_BI beats the best with even samples | "
        f"{_worst_against_best(results)} |"
    )
    lines.append(f"| the BNN is best on critical runs with a_BI | {_best(results, 'boundary', 'log_likelihood_critical')} |")
    lines.append(
        f"| a_BI mostly raises the precision | {_gains(results, 'precision_at_recall_90', lambda new, old: new > old)} "
        "(at 90 % recall) |"
    )
    lines.append(f"| a_BI mostly improves the calibration | {_gains(results, 'calibration_error', lambda new, old: new < old)} |")
    lines.append(f"| ET is calibrated well as a classifier | lowest calibration error with a_BI: {_least_ece(results)} |")
    return "\n".join(lines) + _traffic(results)


def _traffic(results: Results) -> str:
    """Return what is different where the run's seed draws the traffic, empty without such a scenario."""
    there = [s for s in results.scenarios if s in TRAFFIC]
    precision = [
        _last(results, s, m, a, "average_precision") for s in there for m in results.metamodels for a in ("even", "boundary")
    ]  # fmt: skip
    precision = [p for p in precision if math.isfinite(p)]
    if not precision:
        return ""
    return (
        f"\n\nIn {', '.join(there)} SUMO's own traffic is drawn from the run's seed. "
        "In three of them the inputs explain no more than a fifth of the metric's variance (see their [pages](scenarios.md)). "
        "So few runs teach no metamodel there which run will be critical "
        f"(average precision at most {max(precision):.2f}), a_BI has no edge to follow, and even samples are as good."
    )


def _seeds(results: Results) -> str:
    """Return how many cells of each seed are done."""
    told = []
    for seed in sorted({cell.seed for cell in results.cells}):
        done = [is_done(cell) for cell in results.cells if cell.seed == seed]
        told.append(f"{sum(done)} of {len(done)} of seed {seed}")
    return ", ".join(told)


def _best(results: Results, acquisition: str, key: str, sign: float = 1.0) -> str:
    """Return the best metamodel of every scenario where at least two are there."""
    told = []
    for scenario in results.scenarios:
        found = {m: _last(results, scenario, m, acquisition, key) for m in results.metamodels}
        found = {m: v for m, v in found.items() if math.isfinite(v)}
        if len(found) > 1:
            best = max(found, key=lambda m: sign * found[m])
            told.append(f"{scenario}: {best} ({found[best]:.2f} among {len(found)})")
    return "; ".join(told) or "not measured yet"


def _least_ece(results: Results) -> str:
    return _best(results, "boundary", "calibration_error", sign=-1.0)


def _gains(results: Results, key: str, better: object) -> str:
    """Return in how many pairs of scenario and metamodel a_BI is better than even samples, and where in the fewer."""
    won, pairs, changes, seldom = 0, 0, [], []
    for scenario in results.scenarios:
        here = 0, 0
        for metamodel in results.metamodels:
            new, old = (_last(results, scenario, metamodel, a, key) for a in ("boundary", "even"))
            if math.isfinite(new) and math.isfinite(old):
                here = here[0] + bool(better(new, old)), here[1] + 1  # type: ignore[operator]
                changes.append(new - old)
        won, pairs = won + here[0], pairs + here[1]
        if 2 * here[0] < here[1]:
            seldom.append(f"{scenario} {here[0]} of {here[1]}")
    if not pairs:
        return "not measured yet"
    rare = f"; in fewer than half: {', '.join(seldom)}" if seldom else ""
    return f"in {won} of {pairs} pairs; median change {np.median(changes):+.3f}{rare}"


def _worst_against_best(results: Results) -> str:
    told = []
    for scenario in results.scenarios:
        pairs = [
            (_last(results, scenario, m, "boundary", "log_likelihood_critical"), _last(results, scenario, m, "even",
             "log_likelihood_critical")) for m in results.metamodels
        ]  # fmt: skip
        pairs = [p for p in pairs if all(map(math.isfinite, p))]
        if len(pairs) > 1:
            worst, best = min(p[0] for p in pairs), max(p[1] for p in pairs)
            told.append(f"{scenario}: {'yes' if worst > best else 'no'} ({worst:.2f} against {best:.2f})")
    return "; ".join(told) or "not measured yet"


def _figures(names: list[str]) -> str:
    lines = ["## Figures"]
    for name in names:
        caption = CAPTIONS.get(name) or (
            f"{name.removeprefix('scatter_')}: predicted mean over the true metric; colour: the residual risk that would have to "
            "be aimed at to cover the outcome. Above even samples, below a_BI; the run closest to the median likelihood."
        )
        lines += [f"{caption}", f"![{name}](figures/benchmark/{name}.png)"]
    return "\n\n".join(lines)


if __name__ == "__main__":
    main()
