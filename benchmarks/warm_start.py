"""Does a Gaussian process that starts from the previous iteration's hyperparameters learn as well, and how much sooner?

    OMP_NUM_THREADS=1 python benchmarks/warm_start.py STORE [STORE ...] --seeds 5

Each store is a campaign's, best of evenly spread runs. A campaign of batches is replayed on its runs: after every batch one
process is fitted from the usual start and one from where the last one ended, both conditioned on the same rows.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np

import sbt
from sbt.metamodels import gaussian_process as gp
from sbt.metamodels.scores import scores

KEYS = ("log_likelihood", "average_precision", "log_likelihood_critical")
_fit_posterior = gp.fit_posterior


def replay(u, y, critical, sizes, seed, *, warm):
    """Return (k, 4) CPU seconds, log likelihoods, average precisions, and log likelihoods of critical runs."""
    order, found, previous = np.random.default_rng(seed).permutation(len(y)), [], None
    test = order[-5000:]
    for n in sizes:
        train, last = order[:n], previous if warm else None

        def fit(objective, start=None, last=last):
            return _fit_posterior(objective, last if start is None else start)

        with patch.object(gp, "fit_posterior", fit):
            begun = time.process_time()
            predictor = gp.GaussianProcess().fit(u[train], y[train], np.random.default_rng(seed))
            seconds = time.process_time() - begun
        previous = predictor.hyper
        now = scores(predictor(u[test]), y[test], critical)
        found.append([seconds, *(now[key] for key in KEYS)])
    return np.array(found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stores", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--batch", type=int, default=50)
    parser.add_argument("--batches", type=int, default=8)
    args = parser.parse_args()
    sizes = [args.batch * (k + 1) for k in range(args.batches)]
    print(f"Seeds 0 to {args.seeds - 1}, refits at {sizes[1]} to {sizes[-1]} runs; warm minus cold ± standard error of seeds.\n")
    print("| store | cold fit [s] | warm fit [s] | ll | AP | ll critical | worst refit's ll |\n|---|---|---|---|---|---|---|")
    for folder in args.stores:
        result = sbt.open(folder)
        scenario, runs = result.scenario, result.history.finished
        u, y = scenario.space.metamodel_inputs(scenario.space.to_unit(runs.x)), runs.y(scenario.requirement.metric)
        cold, warm = (
            np.array([replay(u, y, scenario.requirement.critical, sizes, seed, warm=w)[1:] for seed in range(args.seeds)])
            for w in (False, True)
        )
        change = (warm - cold).mean(axis=1)  # (seeds, 4)
        mean, error = change.mean(axis=0), change.std(axis=0, ddof=1) / np.sqrt(args.seeds)
        cells = " | ".join(f"{m:+.4f} ± {e:.4f}" for m, e in zip(mean[1:], error[1:], strict=True))
        worst = (warm - cold)[:, :, 1].min()
        print(f"| {folder.name} | {cold[..., 0].mean():.2f} | {warm[..., 0].mean():.2f} | {cells} | {worst:+.3f} |", flush=True)


if __name__ == "__main__":
    main()
