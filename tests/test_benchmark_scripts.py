"""Every script in `benchmarks/` runs, here at its smallest; the numbers of one that has rotted could not be made again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from browser import PROGRAM

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
SMALLEST = {
    "boundary.py": "--scenario cut_in --seeds 1 --budget 30 --batch 10 --reference 200",
    "boundary_traffic.py": "crossing_pedestrian --points 4 --runs 2 --budget 45 --seeds 1 --into {folder}/counts",
    "boundary_warm.py": "--seeds 1 --cases waves --budget 20 --earlier 40 --table {folder}/warm.jsonl",
    "corners.py": "ties --seeds 2",
    "constrained.py": "--seeds 1 --sums 1.224 --budget 40 --table {folder}/constrained.jsonl",
    "contacts.py": "--runs 2 --nets roundabout",
    "cut_in_plane.py": "--size 4 --out {folder}/plane.png",
    "metamodels.py": "--kinds et --rows 20 --inputs 2 --points 64 --repeat 1",
    "noise.py": "--scenarios highway_merge --seeds 1 --budget 30",
    "overhead.py": "--runs 32",
    "physics.py": "emergency_braking --runs 2 --others 1 --egos IDM",
    "proposals.py": "--runs 30 --repeats 1",
    "race.py": "--races 20",
    "screening.py": "--rows 50 --inputs 4 --samples 4 --kinds gp",
    "slice_teeth.py": "--scenario following --points 2 --values 4",
    "step_length.py": "--scenario cut_in --points 16 --seeds 2 --reference 0.025",
    "transfer_region.py": "--seeds 1 --table {folder}/table.jsonl",
    "transfer.py": "--seeds 1 --cases cut_in --budget 60 --crude 50 --table {folder}/table.jsonl",
    "throughput.py": "--scenario cut_in --runs 4 --repeats 1 --no-campaign",
    "watcher.py": "--repeats 1 --vehicles 20",
    "warm_start.py": "{folder}/store --seeds 2 --batch 10 --batches 2",
    "boundary_inputs.py": "--problems testbed:himmelblau_partx --methods even --seeds 1 --store {folder}/inputs",
    "boundary_noise.py": "--problems two_hollows_noisy --seeds 1 --budget 30",
    "several.py": "--seeds 1 --what falsification --needs any",
    "boundary_table.py": "--problems testbed:borehole_1e-3:box --methods even --seeds 1 --reference 500 --store {folder}/table",
    "estimation.py": "--problems gayton_hat@200 --seeds 1 --table {folder}/table.jsonl",
    "faults.py": "--kills 1 --only export storm",
    "choices.py": "--task falsification --seeds 1 --store {folder}/choices",
    "failing_runs.py": "--seeds 1 --only falsification",
    "failing_estimates.py": "--counts 1 --seeds 1 --problems overlap_d2_half --table {folder}/failing.jsonl",
    "asked_again.py": "--seeds 1 --table {folder}/again.jsonl",
    "ahead.py": "--seeds 1 --budget 40",
    "fuzz.py": "--configurations 2 --scenarios 1",
    "few_values.py": "logarithms --seeds 1",
    "tight_sums.py": "--problems exact@90 --seeds 1",
    "gates.py": "--problems box_3 --seeds 1 --budget 120 --table {folder}/gates.jsonl",
    "jumps.py": "--problems disc_count --seeds 1 --budget 30",
    "kernels.py": "--problems metaball --runs 40 --seeds 1",
    "least_values.py": "--problems flat --seeds 1 --budget 20",
    "links.py": "--seeds 1 --budget 40",
    "large.py": "--runs 200 --batch 100",
    "pair_estimates.py": (
        "crossing_pedestrian --seeds 1 --budget 40 --priced 20 --probability .021 --table {folder}/pairs.jsonl"
    ),
    "pair_problems.py": "--seeds 1 --budget 40 --only skewed --table {folder}/problems.jsonl",
    "pairs.py": "crossing_pedestrian --seeds 1 --runs 30",
    "report_speed.py": "--runs 20 --scenario cut_in --clicks 2 --opened 1", "serve_speed.py": "--runs 20 --opened 1",
    "run_price.py": "--runs 2 --repeats 1 --only crossing_pedestrian",
    "fidelity.py": "problems --budget 40 --seeds 1 --only useless --probabilities 0.38",
    "falsification.py": "--only cut_in_near_miss --samplers portfolio --seeds 2 --into {folder}/into",
}
SUMO = {"boundary.py", "boundary_traffic.py", "contacts.py", "cut_in_plane.py", "overhead.py", "slice_teeth.py", "step_length.py"}
SUMO |= {"fuzz.py", "noise.py", "pairs.py", "physics.py", "run_price.py", "throughput.py", "transfer.py", "watcher.py"}
SUMO |= {"pair_estimates.py", "report_speed.py"}  # and Chromium, as serve_speed.py
LONG = {"batch_size.py", "benchmark_page.py", "known_before.py", "snapshots.py"}  # hours, or minutes
SHARED = {"coarse_problems.py", "disturbing.py", "fuzz_values.py", "resumed.py", "street_traffic.py"}  # what scripts use
SHARED |= {"two_discs.py"}


def test_every_script_is_known():
    assert {path.name for path in BENCHMARKS.glob("*.py")} == set(SMALLEST) | LONG | SHARED


@pytest.mark.slow
@pytest.mark.parametrize("script", [pytest.param(s, marks=[pytest.mark.sumo] if s in SUMO else []) for s in SMALLEST])
def test_it_runs(script, tmp_path, campaign):
    if script in ("report_speed.py", "serve_speed.py") and PROGRAM is None:
        pytest.skip("Chromium is not installed")
    if script == "warm_start.py":
        campaign(campaign="coverage", budget=100, store=str(tmp_path / "store"))
    arguments = SMALLEST[script].format(folder=tmp_path).split()
    done = subprocess.run(
        [sys.executable, BENCHMARKS / script, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "|" in done.stdout or list(tmp_path.glob("plane*"))
